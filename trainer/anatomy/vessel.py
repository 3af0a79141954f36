"""A vessel end: a double-hulled tube of links, clamped at its far end (Brown et al. 2001, section 3).

Two cylinders of nodes, outer and inner, stand in evenly spaced layers from the cut edge (layer 0) to the clamp (the
last layer, whose nodes are fixed). Each cell of the wall, between two layers and two neighbours around, is split into
five tetrahedra, mirrored from cell to cell so that their faces meet; the links are the tetrahedra's edges.

A place on the wall is told in material coordinates, which do not change when the wall deforms: the distance from the
cut edge along the vessel (mm) and the clock angle (rad, 0 at 12 o'clock). Twelve o'clock is the scene's +z made
perpendicular to the axis (+y for an axis along z), and three o'clock points the same way for both directions of an
axis, so that equal clock angles of two facing ends lie opposite each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from trainer.curriculum import VesselSpec
from trainer.geometry import Array, cross, fit_rotation, unit
from trainer.mechanics.links import LinkMesh, link_mesh, stiffness_from_modulus

Hull = Literal["outer", "inner"]

#: The ring that tells a wall's undented attitude begins at this distance, in wall thicknesses, and is at least as wide.
RING_WALLS = 4.0


@dataclass(frozen=True)
class Vessel:
    """One vessel end at rest, in the scene frame. Node (layer · 2 + hull) · around + j; hull 0 is the outer one."""

    spec: VesselSpec
    mesh: LinkMesh
    axis: Array  # (3,) unit vector from the cut into the end
    twelve: Array  # (3,) unit vector towards 12 o'clock
    three: Array  # (3,) unit vector towards 3 o'clock
    axial_mm: Array  # (n,) distance of a node from the cut edge
    clock: Array  # (n,) rad, 0 <= clock < 2 pi
    outer_triangles: np.ndarray  # (f, 3) int32, normals away from the vessel's axis
    inner_triangles: np.ndarray  # (f, 3) int32, normals away from the vessel's axis, into the wall
    cut_triangles: np.ndarray  # (2 around, 3) int32, the cut edge; normals against ``axis``
    display_triangles: np.ndarray  # (g, 3) int32, the closed surface of the wall, normals out of the wall
    elimination: np.ndarray  # (free nodes,) int32, an order in which the stiffness has a narrow band

    @property
    def outer_radius_mm(self) -> float:
        return 0.5 * self.spec.outer_diameter_mm

    @property
    def layer_mm(self) -> float:
        """Distance between two layers."""
        return self.spec.length_mm / (self.spec.layers - 1)

    def node(self, layer: int, j: int, hull: Hull = "outer") -> int:
        """Index of a node; ``j`` counts around from 12 o'clock and wraps."""
        return (layer * 2 + (hull == "inner")) * self.spec.around + j % self.spec.around


@dataclass(frozen=True)
class Tissue:
    """Several vessel ends as one mesh in the world frame; they share no link."""

    vessels: tuple[Vessel, ...]
    offset: tuple[int, ...]  # first node of each vessel, then the number of nodes
    mesh: LinkMesh  # rest positions in the world frame

    def nodes(self, vessel: int) -> slice:
        """The rows of a vessel's nodes in arrays over all nodes."""
        return slice(self.offset[vessel], self.offset[vessel + 1])

    def orders(self) -> tuple[np.ndarray, ...]:
        """For each vessel its free nodes in elimination order, as indices into all nodes."""
        return tuple((v.elimination + o).astype(np.int32) for v, o in zip(self.vessels, self.offset, strict=False))


@dataclass(frozen=True)
class Ring:
    """Outer-hull nodes around a place on the wall, far enough away that a dent there leaves them nearly alone."""

    nodes: np.ndarray  # (r,) of the vessel
    rest: Array  # (r, 3) mm, scene frame
    radial: Array  # (3,) the outward normal of the place at rest, scene frame


def build(spec: VesselSpec) -> Vessel:
    """The vessel end that ``spec`` describes, with links of the stiffness that its Young's modulus gives."""
    axis, twelve, three = frame(unit(spec.axis))
    layers, around = spec.layers, spec.around
    layer, hull, j = (a.ravel() for a in np.meshgrid(np.arange(layers), np.arange(2), np.arange(around), indexing="ij"))
    axial = layer * (spec.length_mm / (layers - 1))
    clock = j * (2.0 * np.pi / around)
    radius = 0.5 * spec.outer_diameter_mm - hull * spec.wall_mm
    radial = np.cos(clock)[:, None] * twelve + np.sin(clock)[:, None] * three
    rest = np.asarray(spec.cut_edge_mm) + axial[:, None] * axis + radius[:, None] * radial

    links, stiffness = stiffness_from_modulus(rest, wall_tetrahedra(layers, around), spec.modulus_kPa.value)
    # A quad's corners (layer, j), (layer + 1, j), (layer + 1, j + 1), (layer, j + 1) turn about the outward normal
    # when axis, 12 and 3 o'clock form a left-handed frame.
    left_handed = float(np.dot(cross(axis, twelve), three)) < 0.0
    outer, inner = (_hull_triangles(layers, around, h, left_handed) for h in (0, 1))
    cut = _ring_triangles(0, around, not left_handed)
    clamp = _ring_triangles(layers - 1, around, left_handed)
    return Vessel(
        spec=spec,
        mesh=link_mesh(rest, links, stiffness, layer == layers - 1),
        axis=axis,
        twelve=twelve,
        three=three,
        axial_mm=axial.astype(np.float64),
        clock=clock.astype(np.float64),
        outer_triangles=outer,
        inner_triangles=inner,
        cut_triangles=cut,
        display_triangles=np.concatenate([outer, inner[:, ::-1], cut, clamp]).astype(np.int32),
        elimination=_elimination(layers, around),
    )


def together(vessels: tuple[Vessel, ...]) -> Tissue:
    """The vessels as one mesh."""
    offset = np.concatenate([[0], np.cumsum([len(v.mesh.rest) for v in vessels])])
    joined = link_mesh(
        np.concatenate([v.mesh.rest for v in vessels]),
        np.concatenate([v.mesh.links + o for v, o in zip(vessels, offset, strict=False)]),
        np.concatenate([v.mesh.stiffness for v in vessels]),
        np.concatenate([v.mesh.fixed for v in vessels]),
    )
    return Tissue(vessels, tuple(int(o) for o in offset), joined)


def frame(axis: Array) -> tuple[Array, Array, Array]:
    """Axis, 12 o'clock and 3 o'clock, perpendicular unit vectors (3,), for a unit ``axis`` (3,).

    Three o'clock is chosen by the line of the axis, not by its direction: its y is positive, or its x where y is 0.
    """
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 1.0 - 1e-9 else np.array([0.0, 1.0, 0.0])
    twelve = unit(up - np.dot(up, axis) * axis)
    three = cross(axis, twelve)
    leading = three[1] if abs(three[1]) > 1e-9 else three[0]
    return axis, twelve, three if leading > 0.0 else -three


def wall_point(vessel: Vessel, clock: float, axial_mm: float, hull: Hull) -> tuple[np.ndarray, Array]:
    """The material point of a hull at ``clock`` rad and ``axial_mm``: nodes (3,) int32 and their weights (3,).

    The point lies on the hull's flat triangles, where both coordinates are linear. Raises ValueError outside 0 …
    length.
    """
    spec = vessel.spec
    if not 0.0 <= axial_mm <= spec.length_mm:
        raise ValueError(f"axial_mm must lie between 0 and {spec.length_mm:g}, found {axial_mm:g}")
    u = axial_mm / vessel.layer_mm
    w = (clock / (2.0 * np.pi)) % 1.0 * spec.around
    i, j = min(int(u), spec.layers - 2), min(int(w), spec.around - 1)
    u, w = u - i, w - j
    h = int(hull == "inner")
    a, b, c, d = (vessel.node(i + di, j + dj, hull) for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
    if (i + j + h) % 2 == 0:  # the diagonal joins a and c
        nodes, weights = ((a, b, c), (1.0 - u, u - w, w)) if u >= w else ((a, c, d), (1.0 - w, u, w - u))
    else:
        near = u + w <= 1.0
        nodes, weights = ((a, b, d), (1.0 - u - w, u, w)) if near else ((b, c, d), (1.0 - w, u + w - 1.0, 1.0 - u))
    return np.array(nodes, dtype=np.int32), np.array(weights)


def material_coordinates(vessel: Vessel, nodes: np.ndarray, weights: Array) -> tuple[float, float]:
    """Axial distance (mm) and clock angle (rad, 0 <= clock < 2 pi) of a point on a triangle of the vessel.

    ``nodes`` (3,) are the triangle's, ``weights`` (3,) barycentric. Angles are averaged relative to the first node, so
    that a triangle across 12 o'clock is handled.
    """
    clock = vessel.clock[nodes]
    turned = (clock - clock[0] + np.pi) % (2.0 * np.pi) - np.pi
    mean = float(clock[0] + weights @ turned) % (2.0 * np.pi)
    # A tiny negative angle turns into exactly 2 pi under %.
    return float(weights @ vessel.axial_mm[nodes]), mean if mean < 2.0 * np.pi else 0.0


def ring(vessel: Vessel, clock: float, axial_mm: float) -> Ring:
    """The outer-hull nodes between four and eight wall thicknesses from a place, along the unrolled wall at rest.

    Where the mesh is so coarse that few nodes lie there, the ring is two cells wide.
    """
    spec = vessel.spec
    around = (vessel.clock - clock + np.pi) % (2.0 * np.pi) - np.pi
    distance = np.hypot(vessel.axial_mm - axial_mm, vessel.outer_radius_mm * around)
    outer = np.arange(len(distance)) // spec.around % 2 == 0
    low = RING_WALLS * spec.wall_mm
    cell = max(vessel.layer_mm, 2.0 * np.pi * vessel.outer_radius_mm / spec.around)
    high = low + max(low, 2.0 * cell)
    nodes = np.flatnonzero(outer & (distance >= low) & (distance <= high))
    radial = np.cos(clock) * vessel.twelve + np.sin(clock) * vessel.three
    return Ring(nodes, vessel.mesh.rest[nodes], radial)


def ring_normal(around: Ring, x: Array) -> Array:
    """The undented outward normal (3,) of the ring's place when the vessel's nodes are at ``x`` (n, 3)."""
    return fit_rotation(around.rest, x[around.nodes]) @ around.radial


def undented_normal(vessel: Vessel, x: Array, clock: float, axial_mm: float) -> Array:
    """Outward normal (3,) that the outer wall at a place would have without the dent in it; ``x`` (n, 3) mm, any frame.

    The radial unit vector at rest, turned by the rotation that best carries the ring around the place from rest to
    ``x``. So it is exact for an undeformed wall in any attitude, and follows the vessel when the whole end bends.

    Why not a plane through the ring: a patch of a cylinder is curved, and its nodes beside the place lie lower than
    those before and behind it, by R (1 - cos φ). Where the cut edge truncates the ring, the missing high nodes are on
    one side only, and the best plane tilts by that alone: 13.7 deg at 0.2 mm and 4.6 deg at 0.35 mm from the edge of
    an undeformed 1 mm vessel (ring of two to four walls). The rotation compares each node with itself.

    Why four to eight walls: a dent is not local at a cut edge, which gives way as a lip. A dent of one wall thickness
    (the lower half of the vessel held, 1 mm vessel) turns the normal by 1.5 deg with a ring of two to four walls at
    0.35 mm from the edge, by 0.2 deg with this one; 0.3 deg at 0.2 mm, below 0.1 deg from 0.5 mm on.

    For many calls at one place keep :func:`ring` and use :func:`ring_normal`.
    """
    return ring_normal(ring(vessel, clock, axial_mm), x)


def node_normals(x: Array, triangles: np.ndarray) -> Array:
    """Unit normals (n, 3) of the nodes ``x`` (n, 3), means over their triangles (f, 3) weighted by area.

    A node without triangles gets zeros.
    """
    a, b, c = (x[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(x)
    for k in range(3):
        np.add.at(total, triangles[:, k], face)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0.0))


def wall_tetrahedra(layers: int, around: int) -> np.ndarray:
    """Five tetrahedra (t, 4) in each cell of the wall.

    Corners with an even sum of layer, hull and j carry all diagonals: they span the middle tetrahedron, and each odd
    corner makes one with its three neighbours.
    """
    corner = np.array([(di, dh, dj) for di in (0, 1) for dh in (0, 1) for dj in (0, 1)])
    cells = []
    for i in range(layers - 1):
        for j in range(around):
            at = corner + np.array([i, 0, j])
            index = (at[:, 0] * 2 + at[:, 1]) * around + at[:, 2] % around
            odd = at.sum(axis=1) % 2 == 1
            even = index[~odd]
            cells.append(even)
            for k in np.flatnonzero(odd):
                beside = np.abs(corner - corner[k]).sum(axis=1) == 1
                cells.append(np.concatenate([[index[k]], index[beside]]))
    return np.array(cells)


def _hull_triangles(layers: int, around: int, h: int, forwards: bool) -> np.ndarray:
    """Triangles (f, 3) int32 of a hull, cut along the links; ``forwards``: each quad turns layer first, then j."""
    triangles = []
    for i in range(layers - 1):
        for j in range(around):
            a, b, c, d = (
                ((i + di) * 2 + h) * around + (j + dj) % around for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))
            )
            triangles += [(a, b, c), (a, c, d)] if (i + h + j) % 2 == 0 else [(a, b, d), (b, c, d)]
    out = np.array(triangles, dtype=np.int32)
    return out if forwards else np.ascontiguousarray(out[:, ::-1])


def _ring_triangles(i: int, around: int, forwards: bool) -> np.ndarray:
    """Triangles (2 around, 3) int32 of the wall's section at layer i; ``forwards``: hull first, then j."""
    triangles = []
    for j in range(around):
        a, b, c, d = ((i * 2 + h) * around + (j + dj) % around for h, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
        triangles += [(a, b, c), (a, c, d)] if (i + j) % 2 == 0 else [(a, b, d), (b, c, d)]
    out = np.array(triangles, dtype=np.int32)
    return out if forwards else np.ascontiguousarray(out[:, ::-1])


def _elimination(layers: int, around: int) -> np.ndarray:
    """The free nodes (f,) int32 layer by layer, zigzag around the circle: 0, 1, -1, 2, -2 …, both hulls together.

    Neighbours around are then two places apart instead of a whole circle, and the band is little wider than a layer.
    """
    zigzag = np.zeros(around, dtype=np.int64)
    zigzag[1::2] = np.arange(1, around // 2 + 1)
    zigzag[2::2] = around - np.arange(1, around // 2)
    layer, j, h = np.meshgrid(np.arange(layers - 1), zigzag, np.arange(2), indexing="ij")
    return ((layer * 2 + h) * around + j).ravel().astype(np.int32)
