"""What a link mesh gets wrong of the solid whose Young's modulus it was given: error of the model, not of a solver.

A tube with the wall of the task single-stitch, 4 mm long, under small loads, one by one: *pressure* from inside widens
it (Lamé's thick tube with open ends), *stretch* lengthens and *twist* turns it (F l / E A, T l / G J), a force across
its free end makes *bending* of it (Timoshenko's beam), two opposite lines of force *squeeze* it flat (the widening of
Winkler's thick ring, itself within 3 %). Its far end is clamped, but squeezed it is free. All but the deflection of
bending are measured in the middle, away from the ends. *cubes* are split into five as the cells of the wall are, and
stretched along their sides, the diagonals of their faces, and their own: their modulus over the one they were made of.

Two models have the same tetrahedra, nodes and loads, and the Poisson ratio 1/4 that links have by themselves. Linear
finite elements show what the mesh is to blame for, with one cell across the wall; what they get right and the link mesh
does not is the links', and more nodes do not cure it. Both matrices have the same zeros. The time is that of the matrix
and of one sparse direct solve; of the cubes, which need none, that of making their links. How exactly a scene solves
its links is another error, and a far smaller one: that of the section on the static equilibrium. The thread's model,
which leaves out weight, inertia and stiffness, is follow-the-leader in the section on the thread, in *drag, suture*.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from trainer.anatomy.vessel import Vessel, build, wall_tetrahedra
from trainer.bench.rows import Row, median_and_p90
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.geometry import Array
from trainer.mechanics.links import blocks, link_mesh, stiffness_from_modulus
from trainer.mechanics.newton import sparse_matrix

#: As in the task single-stitch, but for the length, which keeps the ends away from the middle. mm, kPa.
OUTER_MM, WALL_MM, LENGTH_MM, MODULUS_KPA = 0.5, 0.15, 4.0, 500.0
INNER_MM = OUTER_MM - WALL_MM
POISSON = 0.25
SHEAR_KPA = MODULUS_KPA / (2.0 * (1.0 + POISSON))
AREA_MM2, SECOND_MOMENT_MM4 = math.pi * (OUTER_MM**2 - INNER_MM**2), math.pi / 4.0 * (OUTER_MM**4 - INNER_MM**4)
#: Layers and nodes around: the second has the cells of the task, the others have them of the same proportions.
MESHES = ((21, 12), (41, 24), (61, 36))
#: How often each is timed.
ROUNDS = 3
#: The error at which the models are compared.
COMPARED_AT = 0.1
ERROR_OF = "model: what the load does is off by this share of what theory says of the solid"
MODULUS_OF = "model: Young's modulus is off by this share of the one that the links were made of"
RESIDUAL_OF = "Euclidean norm of the forces that are left over, as a share of the load's"


def tube(layers: int, around: int) -> Vessel:
    """The tube, its axis along z, its cut edge at 0."""
    given = Sourced(MODULUS_KPA, "assumed: as in the task single-stitch")
    return build(
        VesselSpec(
            name="A", cut_edge_mm=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), outer_diameter_mm=2.0 * OUTER_MM,
            wall_mm=WALL_MM, length_mm=LENGTH_MM, layers=layers, around=around, modulus_kPa=given,
            puncture_outer_mN=given, puncture_inner_mN=given, tear_mN=given,
        )
    )  # fmt: skip


def links_matrix(rest: Array, cells: np.ndarray) -> csc_matrix:
    """Stiffness (3 n, 3 n) mN/mm of the links that a vessel of the tetrahedra ``cells`` (t, 4) has, at rest (n, 3)."""
    links, stiffness = stiffness_from_modulus(rest, cells, MODULUS_KPA)
    mesh = link_mesh(rest, links, stiffness, np.zeros(len(rest), dtype=bool))
    return sparse_matrix(mesh, blocks(mesh, rest))


def solid_matrix(rest: Array, cells: np.ndarray) -> csc_matrix:
    """Stiffness (3 n, 3 n) mN/mm of linear finite elements of an isotropic solid in the same tetrahedra.

    Shape functions a, b with constant gradients g in a tetrahedron of volume V: the 3 × 3 block between their nodes is
    V (λ g_a g_bᵀ + μ g_b g_aᵀ + μ g_a·g_b I) (Hughes, The Finite Element Method, chapter 2).
    """
    edges = rest[cells[:, 1:]] - rest[cells[:, :1]]
    volume = np.abs(np.linalg.det(edges)) / 6.0
    g = np.linalg.inv(edges).transpose(0, 2, 1)
    g = np.concatenate([-g.sum(axis=1, keepdims=True), g], axis=1)
    lame = 2.0 * SHEAR_KPA * POISSON / (1.0 - 2.0 * POISSON)
    block = lame * np.einsum("t,tai,tbj->tabij", volume, g, g) + SHEAR_KPA * (
        np.einsum("t,taj,tbi->tabij", volume, g, g) + np.einsum("t,tak,tbk,ij->tabij", volume, g, g, np.eye(3))
    )
    place = 3 * cells[:, :, None] + np.arange(3)
    row, column = np.broadcast_arrays(place[:, :, None, :, None], place[:, None, :, None, :])
    return csc_matrix((block.ravel(), (row.ravel(), column.ravel())), shape=(rest.size, rest.size))


MODELS: dict[str, Callable[[Array, np.ndarray], csc_matrix]] = {
    "link mesh": links_matrix,
    "linear finite elements": solid_matrix,
}


def _shared(x: Array, triangles: np.ndarray, each: Array) -> Array:
    """Forces (n, 3): a third of the force (f, 3) on a triangle to each of its corners."""
    out = np.zeros_like(x)
    for k in range(3):
        np.add.at(out, triangles[:, k], each / 3.0)
    return out


def _areas(x: Array, triangles: np.ndarray) -> Array:
    a, b, c = (x[triangles[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2.0)


def _at(t: Vessel, layer: int) -> np.ndarray:
    """The nodes (2, around) of a layer, outer hull first."""
    return np.arange(2 * t.spec.around).reshape(2, -1) + 2 * t.spec.around * layer


def _middle(t: Vessel) -> tuple[np.ndarray, np.ndarray, float]:
    """The nodes of the layers at a quarter and three quarters, and the distance between them, mm."""
    low = (t.spec.layers - 1) // 4
    high = t.spec.layers - 1 - low
    return _at(t, low).ravel(), _at(t, high).ravel(), (high - low) * t.layer_mm


def _end_force(t: Vessel, direction: Array) -> Array:
    """A force of 1 mN along ``direction`` (3,), spread evenly over the cut."""
    area = np.linalg.norm(_areas(t.mesh.rest, t.cut_triangles), axis=1)
    return _shared(t.mesh.rest, t.cut_triangles, (area / area.sum())[:, None] * direction)


def pressure(t: Vessel) -> Array:
    """1 kPa from inside, (n, 3) mN."""
    return _shared(t.mesh.rest, t.inner_triangles, _areas(t.mesh.rest, t.inner_triangles))


def widened(t: Vessel, u: Array) -> float:
    """The lumen's mean widening in the middle over Lamé's (Timoshenko and Goodier, section 28; plane stress)."""
    nodes = _at(t, t.spec.layers // 2)[1]
    radial = t.mesh.rest[nodes, :2] / INNER_MM
    mean = float(np.einsum("na,na->n", u[nodes, :2], radial).mean())
    a2, b2 = INNER_MM**2, OUTER_MM**2
    return mean / (INNER_MM / MODULUS_KPA * ((a2 + b2) / (b2 - a2) + POISSON))


def stretch(t: Vessel) -> Array:
    return _end_force(t, -t.axis)


def lengthened(t: Vessel, u: Array) -> float:
    """The middle half's lengthening over F l / (E A)."""
    low, high, length = _middle(t)
    return float(u[high, 2].mean() - u[low, 2].mean()) / (length / (MODULUS_KPA * AREA_MM2))


def bending(t: Vessel) -> Array:
    return _end_force(t, np.array([1.0, 0.0, 0.0]))


def deflected(t: Vessel, u: Array) -> float:
    """The cut's mean deflection over that of Timoshenko's beam, F L³ / (3 E I) + F L / (κ G A).

    κ of a hollow circle: Cowper (1966), J. Appl. Mech. 33:335.
    """
    m2 = (INNER_MM / OUTER_MM) ** 2
    ring = (1.0 + m2) ** 2
    kappa = 6.0 * (1.0 + POISSON) * ring / ((7.0 + 6.0 * POISSON) * ring + (20.0 + 12.0 * POISSON) * m2)
    expected = LENGTH_MM**3 / (3.0 * MODULUS_KPA * SECOND_MOMENT_MM4) + LENGTH_MM / (kappa * SHEAR_KPA * AREA_MM2)
    return float(u[_at(t, 0), 0].mean()) / expected


def twist(t: Vessel) -> Array:
    """A moment of 1 mN mm about the axis, shear in proportion to the radius."""
    x = t.mesh.rest
    even = np.linalg.norm(_end_force(t, t.axis), axis=1)
    force = even[:, None] * np.cross(t.axis, x)
    return np.asarray(force / np.cross(x, force)[:, 2].sum())


def turned(t: Vessel, u: Array) -> float:
    """The turn of the middle half over T l / (G J), J = 2 I."""
    low, high, length = _middle(t)
    x = t.mesh.rest
    angle = [float((np.cross(x[k], u[k])[:, 2] / np.sum(x[k, :2] ** 2, axis=1)).mean()) for k in (low, high)]
    return (angle[0] - angle[1]) / (length / (SHEAR_KPA * 2.0 * SECOND_MOMENT_MM4))


def squeeze(t: Vessel) -> Array:
    """1 mN per mm of length on the outermost line at 12 o'clock and at 6, inwards."""
    out = np.zeros_like(t.mesh.rest)
    for j in (0, t.spec.around // 2):
        for layer in range(t.spec.layers):
            node = t.node(layer, j)
            share = 0.5 if layer in (0, t.spec.layers - 1) else 1.0
            out[node, :2] -= share * t.layer_mm * t.mesh.rest[node, :2] / OUTER_MM
    return out


def flattened(t: Vessel, u: Array) -> float:
    """How far 3 and 9 o'clock part, in the middle and of both hulls, over a thick ring's.

    W R³ / (E' I) (k1 / 2 - k2 + 2 k2² / π) with k1 = 1 - α + β, k2 = 1 - α, α = I / (A R²), β = 6/5 E' I / (G A R²)
    (Young and Budynas, Roark's Formulas, table 9.2, case 1); E' = E / (1 - ν²), because a long wall's bending around
    cannot bend it along.
    """
    radius = OUTER_MM - 0.5 * WALL_MM
    inertia, modulus = WALL_MM**3 / 12.0, MODULUS_KPA / (1.0 - POISSON**2)
    alpha = inertia / (WALL_MM * radius**2)
    beta = 1.2 * modulus * inertia / (SHEAR_KPA * WALL_MM * radius**2)
    k1, k2 = 1.0 - alpha + beta, 1.0 - alpha
    expected = radius**3 / (modulus * inertia) * (0.5 * k1 - k2 + 2.0 * k2**2 / math.pi)
    nodes = _at(t, t.spec.layers // 2)
    quarter = t.spec.around // 4
    apart = u[nodes[:, quarter]] - u[nodes[:, 3 * quarter]]
    way = t.mesh.rest[nodes[:, quarter]] - t.mesh.rest[nodes[:, 3 * quarter]]
    return float(np.mean(np.einsum("na,na->n", apart, way) / np.linalg.norm(way, axis=1))) / expected


#: A load, and what it does over what theory says. Squeezed, the tube is free: its loads are in balance.
LOADS: dict[str, tuple[Callable[[Vessel], Array], Callable[[Vessel, Array], float]]] = {
    "pressure": (pressure, widened),
    "stretch": (stretch, lengthened),
    "bending": (bending, deflected),
    "twist": (twist, turned),
    "squeeze": (squeeze, flattened),
}


def held(t: Vessel, load: str) -> np.ndarray:
    """Which coordinates (3 n,) stay: the clamp's, or where the loads are in balance six that stop a rigid motion."""
    if load != "squeeze":
        return np.repeat(t.mesh.fixed, 3)
    out = np.zeros_like(t.mesh.rest, dtype=bool)
    first, last, across = t.node(0, 0), t.node(t.spec.layers - 1, 0), t.node(0, t.spec.around // 2)
    side = int(np.argmin(np.abs(t.twelve[:2])))
    out[first] = True
    out[last, :2] = True
    out[across, side] = True
    return out.ravel()


def displacements(t: Vessel, matrix: csc_matrix, load: str) -> tuple[Array, float]:
    """Of all nodes (n, 3) mm under a load of LOADS, and what is left over of the load, as a share."""
    free = ~held(t, load)
    stiffness, force = matrix[free][:, free], LOADS[load][0](t).ravel()[free]
    u = np.zeros(t.mesh.rest.size)
    u[free] = splu(stiffness, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(force)
    return u.reshape(-1, 3), float(np.linalg.norm(stiffness @ u[free] - force) / np.linalg.norm(force))


def under_loads(layers: int, around: int, rounds: int) -> list[Row]:
    """Each load on each model of the tube; the models take turns."""
    t, cells = tube(layers, around), wall_tetrahedra(layers, around)
    rows = []
    for load, (_, over_theory) in LOADS.items():
        ms: dict[str, list[float]] = {name: [] for name in MODELS}
        found: dict[str, tuple[float, float]] = {}
        for _ in range(rounds):
            for name, matrix in MODELS.items():
                begun = perf_counter()
                u, left_over = displacements(t, matrix(t.mesh.rest, cells), load)
                ms[name].append((perf_counter() - begun) * 1e3)
                found[name] = over_theory(t, u), left_over
        rows += [
            _row(load, len(t.mesh.rest), name, f"{around} around", ms[name], *found[name], ERROR_OF) for name in MODELS
        ]
    return rows


#: Directions in a cube.
ALONG = {"sides": (1.0, 0.0, 0.0), "face diagonals": (1.0, 1.0, 0.0), "body diagonals": (1.0, 1.0, 1.0)}
#: The six components of a symmetric tensor.
PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def modulus(direction: tuple[float, float, float]) -> float:
    """Young's modulus over the given one, along ``direction`` of cubes split into five: 6/5, 12/13, 6/7 (``ALONG``).

    C_ijkl = Σ k L² n_i n_j n_k n_l / V over the links of a cell (``links.stiffness_from_modulus``), in a body of
    mirrored cells where every inner node is in balance under a uniform strain; 1 / E(n) = S_ijkl n_i n_j n_k n_l.
    """
    corners = np.array([(a, b, c) for a in (0.0, 1.0) for b in (0.0, 1.0) for c in (0.0, 1.0)])
    links, k = stiffness_from_modulus(corners, wall_tetrahedra(2, 2)[:5], 1.0)
    d = corners[links[:, 1]] - corners[links[:, 0]]
    stiffness = [[float(np.sum(k * d[:, a] * d[:, b] * d[:, e] * d[:, f] / np.sum(d * d, axis=1)))
                  for e, f in PAIRS] for a, b in PAIRS]  # fmt: skip
    n = np.array(direction) / math.hypot(*direction)
    stress = np.array([n[a] * n[b] for a, b in PAIRS])
    return float(1.0 / (stress @ np.linalg.solve(np.array(stiffness), stress)))


def of_cubes() -> list[Row]:
    rows = []
    for name, direction in ALONG.items():
        ms = []
        for _ in range(ROUNDS):
            begun = perf_counter()
            found = modulus(direction)
            ms.append((perf_counter() - begun) * 1e3)
        rows.append(_row(f"cubes along {name}", 8, "link mesh", "split into five", ms, found, 0.0, MODULUS_OF))
    return rows


def _row(
    case: str, size: int, model: str, setting: str, ms: list[float], ratio: float, left_over: float, error_of: str
) -> Row:
    median, p90 = median_and_p90(ms)
    status = f"{ratio:.3g} times theory"
    return Row(
        case,
        size,
        model,
        setting,
        len(ms),
        median,
        p90,
        abs(ratio - 1.0),
        error_of,
        left_over,
        status,
        RESIDUAL_OF,
        COMPARED_AT,
    )


def measure(quick: bool) -> list[Row]:
    """All rows, those of the tube first; ``quick`` leaves out the finest mesh."""
    under_loads(5, 8, 1)  # compiles
    meshes, rounds = (MESHES[:2], 1) if quick else (MESHES, ROUNDS)
    return [row for mesh in meshes for row in under_loads(*mesh, rounds)] + of_cubes()
