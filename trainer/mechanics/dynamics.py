"""The equations of motion of a link mesh (Brown et al. 2001, section 3, equation (1)):

    m_i a_i + c_i v_i + Σ_j F_ij = m_i g

for every node that is neither fixed nor moved by the user. To the paper's drag c_i on a node is added a dashpot b_ij
along a link, which resists only changes of the link's length: drag also slows a mesh that moves as a whole, a dashpot
leaves its linear and angular momentum alone.

Units: mm, s, kg, mN, which agree (1 mN = 1 kg mm/s²). Drag and dashpots are mN s/mm = kg/s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.link_law import constant, steepest_tangent
from trainer.mechanics.link_tension import Branch, LinkLaw, stored_energy, tension_of
from trainer.mechanics.links import LinkMesh, keep_slip, tetrahedron_volumes

#: Acceleration of free fall, mm/s²: standard gravity (3rd CGPM, 1901), downwards.
GRAVITY = (0.0, 0.0, -9806.65)
#: Rounds in which the bound of the highest frequency is sharpened.
SHARPENINGS = 50


class Model(NamedTuple):
    """What a mesh in motion is: it does not change."""

    links: np.ndarray  # (m, 2) int32
    rest_length: Array  # (m,) mm
    law: LinkLaw  # (m,) of each parameter
    mass: Array  # (n,) kg
    drag: Array  # (n,) mN s/mm
    dashpot: Array  # (m,) mN s/mm
    gravity: Array  # (3,) mm/s²


class State(NamedTuple):
    """Where a mesh in motion is; its arrays change in place.

    A held node keeps the velocity that it is given: zero where it is fixed, the instrument's where one moves it.
    """

    x: Array  # (n, 3) mm
    v: Array  # (n, 3) mm/s
    held: np.ndarray  # (n,) bool
    slip: Array  # (m,) mm, the links' memory; see trainer.mechanics.link_tension


def model(
    mesh: LinkMesh,
    mass: Array,
    *,
    drag: float | Array = 0.0,
    dashpot: float | Array = 0.0,
    gravity: tuple[float, float, float] = GRAVITY,
) -> Model:
    """A mesh with masses (n,) kg; ``drag`` and ``dashpot`` are one number, or one for each node (n,) or link (m,).

    Raises ValueError for a node that could move and has no mass, and for numbers that are negative or not finite.
    """
    n, m = len(mesh.rest), len(mesh.links)
    made = Model(
        mesh.links,
        mesh.rest_length,
        constant(mesh) if mesh.law is None else mesh.law,
        np.broadcast_to(np.asarray(mass, dtype=np.float64), n).copy(),
        np.broadcast_to(np.asarray(drag, dtype=np.float64), n).copy(),
        np.broadcast_to(np.asarray(dashpot, dtype=np.float64), m).copy(),
        np.array(gravity, dtype=np.float64),
    )
    for name, value in (("mass", made.mass), ("drag", made.drag), ("dashpot", made.dashpot)):
        wrong = np.flatnonzero(~((value >= 0.0) & (value < np.inf)))
        if len(wrong):
            raise ValueError(f"'{name}' {wrong[0]} must be finite and not negative, found {value[wrong[0]]:g}")
    wrong = np.flatnonzero((made.mass == 0.0) & ~mesh.fixed)
    if len(wrong):
        raise ValueError(f"node {wrong[0]} has no mass and is not fixed: give it one, or take it out of the mesh")
    for name, value in (("gravity", made.gravity), ("stiffness", made.law.stiffness)):
        if not np.all(np.isfinite(value)):
            raise ValueError(f"'{name}' must be finite")
    return made


def at_rest(mesh: LinkMesh) -> State:
    """The mesh where no link is stretched, standing still, its fixed nodes held."""
    return State(mesh.rest.copy(), np.zeros_like(mesh.rest), mesh.fixed.copy(), np.zeros(len(mesh.links)))


def lumped_masses(rest: Array, tetrahedra: np.ndarray, density: float) -> Array:
    """Masses (n,) kg of the nodes of tetrahedra (t, 4) of ``density`` kg/mm³.

    Each tetrahedron gives a quarter to each corner: the row sums of the consistent mass matrix of linear shape
    functions, ∫ ρ N_a N_b dV = ρ V (1 + δ_ab) / 20 (Zienkiewicz & Taylor). Total mass and centre of mass are kept.
    """
    share = 0.25 * density * tetrahedron_volumes(rest, tetrahedra)
    return _at_nodes(tetrahedra, share, len(rest))


def masses_of_links(mesh: LinkMesh, modulus_kPa: float, density: float) -> Array:
    """The same masses (n,) kg, for a mesh whose stiffness comes from ``stiffness_from_modulus``.

    There k L² = E Σ V_T over the tetrahedra T at a link; a tetrahedron has three of its links at each corner, so that
    the sum of k L² over a node's links is 3 E times the volume around it.
    """
    share = density / (12.0 * modulus_kPa) * mesh.stiffness * mesh.rest_length**2
    return _at_nodes(mesh.links, share, len(mesh.rest))


def _at_nodes(parts: np.ndarray, share: Array, n: int) -> Array:
    """The sums (n,) of the shares (p,) of all parts (p, k) at a node."""
    return np.asarray(np.bincount(parts.ravel(), np.repeat(share, parts.shape[1]), n), dtype=np.float64)


class Bounds(NamedTuple):
    """What the steps of explicit methods depend on: how fast a mode can swing, how much and how little it is damped."""

    frequency: float  # 1/s: no mode's angular frequency, without damping, is higher
    most_damping: float  # 1/s: no mode's damping c/m is larger
    least_damping: float  # 1/s: none is smaller


def bounds(model: Model, held: np.ndarray) -> Bounds:
    """Bounds over all motions of the nodes that are not ``held`` (n,), in every deformed state of the mesh.

    A link's block B = k' u uᵀ + (T / l) (I - u uᵀ) is nowhere above s I, s being the law's steepest tangent: a tension
    T = k' Δ at most, so T / l < s. Hence K ≼ L ⊗ I with the graph's Laplacian L of weights s, and its spectrum over
    the masses is bounded by that of M⁻¹ |L|, a matrix without negative entries. For such a matrix A every vector
    w > 0 gives a bound, ρ(A) <= max (A w)_i / w_i (Collatz 1942); w = 1 is Gershgorin's, 2 max Σ s / m. Rounds of
    w ← (A + ω² I) w, a power iteration that stays positive, sharpen it without ever falling below ρ(A). The rounds
    end where they do not help. Links at right angles to each other share s three times in this bound; a mesh of all
    directions swings slower by up to √3.

    Dashpots are bounded likewise; the least damping is that of drag alone, since a link that turns feels no dashpot.
    """
    free = ~held
    if not free.any():
        return Bounds(0.0, 0.0, math.inf)
    drag = np.divide(model.drag, model.mass, out=np.zeros_like(model.drag), where=free)
    swing = _spectral_bound(model.links, steepest_tangent(model.law), model.mass, free)
    damp = _spectral_bound(model.links, model.dashpot, model.mass, free)
    return Bounds(math.sqrt(swing), damp + float(drag[free].max()), float(drag[free].min()))


def _spectral_bound(links: np.ndarray, weight: Array, mass: Array, free: np.ndarray) -> float:
    """A number that no eigenvalue of M⁻¹ L on the free nodes exceeds, L the Laplacian of links of ``weight`` (m,)."""
    n = len(mass)
    i, j = links.T
    total = _at_nodes(links, weight, n)
    inverse = np.divide(1.0, mass, out=np.zeros(n), where=free)
    w = np.where(free, 1.0, 0.0)
    best = math.inf
    for _ in range(SHARPENINGS):
        across = np.bincount(i, weight * w[j], n) + np.bincount(j, weight * w[i], n)
        image = inverse * (total * w + across)
        best = min(best, float(np.max(image[free] / w[free])))
        w = image + best * w
        if not w.any():
            return 0.0
        w /= w.max()
        # Far from the stiffest place the vector may fall as far as it likes, but not to zero.
        w[free] = np.maximum(w[free], 1e-12)
    # What rounding of a sum over a node's links can take away.
    return best * (1.0 + 1e-12)


@njit(cache=True, nogil=True, error_model="numpy")
def add_link_forces(model: Model, x: Array, v: Array, slip: Array, force: Array) -> None:
    """Adds the tensions and the dashpots' resistance to ``force`` (n, 3) mN. A link of no length pulls nowhere.

    The potential, which ``links.add_forces`` finds beside the forces, would make a step 1.7 times as long (measured).
    """
    branch = Branch(model.law, slip)
    for e in range(len(model.links)):
        i, j = model.links[e, 0], model.links[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            continue
        tension, _ = tension_of(e, length - model.rest_length[e], model.law.stiffness, branch)
        pull = tension / length
        if model.dashpot[e] > 0.0:
            along = (v[j, 0] - v[i, 0]) * dx + (v[j, 1] - v[i, 1]) * dy + (v[j, 2] - v[i, 2]) * dz
            pull += model.dashpot[e] * along / (length * length)
        force[i, 0] += pull * dx
        force[i, 1] += pull * dy
        force[i, 2] += pull * dz
        force[j, 0] -= pull * dx
        force[j, 1] -= pull * dy
        force[j, 2] -= pull * dz


@njit(cache=True, nogil=True, error_model="numpy")
def accelerations(model: Model, held: np.ndarray, slip: Array, x: Array, v: Array, out: Array) -> None:
    """Equation (1) solved for a, into ``out`` (n, 3) mm/s²; zero at held nodes, whose velocity is given."""
    out[:] = 0.0
    add_link_forces(model, x, v, slip, out)
    for i in range(len(x)):
        for c in range(3):
            out[i, c] = 0.0 if held[i] else (out[i, c] - model.drag[i] * v[i, c]) / model.mass[i] + model.gravity[c]


@njit(cache=True, nogil=True, error_model="numpy")
def settle_links(model: Model, state: State) -> None:
    """The links remember where they are: their slip follows at the end of a step."""
    keep_slip(state.x, model.links, model.rest_length, model.law, state.slip)


@njit(cache=True, nogil=True, error_model="numpy")
def mechanical_energy(model: Model, state: State) -> float:
    """Kinetic energy, energy stored in the links and height in the field of gravity, mN mm."""
    law, x, v = model.law, state.x, state.v
    total = 0.0
    for e in range(len(model.links)):
        i, j = model.links[e, 0], model.links[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        total += stored_energy(
            math.sqrt(dx * dx + dy * dy + dz * dz) - model.rest_length[e], state.slip[e],
            law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e],
        )  # fmt: skip
    for i in range(len(x)):
        for c in range(3):
            total += model.mass[i] * (0.5 * v[i, c] * v[i, c] - model.gravity[c] * x[i, c])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def finite(a: Array) -> bool:
    """Whether all numbers of ``a`` (n, 3) are finite: the sum of 0 · a is 0 only then."""
    total = 0.0
    for i in range(len(a)):
        total += 0.0 * a[i, 0] + 0.0 * a[i, 1] + 0.0 * a[i, 2]
    return total == 0.0


def refuse(state: State, duration: float) -> None:
    """Raises ValueError for a duration that is not positive, and for positions or velocities that are not finite."""
    if not 0.0 < duration < math.inf:
        raise ValueError(f"a step must last a positive, finite time, found {duration:g} s")
    for name, value in (("position", state.x), ("velocity", state.v)):
        if not finite(value):
            node = int(np.flatnonzero(~np.isfinite(value).all(axis=1))[0])
            raise ValueError(f"the {name} of node {node} is not finite")
