"""What is coloured and from where it is seen: pressures of contacts, however they are given, and sections that a window cuts."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import blocks, linear, refused

import uem_dolfinx as uem
from uem_dolfinx.output.drawings import Drawing

COMM = MPI.COMM_WORLD
USUAL = {
    "label": "", "levels": 12, "scale": 1.0, "mirror": False, "cells": True, "arrows": None, "cmap": "viridis", "surface": None,
    "percentiles": None, "rigid": True, "triad": True,
}  # fmt: skip


def pressed(cell, general=False):
    b = blocks(COMM, cell, 2, 2)
    contact = uem.GeneralContact() if general else uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact])
    problem.solve()
    return problem, contact


@pytest.mark.parametrize("general", [False, True])
def test_pressures_are_drawn_as_such(general):
    """By the contact, its pressure, or a list: with the same values, which follow later steps, and grey where there is none."""
    pytest.importorskip("matplotlib")
    problem, contact = pressed("triangle", general)
    drawings = [
        Drawing(problem, field=field, window=None, view=None, **USUAL) for field in (contact, contact.pressure, [contact])
    ]
    for factor in (1.0, 0.0):
        found = [drawing.take() for drawing in drawings]
        assert all(drawing.pressed and drawing.label == "contact pressure" for drawing in drawings)
        if COMM.rank == 0:
            for frame in found:
                np.testing.assert_array_equal(frame.values, found[0].values)
                assert (frame.values.max() > 1e-6) == (factor > 0) and (frame.values == 0).any()
        # released
        for bc in problem.bodies.bcs:
            bc.g.value[...] = 0.0
        problem.solve()
    refused(uem.InputError, "field", lambda: Drawing(problem, field=problem.u, window=None, view=None, **USUAL))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_sections_are_seen(side):
    """The default view looks at the faces that the window cuts; a view of the user's own is kept."""
    pytest.importorskip("pyvista")
    from ctypes.util import find_library

    if not any(map(find_library, ("EGL", "OSMesa"))):
        pytest.skip("nothing to draw with")
    problem, _ = pressed("hexahedron")
    window = [-9.0, 9.0, -9.0, 0.4, -9.0, 9.0] if side > 0 else [-9.0, 9.0, 0.4, 9.0, -9.0, 9.0]
    usual = {**USUAL, "window": window, "field": None}
    view = Drawing(problem, view=None, **usual).view
    np.testing.assert_allclose(view, np.array([1.0, side, 1.0]) / np.sqrt(3.0))
    np.testing.assert_allclose(Drawing(problem, view=(0.0, 0.0, 2.0), **usual).view, [0.0, 0.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("axis, side", [(0, 1.0), (1, -1.0), (2, 1.0)])
def test_the_colour_of_a_section(axis, side):
    """A field that is largest on the face that the window cuts: a quarter of the picture has its colour, and nothing from behind."""
    pytest.importorskip("pyvista")
    from ctypes.util import find_library
    from io import BytesIO

    if not any(map(find_library, ("EGL", "OSMesa"))):
        pytest.skip("nothing to draw with")
    problem, _ = pressed("hexahedron")
    place = fem.Function(uem.function_space(problem.config.mesh, 1))
    place.interpolate(lambda x: side * x[axis])
    window, shares = np.array([[-9.0, 9.0]] * 3), []
    window[axis, 1 if side > 0 else 0] = 0.3
    for view in (None, -side * np.eye(3)[axis] - 0.1):
        picture = uem.plot_scene(problem, field=place, window=window.ravel(), view=view, scale=0.0, levels=8, dpi=80)
        if COMM.rank == 0:
            from matplotlib.image import imread

            image = imread(BytesIO(picture._repr_png_()))[..., :3]
            # without the colour bar
            image = image[:, : int(0.7 * image.shape[1])]
            body = (np.ptp(image, axis=2) > 0.1).sum()
            # yellow, in any light; lower values are green and blue
            red, green, blue = np.moveaxis(image, 2, 0)
            shares.append(((red > 0.9 * green) & (blue < 0.5 * red)).sum() / body)
    if COMM.rank == 0:
        assert shares[0] > 0.25 and shares[1] < 0.1, shares
