"""A rigid ball pressed into an axisymmetric body that yields: the mean pressure, and steps that the line search saves from cuts."""

import numpy as np
import pytest
from helpers import slow
from revolved_scenes import Revolved, rectangle

import uem_dolfinx as uem

RADIUS, SIZE, DEPTH = 5.0, 5.0, 0.05


def finer_at_the_ball(X):
    """Cells that get smaller towards the first touch."""
    far = np.column_stack([X[:, 0], SIZE - X[:, 1]]) / SIZE
    graded = SIZE * far**1.7
    return np.column_stack([graded[:, 0], SIZE - graded[:, 1]])


def indented(cell, degree, n, hardening, depth=DEPTH):
    """Steps of an indentation, and the mean pressure over the contact's circle relative to the yield stress."""
    s = Revolved(rectangle((0, 0), (SIZE, SIZE), (n, n), cell), cell=cell, degree=degree, pose=finer_at_the_ball)
    s.hold_axis()
    s.hold(1, 0.0)
    metal = uem.VonMises(s.u, 4000.0, 0.3, 1.0, hardening=hardening, kind="axisymmetric")
    ball = uem.RigidSphere((0.0, SIZE + RADIUS), RADIUS)
    contact = uem.Contact(s.side(1, SIZE), ball)
    problem = s.problem(metal.residual(s.v), [contact], materials=[metal], load=lambda f: ball.move((0.0, -depth * f)))
    steps = list(uem.load_steps(problem, 4))
    # nodes share the pressure at the edge of the circle: it is where half of the greatest is left
    r, pressures = (np.concatenate(problem.comm.allgather(v)) for v in (s.X[contact.nodes, 0], np.array(contact.pressures)))
    order = np.argsort(r)
    r, part = r[order], pressures[order] / pressures.max()
    last = np.flatnonzero(part > 0.5)[-1]
    radius = np.interp(0.5, part[[last + 1, last]], r[[last + 1, last]])
    return steps, -contact.resultant().force[1] / (np.pi * radius**2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "degree", "n", "cuts"), [("quadrilateral", 1, 24, 0), slow("triangle", 2, 12, 1), slow("quadrilateral", 1, 40, 3)]
)
def test_mean_pressure_without_hardening(cell, degree, n, cuts):
    """A body that yields all round a ball carries it by 2.8 to 3 times its yield stress [Johnson, Contact Mechanics, 1985, 6.3]."""
    steps, pressure = indented(cell, degree, n, 0.0)
    assert pressure == pytest.approx(2.9, rel=0.12)
    # full steps in the first iterations, of which the residual does work past its zero, ended in cuts
    assert sum(s.cuts for s in steps) <= cuts


@pytest.mark.long
def test_no_step_of_a_deep_indentation_is_cut():
    """Iterations whose full step runs past the least work are shortened; taken whole, they end in cuts."""
    steps, _ = indented("quadrilateral", 1, 24, 100.0, 4 * DEPTH)
    assert [s.cuts for s in steps] == [0, 0, 0, 0]
