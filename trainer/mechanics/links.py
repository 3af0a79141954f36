"""Link meshes: nodes joined by elastic links (Brown et al. 2001, section 3).

A link between nodes i and j at distance l, of rest length l0 and stiffness k, pulls node i towards j with
k (l - l0) mN along the unit vector u from i to j. Its energy is k (l - l0)² / 2 and the Hessian's block is

    B = k [u uᵀ + (1 - l0 / l) (I - u uᵀ)],

+B on the two diagonal blocks and -B on the two others. Where the mesh has a law of its own (``link_tension``), the
tension T stands for k (l - l0), its potential for the energy and its derivative for k:

    B = T' u uᵀ + (T / l) (I - u uᵀ).

Lengths mm, stiffness mN/mm, energy mN mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.link_tension import Branch, LinkLaw, potential_of, slip_at, tension_of

#: The six edges of a tetrahedron, as pairs of its corners.
TETRAHEDRON_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


@dataclass(frozen=True)
class LinkMesh:
    """n nodes and m elastic links, with each node's links listed one after another."""

    rest: Array  # (n, 3) mm, positions in which no link is stretched
    links: np.ndarray  # (m, 2) int32, the two nodes of a link
    rest_length: Array  # (m,) mm
    stiffness: Array  # (m,) mN/mm
    fixed: np.ndarray  # (n,) bool, nodes that never move
    start: np.ndarray  # (n + 1,) int32; node i has the entries start[i] … start[i + 1] of the next two
    neighbour: np.ndarray  # (2 m,) int32, the node at the other end
    via: np.ndarray  # (2 m,) int32, the link that leads there
    law: LinkLaw | None = None  # of the links, see ``link_law``; None: constant, all that ``equilibrium`` knows


def link_mesh(rest: Array, links: np.ndarray, stiffness: Array, fixed: np.ndarray) -> LinkMesh:
    """A mesh that is free of force at ``rest`` (n, 3). Raises ValueError for a link of no length."""
    rest = np.ascontiguousarray(rest, dtype=np.float64)
    links = np.ascontiguousarray(links, dtype=np.int32)
    length = np.linalg.norm(rest[links[:, 1]] - rest[links[:, 0]], axis=1)
    if np.any(length == 0.0):
        raise ValueError(f"link {int(np.argmin(length))} joins two nodes at the same place")
    ends = links.T.ravel()
    by_node = np.argsort(ends, kind="stable")
    start = np.zeros(len(rest) + 1, dtype=np.int32)
    np.cumsum(np.bincount(ends, minlength=len(rest)), out=start[1:])
    return LinkMesh(
        rest=rest,
        links=links,
        rest_length=length,
        stiffness=np.ascontiguousarray(stiffness, dtype=np.float64),
        fixed=np.ascontiguousarray(fixed, dtype=np.bool_),
        start=start,
        neighbour=np.ascontiguousarray(links[:, ::-1].T.ravel()[by_node]),
        via=(by_node % len(links)).astype(np.int32),
    )


def tetrahedron_volumes(rest: Array, tetrahedra: np.ndarray) -> Array:
    """Volumes (t,) mm³, never negative, of tetrahedra (t, 4)."""
    a, b, c, d = (rest[tetrahedra[:, k]] for k in range(4))
    return np.asarray(np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)) / 6.0)


def stiffness_from_modulus(rest: Array, tetrahedra: np.ndarray, modulus_kPa: float) -> tuple[np.ndarray, Array]:
    """The edges (m, 2) int32 of tetrahedra (t, 4), sorted, and their stiffness (m,) mN/mm.

    k_e = E Σ V_T / L_e² over the tetrahedra T that share the edge e: the rule of Van Gelder (1998, J. Graphics
    Tools 3:21, triangles and tetrahedra) with the factor that an isotropic solid asks for. Under a uniform small
    strain ε a link of direction n lengthens by L n·εn, so that the energy density is ½ C_ijkl ε_ij ε_kl with

        C_ijkl = (1 / V) Σ k L² n_i n_j n_k n_l.

    Directions distributed evenly over the sphere have <n_i n_j n_k n_l> = (δ_ij δ_kl + δ_ik δ_jl + δ_il δ_jk) / 15,
    which makes Lamé's constants equal, λ = μ = Σ k L² / (15 V). Then ν = λ / (2 (λ + μ)) = 1/4 whatever the
    stiffness (Cauchy's relation), and E = μ (3 λ + 2 μ) / (λ + μ) = 5 μ / 2, hence Σ k L² = 6 E V. The rule keeps
    that sum exactly, because each tetrahedron is counted at its six edges. A mesh whose edges prefer directions
    keeps the sum and departs from E in a given direction: cubes split into five give 1.2 E along their sides.
    """
    pairs = np.sort(tetrahedra[:, TETRAHEDRON_EDGES].reshape(-1, 2), axis=1)
    links, edge = np.unique(pairs, axis=0, return_inverse=True)
    volume = np.bincount(edge.ravel(), weights=np.repeat(tetrahedron_volumes(rest, tetrahedra), 6))
    squared = np.sum((rest[links[:, 1]] - rest[links[:, 0]]) ** 2, axis=1)
    return links.astype(np.int32), modulus_kPa * volume / squared


@njit(cache=True, nogil=True, error_model="numpy")
def add_forces(
    x: Array,
    links: np.ndarray,
    rest_length: Array,
    stiffness: Array,
    first: int,
    last: int,
    force: Array,
    branch: Branch | None = None,
) -> float:
    """Adds the forces of the links ``first`` … ``last`` - 1 to ``force`` (n, 3) mN; returns their energy, mN mm."""
    energy = 0.0
    for e in range(first, last):
        i, j = np.uintp(links[e, 0]), np.uintp(links[e, 1])  # a signed index is tested for being negative each time
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        stretch = length - rest_length[e]
        energy += potential_of(e, stretch, stiffness, branch)
        if length > 0.0:
            tension, _ = tension_of(e, stretch, stiffness, branch)
            pull = tension / length
            force[i, 0] += pull * dx
            force[i, 1] += pull * dy
            force[i, 2] += pull * dz
            force[j, 0] -= pull * dx
            force[j, 1] -= pull * dy
            force[j, 2] -= pull * dz
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def link_blocks(
    x: Array,
    links: np.ndarray,
    rest_length: Array,
    stiffness: Array,
    project: bool,
    out: Array,
    branch: Branch | None = None,
) -> None:
    """The block B of each link into ``out`` (m, 3, 3) mN/mm.

    With ``project`` the part across a shortened link, which is negative, is left out: B is then positive
    semidefinite, as a factorisation needs it.
    """
    for e in range(len(links)):
        i, j = links[e, 0], links[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        across = 0.0
        along = 0.0
        if length > 0.0:
            if branch is None:
                tangent, across = stiffness[e], stiffness[e] * (1.0 - rest_length[e] / length)
            else:
                tension, tangent = tension_of(e, length - rest_length[e], stiffness, branch)
                across = tension / length
            if project and across < 0.0:
                across = 0.0
            along = (tangent - across) / (length * length)
        out[e, 0, 0] = along * dx * dx + across
        out[e, 0, 1] = along * dx * dy
        out[e, 0, 2] = along * dx * dz
        out[e, 1, 0] = along * dy * dx
        out[e, 1, 1] = along * dy * dy + across
        out[e, 1, 2] = along * dy * dz
        out[e, 2, 0] = along * dz * dx
        out[e, 2, 1] = along * dz * dy
        out[e, 2, 2] = along * dz * dz + across


@njit(cache=True, nogil=True, error_model="numpy")
def keep_slip(x: Array, links: np.ndarray, rest_length: Array, law: LinkLaw, slip: Array) -> None:
    """Moves ``slip`` (m,) mm to where the links keep it at ``x`` (n, 3)."""
    for e in range(len(links)):
        if law.loss[e] > 0.0:
            i, j = links[e, 0], links[e, 1]
            dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            elongation = math.sqrt(dx * dx + dy * dy + dz * dz) - rest_length[e]
            slip[e] = slip_at(
                elongation, slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
            )


def never_stretched(mesh: LinkMesh) -> Branch | None:
    """The law of the mesh's links and their memory of nothing; None for constant stiffness."""
    return None if mesh.law is None else Branch(mesh.law, np.zeros(len(mesh.links)))


def settle(mesh: LinkMesh, x: Array, branch: Branch | None) -> None:
    """The links remember that they came to rest at ``x`` (n, 3): from there some unload along another branch.

    To be called after each equilibrium of a path whose links lose energy. No solve does it, nor does
    ``path_following``: a movement may be tried and taken back.
    """
    if branch is not None:
        keep_slip(x, mesh.links, mesh.rest_length, branch.law, branch.slip)


def forces(mesh: LinkMesh, x: Array, branch: Branch | None = None) -> Array:
    """Forces (n, 3) mN of the links on all nodes, fixed ones included, at positions ``x`` (n, 3).

    Here and below the links of a mesh with a law were never stretched before, unless ``branch`` says so.
    """
    out = np.zeros_like(mesh.rest)
    branch = branch or never_stretched(mesh)
    add_forces(x, mesh.links, mesh.rest_length, mesh.stiffness, 0, len(mesh.links), out, branch)
    return out


def energy(mesh: LinkMesh, x: Array, branch: Branch | None = None) -> float:
    """Elastic energy, mN mm, at positions ``x`` (n, 3)."""
    scratch = np.zeros_like(mesh.rest)
    branch = branch or never_stretched(mesh)
    return float(add_forces(x, mesh.links, mesh.rest_length, mesh.stiffness, 0, len(mesh.links), scratch, branch))


def blocks(mesh: LinkMesh, x: Array, project: bool = False, branch: Branch | None = None) -> Array:
    """The block B (m, 3, 3) mN/mm of each link at ``x`` (n, 3), plain or positive semidefinite."""
    out = np.zeros((len(mesh.links), 3, 3))
    branch = branch or never_stretched(mesh)
    link_blocks(x, mesh.links, mesh.rest_length, mesh.stiffness, project, out, branch)
    return out


def diagonal_blocks(mesh: LinkMesh, x: Array, project: bool = False, branch: Branch | None = None) -> Array:
    """The Hessian's diagonal blocks (n, 3, 3) mN/mm: how a node resists when only it moves."""
    out = np.zeros((len(mesh.rest), 3, 3))
    link = blocks(mesh, x, project, branch)
    np.add.at(out, mesh.links[:, 0], link)
    np.add.at(out, mesh.links[:, 1], link)
    return out


def hessian(mesh: LinkMesh, x: Array, project: bool = False, branch: Branch | None = None) -> Array:
    """The energy's second derivatives, dense (3 n, 3 n) mN/mm, fixed nodes included: for small meshes and tests."""
    n = len(mesh.rest)
    out = np.zeros((n, n, 3, 3))
    out[np.arange(n), np.arange(n)] = diagonal_blocks(mesh, x, project, branch)
    link = blocks(mesh, x, project, branch)
    np.subtract.at(out, (mesh.links[:, 0], mesh.links[:, 1]), link)
    np.subtract.at(out, (mesh.links[:, 1], mesh.links[:, 0]), link)
    return out.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
