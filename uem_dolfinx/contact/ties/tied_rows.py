"""Rows of tied contactors, which keep their position relative to the target below, permanently and in all components.

With the target's shape functions N_a at the closest point of a contactor, its height h and the unit normal n there, at the time of
tying,

    x_i - sum_a N_a x_a - h n(x_a) = 0.

Without a gap, weights are constant; a gap keeps its width and rotates with the target. With mortar this holds in means over the
facets, weighted with dual functions psi_i, whose integrals with the contactor's shape functions are C_ij:

    sum_j C_ij x_j - int psi_i (sum_a N_a x_a + h n) = 0.

Dirichlet conditions may prescribe a component of a contactor and of the nodes that it follows, as on a plane of symmetry. For
this component its dual function is then added to the function of a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, NEGLIGIBLE, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, cross_products, sums_of_rows
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.mortar.duals import Duals, add_up, dual_functions, products
from uem_dolfinx.contact.mortar.rows import Elimination, Terms, WeightedRows, terms_of
from uem_dolfinx.contact.mortar.segment_motions import skew
from uem_dolfinx.contact.seam.active_set import GAP_ROUNDING
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.projection import FacetProjection, Target
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import Tabulated, beneath, unit_normals
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class Spacers:
    """Positions of contactors with a gap, which rotates with the target."""

    contactor: Ints  # global nodes with a part in each position ``(p, k)``
    weight: Array  # their weights in each component ``(p, k, gdim)``
    followed: Ints  # global nodes of the facet below ``(p, nt)``
    dN: Array  # derivatives of their shape functions at the closest point ``(p, nt, fdim)``
    height: Array  # height along the facet's normal ``(p,)``
    y: Array  # positions of the facet's nodes at the time of tying ``(p, nt, gdim)``

    def take(self, which: Bools) -> Spacers:
        """A subset of the spacers."""
        return replace(self, **{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def turning(self, y: Array) -> tuple[Array, Array, Array, Array]:
        """Area vectors with the facet's nodes at ``y (p, nt, gdim)``: lengths, unit normals, their projectors, and derivatives.

        The derivatives are those of the area vectors by the nodes ``(p, nt, gdim, gdim)``.
        """
        t, g = np.einsum("paf,pag->pfg", self.dN, y), y.shape[2]
        if g == 2:
            a = np.stack([t[:, 0, 1], -t[:, 0, 0]], axis=1)
            slopes = self.dN[:, :, 0, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]])
        else:
            a = cross_products(t[:, 0], t[:, 1])
            slopes = self.dN[:, :, 1, None, None] * skew(t[:, 0])[:, None] - self.dN[:, :, 0, None, None] * skew(t[:, 1])[:, None]
        length = np.linalg.norm(a, axis=1)
        n = a / length[:, None]
        return length, n, np.eye(g) - n[:, :, None] * n[:, None, :], slopes

    def at(self, y: Array, kept: bool) -> tuple[Array, Array]:
        """Offsets ``h n (p, gdim)`` with the facets' nodes at ``y``, and their derivatives ``(p, nt, gdim, gdim)``.

        If ``kept``, they are linearised at the time of tying.
        """
        length, n, across, slopes = self.turning(self.y if kept else y)
        slopes = (self.height / length)[:, None, None, None] * (across[:, None] @ slopes)
        offset = self.height[:, None] * n
        return (offset + np.einsum("pagh,pah->pg", slopes, y - self.y) if kept else offset), slopes

    def curvature(self, y: Array, force: Array) -> Array:
        """Second derivatives of ``force . h n`` for forces ``(p, gdim)``: ``(p, nt gdim, nt gdim)``."""
        length, n, across, slopes = self.turning(y)
        (p, nt, g), scaled = y.shape, force * self.height[:, None]
        c = np.einsum("pgh,ph->pg", across, scaled) / length[:, None]
        lean = c[:, :, None] * n[:, None, :]
        along = np.einsum("pg,pg->p", scaled, n) / length**2
        inner = -(lean + lean.transpose(0, 2, 1)) / length[:, None, None] - along[:, None, None] * across
        H = np.einsum("paig,pij,pbjh->pagbh", slopes, inner, slopes)
        if g == 3:
            twist = self.dN[:, :, None, 0] * self.dN[:, None, :, 1]
            H -= np.einsum("pab,pgh->pagbh", twist - twist.transpose(0, 2, 1), skew(c))
        return H.reshape(p, nt * g, nt * g)


@dataclass(frozen=True)
class TiedRows:
    """Equations of tied contactors."""

    elimination: Elimination  # assembly of rows
    has: Bools  # components in which contactors have an equation ``(n, gdim)``
    own: Array  # divisors of these equations ``(n, gdim)``
    #: parts of these divisors from the facets on the contactor's own side of a seam ``(n, gdim)``; None for nodal equations.
    side: Array | None
    #: forces over multipliers ``(n, gdim)``; with mortar multipliers are mean tractions, otherwise nodal forces and share is 1.
    share: Array
    area: Array | None  # reference areas for these forces ``(n,)``; None for nodal forces
    terms: Terms  # contactors, global nodes and weights by which they follow ``(k,)``, ``(k,)``, ``(k, gdim)``
    spacers: Spacers | None  # positions with kept gaps; None if no rank has a gap
    held: Array | None  # tied positions on a rigid target in its reference position ``(n, gdim)``; None on a mesh
    kept: bool  # whether normals are constant, as with small and fixed sliding

    @property
    def config(self) -> Configuration:
        """Configuration of the displacement."""
        return self.elimination.config

    @property
    def nodes(self) -> Indices:
        """Owned contactor nodes ``(n,)``."""
        return self.elimination.nodes

    @cached_property
    def _halo(self) -> Halo:
        """The nodes that contactors follow (first time: collective)."""
        return Halo(self.config, self.terms[1])

    @cached_property
    def _below(self) -> Halo | None:
        """The nodes of the facets below spacers (first time: collective)."""
        return None if self.spacers is None else Halo(self.config, self.spacers.followed.ravel())

    def _y(self) -> Array:
        """Current positions of the facet nodes below spacers ``(p, nt, gdim)`` (collective)."""
        assert self._below is not None and self.spacers is not None
        return self._below.take(self.config.x.__getitem__).reshape(self.spacers.y.shape)

    def equations(self, motion: Motion | None) -> UnitingEquations:
        """All equations in the current configuration, sorted by contactor (collective)."""
        config, n, g = self.config, len(self.nodes), self.config.gdim
        row, followed, weight = self.terms
        apart = config.x[self.nodes]
        if self.held is not None:
            apart = apart - (self.held if motion is None else motion.carry(self.held))
        else:
            apart = apart - sums_of_rows(row, weight * self._halo.take(config.x.__getitem__), n)
        if self.side is not None:
            apart = apart + self.elimination.seam.apart(self.nodes, self.side / self.own, config.x[: config.n_owned])
        at, c = np.nonzero(weight)
        # contactors, components, followed nodes and coefficient vectors
        parts = [(row[at], c, followed[at], weight[at, c, None] * np.eye(g)[c])]
        if self.spacers is not None:
            offset, slopes = self.spacers.at(self._y(), self.kept)
            w, to = self.spacers.weight, self.spacers.contactor
            pushed = np.einsum("pkg,pg->pkg", w, offset).reshape(-1, g)
            apart = apart - self.elimination.total(to.ravel(), pushed) / self.own
            turned = np.einsum("pkg,pagh->pkagh", w, slopes).reshape(*to.shape, slopes.shape[1], g * g)
            i, a, value = self.elimination.at_owners([terms_of(to, self.spacers.followed, turned)], np.ones(n))
            value = value.reshape(-1, g, g) / self.own[i][:, :, None]
            parts.append((np.repeat(i, g), np.tile(np.arange(g), len(i)), np.repeat(a, g), value.reshape(-1, g)))
        rows, component, nodes, vectors = (np.concatenate(part) for part in zip(*parts))
        i, c = np.nonzero(self.has)
        place = np.full((n, g), -1, dtype=np.int64)
        place[i, c] = np.arange(len(i))
        equation = place[rows, component]
        there = equation >= 0
        return UnitingEquations(
            self.nodes[i], np.eye(g)[c], apart[i, c], np.ones(len(i), bool), equation[there], nodes[there], vectors[there]
        )

    def handed_on(self, equations: UnitingEquations, multipliers: Array) -> tuple[Ints, Array]:
        """Global nodes ``(k,)`` and forces ``(k, gdim)`` on both bodies of ``multipliers (n, gdim)`` of the equations."""
        nodes = np.concatenate([self.config.to_global(equations.node), equations.followed])
        return nodes, equations.forces(multipliers[self.has])

    def curvature(self, multipliers: Array) -> list[tuple[Ints, Array]]:
        """Blocks of minus the derivatives of the rows times ``multipliers (n, gdim)``, as in ``Kinematics`` (collective)."""
        s = self.spacers
        if s is None or self.kept:
            return []
        own = np.zeros((self.config.n_owned, multipliers.shape[1]))
        own[self.nodes] = multipliers / self.own
        own = self.elimination.seam.sums(own)
        theirs = self.config.ask_owners(s.contactor.ravel(), own)
        force = np.einsum("pkg,pkg->pg", s.weight, theirs.reshape(s.weight.shape))
        return [(s.followed, s.curvature(self._y(), force))]


def to_surface(config: Configuration, nodes: Indices, target: Target, which: Bools) -> TiedRows:
    """Rows of the contactors ``which (n,)`` on a rigid target at the current positions."""
    n, g = len(nodes), config.gdim
    points = config.x[nodes]
    held = points if target.motion is None else target.motion.back(points)
    none: Terms = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, g)))
    has = np.repeat(which[:, None], g, axis=1)
    return TiedRows(Elimination(config, nodes), has, np.ones((n, g)), None, np.ones((n, g)), None, none, None, held, True)


def to_facets(
    config: Configuration, nodes: Indices, target: MeshTarget, p: FacetProjection, which: Bools, kept: bool
) -> TiedRows:
    """Rows of the contactors ``which (n,)``, each at the closest point of its projection p (collective)."""
    n, g, i = len(nodes), config.gdim, np.flatnonzero(which)
    points = config.x[nodes[i]]
    tab, height = foot_below(target, p.x[i], p.xi[i], points)
    row, a = np.nonzero(np.abs(tab.N) > NEGLIGIBLE)
    terms: Terms = (i[row], p.nodes[i][row, a], np.repeat(tab.N[row, a, None], g, axis=1))
    one = np.ones((len(i), 1, g))
    spacers = Spacers(config.to_global(nodes[i])[:, None], one, p.nodes[i], tab.dN, height, p.x[i])
    has = np.repeat(which[:, None], g, axis=1)
    made, one = Elimination(config, nodes), np.ones((n, g))
    return TiedRows(made, has, one, None, one, None, terms, _standing(config, spacers), None, kept)


def to_means(discretisation: Mortar, rows: WeightedRows, which: Bools, kept: bool) -> TiedRows:
    """Rows of the contactors ``which (n,)`` as means over the segments of contact (collective).

    Args:
        discretisation: of the contactors.
        rows: rows of contact in the current configuration.
        which: contactors to be tied, if they are covered.
        kept: see ``TiedRows``.
    """
    d, at, config, g = discretisation, rows.points, discretisation.config, discretisation.config.gdim
    assert isinstance(d.target, MeshTarget)
    s, own = at.segments, at.nodes
    e, q = at.facet, at.facet[s.pair]
    tab, height, N, components = below(d, rows)
    k, nc, nt = N.shape
    by_node, followed = np.zeros((len(own), nc, nc, g)), np.zeros((k, nc, nt, g))
    psi = np.zeros((len(s.pair), nc, g))
    for c, duals in enumerate(components):
        by_node[..., c] = duals.C @ d.basis.T
        followed[..., c] = duals.A[e] @ N
        psi[..., c] = s.weight[:, None] * np.einsum("qib,qb->qi", duals.A[q], at.b)
    same = d.elimination.seam.same(own)[..., None]
    own_parts = np.concatenate([(by_node * same).sum(axis=2), at.duals.C.sum(axis=2)[..., None]], axis=2).reshape(-1, g + 1)
    whole, area = np.split(d.elimination.total(own.ravel(), own_parts), [g], axis=1)
    has = (whole > 0.0) & which[:, None]
    scale = np.where(has, whole, 1.0)
    row, term, value = d.elimination.at_owners(
        [terms_of(own, own, -by_node * ~same), terms_of(own[e], at.opposite, followed)], np.ones(len(d.nodes))
    )
    value = np.where(has[row], value / scale[row], 0.0)
    there = (np.abs(value) > NEGLIGIBLE).any(axis=1)
    tied = config.from_owners(d.nodes, has.astype(float), d.surface.dofs[rows.facets].ravel()).reshape(*own.shape, g)
    spacers = Spacers(own[q], psi * tied[q], at.opposite[s.pair], tab.dN, height, at.y[s.pair])
    terms: Terms = (row[there], term[there], value[there])
    return TiedRows(
        d.elimination, has, scale, d.elimination.sides(own, by_node), area / scale, area[:, 0] / (rows.stretch * rows.sharing),
        terms, _standing(config, spacers), None, kept,
    )  # fmt: skip


def below(d: Mortar, rows: WeightedRows) -> tuple[Tabulated, Array, Array, list[Duals]]:
    """Closest points of the target at the points of segments of contact (collective).

    Returns:
        Shape functions there, heights ``(q,)``, integrals of the contactor's functions times them ``(k, nc, nt)``, and the dual
        functions of each component.
    """
    at, s = rows.points, rows.points.segments
    assert isinstance(d.target, MeshTarget)
    tab, height = foot_below(d.target, at.y[s.pair], s.eta, np.einsum("qa,qag->qg", at.phi, at.x[at.facet[s.pair]]))
    k, nc, nt = len(at.facet), at.b.shape[1], tab.N.shape[1]
    N = add_up(s.pair, products(s.weight[:, None] * at.b, tab.N), k).reshape(k, nc, nt)
    return tab, height, N, _duals(d, rows, N)


def _duals(d: Mortar, rows: WeightedRows, N: Array) -> list[Duals]:
    """Dual functions for each component (collective).

    If a node and the nodes that it follows are prescribed, as on a plane of symmetry, its function is added to the functions of
    other nodes. Its own equation would constrain nodes next to the plane. Facets with all nodes prescribed are excepted.

    Args:
        d: of the contactors.
        rows: of contact.
        N: integrals of the functions of the contactor's basis times the target's shape functions, pair by pair ``(k, nn, nt)``.
    """
    at, config, g = rows.points, d.config, d.config.gdim
    if not d.setting.prescribed:
        return [at.duals] * g
    covered, dofs, none = at.covered, d.surface.dofs[rows.facets], np.zeros(at.covered.D.shape, dtype=bool)
    part, ratio = d.covered_part(dofs, covered)
    first = d.precedence(ratio[dofs], dofs)
    fixed = np.where(d.setting.free, 0.0, 1.0)
    theirs = config.ask_owners(at.opposite.ravel(), fixed).reshape(*at.opposite.shape, g)
    follows = np.abs(at.duals.A[at.facet] @ N) @ theirs
    follows = d.elimination.total(at.nodes[at.facet].ravel(), follows.reshape(-1, g))
    both = ~d.free & (follows > MOSTLY_PRESCRIBED * part[d.nodes, None])
    held = config.from_owners(d.nodes, both.astype(float), dofs.ravel()).reshape(*dofs.shape, g) > 0.5
    held &= ~held.all(axis=1, keepdims=True)
    found = []
    for c in range(g):
        # never sufficiently covered, and last in precedence
        without = replace(covered, full=np.where(held[..., c], np.inf, covered.full))
        found.append(dual_functions(without, np.where(held[..., c], -1.0, first), none))
    return found


def foot_below(target: MeshTarget, y: Array, xi: Array, points: Array) -> tuple[Tabulated, Array]:
    """Shape functions of facets ``y (p, nt, gdim)`` below ``points (p, gdim)``, near ``xi (p, fdim)``, and the heights ``(p,)``."""
    _, tab = beneath(target.shape, y, xi, points)
    foot = np.einsum("pa,pag->pg", tab.N, y)
    return tab, np.einsum("pg,pg->p", unit_normals(tab, y), points - foot)


def _standing(config: Configuration, spacers: Spacers) -> Spacers | None:
    """Spacers whose height exceeds rounding; None if no rank has any (collective)."""
    high = np.abs(spacers.height) > GAP_ROUNDING * config.size
    return spacers.take(high) if reduced(config.comm, bool(high.any()), op=MPI.LOR) else None
