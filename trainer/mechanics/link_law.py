"""The tension of a link as a function of its elongation (Brown et al. 2001, section 3: "k_ij may be constant or a
function of Δ_ij").

Soft tissue is slack at first and stiff later: its curve has the shape of a J. Here, after Fung (1967, Am. J. Physiol.
213:1532, dT/dλ proportional to T plus a constant), a link that is longer than at rest by Δ > 0 is loaded along

    T(Δ) = (k / β) (exp(β Δ) - 1)   up to the end of the toe, Δ = t, and from there along its tangent,

and is an ordinary spring k when it is shortened. β = 0 is the constant stiffness.

Unloading follows another branch, (1 - h) T. Between the two the link is a spring with a friction element beside it
(Prandtl's element, with a limit that grows with the tension):

    tension = (1 - h) T(Δ) + q,    q = κ (Δ - p) held between 0 and h T(Δ),    κ = k exp(β t),

where the slip p is the link's only memory: it moves when q meets a limit. The energy stored is that of (1 - h) T, plus
q² / (2 κ); what is lost in dp is q dp, and it is never negative, because p falls only where q = 0. κ is the steepest
tangent of the loading branch, so that loading follows T itself from rest. A cycle to Δ and back to rest loses
h U(Δ) - (h T(Δ))² / (2 κ), U being the area below T, at any speed: the branches do not depend on rates.

Lengths mm, tension mN, stiffness mN/mm, energy mN mm.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array, unit
from trainer.mechanics.links import LinkMesh

#: Below this β Δ the energy is summed as a series: the closed form loses 2 / (β Δ)² units in the last place.
SERIES = 0.5


class LinkLaw(NamedTuple):
    """One law per link, by its parameters."""

    stiffness: Array  # (m,) mN/mm, k: the tangent at rest
    growth: Array  # (m,) 1/mm, β: 0 is a constant stiffness
    toe: Array  # (m,) mm, t: the elongation at which the curve becomes straight
    loss: Array  # (m,) h, 0 <= h < 1: share of the tension that the unloading branch lacks
    friction: Array  # (m,) mN/mm, κ: stiffness between the branches


def constant(mesh: LinkMesh) -> LinkLaw:
    """Links of constant stiffness, that of the mesh."""
    zero = np.zeros(len(mesh.links))
    return LinkLaw(mesh.stiffness, zero, zero, zero, mesh.stiffness)


def j_shaped(mesh: LinkMesh, growth: float | Array, toe_strain: float | Array, loss: float | Array = 0.0) -> LinkLaw:
    """J-shaped links: the mesh's stiffness at rest, ``growth`` per unit of strain up to ``toe_strain``.

    Each number is one for all links or one for each (m,). Raises ValueError where the growth or the toe is negative
    or not finite, where the tangent grows beyond what a float holds, or where the loss is not in 0 … 1.
    """
    growth, toe_strain, loss = (
        np.broadcast_to(np.asarray(a, dtype=np.float64), mesh.rest_length.shape) for a in (growth, toe_strain, loss)
    )
    for name, value in (("growth", growth), ("toe_strain", toe_strain)):
        if not np.all((value >= 0.0) & (value < np.inf)):
            raise ValueError(f"'{name}' of a J-shaped link must be finite and not negative, found {np.min(value):g}")
    if not np.all((loss >= 0.0) & (loss < 1.0)):
        raise ValueError("'loss' of a J-shaped link must be at least 0 and less than 1")
    with np.errstate(over="ignore"):
        steepest = mesh.stiffness * np.exp(growth * toe_strain)
    if not np.all(np.isfinite(steepest)):
        raise ValueError(f"'growth' times 'toe_strain' is too large: {np.max(growth * toe_strain):g}")
    length = mesh.rest_length
    return LinkLaw(mesh.stiffness, growth / length, toe_strain * length, loss.copy(), steepest)


def steepest_tangent(law: LinkLaw) -> Array:
    """The largest derivative (m,) mN/mm that each link's tension can have, whatever its elongation and its past."""
    return np.where(law.loss > 0.0, (2.0 - law.loss) * law.friction, law.friction)


def stiffened_along(mesh: LinkMesh, direction: Array, ratio: float) -> Array:
    """The mesh's stiffness (m,) mN/mm, times 1 + (ratio - 1) cos² of the link's angle to ``direction`` (3,) at rest.

    A link along the direction is ``ratio`` times as stiff, one across it as stiff as before. What becomes of the
    moduli is said by :func:`moduli_along`. Raises ValueError for a ratio that is not positive.
    """
    if not 0.0 < ratio < math.inf:
        raise ValueError(f"'ratio' of the stiffness along a direction must be positive, found {ratio:g}")
    along = (mesh.rest[mesh.links[:, 1]] - mesh.rest[mesh.links[:, 0]]) @ unit(direction)
    squared = np.sum((mesh.rest[mesh.links[:, 1]] - mesh.rest[mesh.links[:, 0]]) ** 2, axis=1)
    return np.asarray(mesh.stiffness * (1.0 + (ratio - 1.0) * along * along / squared))


def moduli_along(modulus_kPa: float, ratio: float) -> tuple[float, float]:
    """Young's moduli along and across, kPa, of a mesh of ``modulus_kPa`` after :func:`stiffened_along`.

    For links distributed evenly over the sphere, Σ k L² = 6 E V as in ``stiffness_from_modulus``. With b = ratio - 1
    and the axis 1 along the direction, C_ijkl = 6 E <(1 + b n_1²) n_i n_j n_k n_l>. The averages <n_1⁴> = 1/5,
    <n_1² n_2²> = 1/15, <n_1⁶> = 1/7, <n_1⁴ n_2²> = 1/35 and <n_1² n_2² n_3²> = 1/105 give, in units of 6 E,

        C_11 = 1/5 + b/7,  C_22 = 1/5 + b/35,  C_12 = 1/15 + b/35,  C_23 = 1/15 + b/105,

    a solid that is isotropic around the axis. A bar along the axis has the modulus C_11 - 2 C_12² / (C_22 + C_23);
    one across it 1 / S_22 of the inverse matrix, which is (C_22 - C_23) D / (C_11 C_22 - C_12²), D being
    (C_11 (C_22 + C_23) - 2 C_12²).
    """
    b = ratio - 1.0
    c11, c22, c12, c23 = 1 / 5 + b / 7, 1 / 5 + b / 35, 1 / 15 + b / 35, 1 / 15 + b / 105
    d = c11 * (c22 + c23) - 2.0 * c12 * c12
    scale = 6.0 * modulus_kPa
    return scale * d / (c22 + c23), scale * (c22 - c23) * d / (c11 * c22 - c12 * c12)


@njit(cache=True, nogil=True, error_model="numpy")
def loading(elongation: float, k: float, growth: float, toe: float) -> tuple[float, float]:
    """Tension T, mN, and tangent, mN/mm, of the loading branch."""
    if growth == 0.0 or elongation <= 0.0:
        return k * elongation, k
    curved = min(elongation, toe)
    more = math.expm1(growth * curved)
    tangent = k * (1.0 + more)
    return k * more / growth + tangent * (elongation - curved), tangent


@njit(cache=True, nogil=True, error_model="numpy")
def area(elongation: float, k: float, growth: float, toe: float) -> float:
    """The energy U, mN mm, below the loading branch.

    In the toe U = k Δ² φ(β Δ) with φ(z) = (exp z - 1 - z) / z² = 1/2! + z/3! + z²/4! + …
    """
    if growth == 0.0 or elongation <= 0.0:
        return 0.5 * k * elongation * elongation
    curved = min(elongation, toe)
    z = growth * curved
    if z < SERIES:
        phi, term, order = 0.5, 0.5, 3.0
        while term > 1e-17:
            term *= z / order
            phi += term
            order += 1.0
    else:
        phi = (math.expm1(z) - z) / (z * z)
    tension, tangent = loading(curved, k, growth, toe)
    beyond = elongation - curved
    return k * curved * curved * phi + (tension + 0.5 * tangent * beyond) * beyond


@njit(cache=True, nogil=True, error_model="numpy")
def tension_and_tangent(
    elongation: float, slip: float, k: float, growth: float, toe: float, loss: float, friction: float
) -> tuple[float, float]:
    """Tension, mN, at an elongation when the slip was ``slip`` mm before, and its derivative, mN/mm."""
    tension, tangent = loading(elongation, k, growth, toe)
    if loss == 0.0 or elongation <= 0.0:
        return tension, tangent
    q = friction * (elongation - slip)
    if q >= loss * tension:
        return tension, tangent
    if q <= 0.0:
        return (1.0 - loss) * tension, (1.0 - loss) * tangent
    return (1.0 - loss) * tension + q, (1.0 - loss) * tangent + friction


@njit(cache=True, nogil=True, error_model="numpy")
def slip_at(elongation: float, slip: float, k: float, growth: float, toe: float, loss: float, friction: float) -> float:
    """The slip, mm, that a link keeps when it comes to rest at an elongation, ``slip`` being that of before."""
    if loss == 0.0:
        return slip
    tension, _ = loading(elongation, k, growth, toe)
    return elongation - min(max(friction * (elongation - slip), 0.0), loss * max(tension, 0.0)) / friction


@njit(cache=True, nogil=True, error_model="numpy")
def stored_energy(
    elongation: float, slip: float, k: float, growth: float, toe: float, loss: float, friction: float
) -> float:
    """The energy, mN mm, that a link at an elongation can give back."""
    whole = area(elongation, k, growth, toe)
    if loss == 0.0 or elongation <= 0.0:
        return whole
    q = friction * (elongation - slip_at(elongation, slip, k, growth, toe, loss, friction))
    return (1.0 - loss) * whole + 0.5 * q * q / friction


@njit(cache=True, nogil=True, error_model="numpy")
def tensions(law: LinkLaw, elongation: Array, slip: Array, tension: Array, tangent: Array) -> None:
    """Tension (m,) mN and tangent (m,) mN/mm of all links at ``elongation`` (m,) mm with ``slip`` (m,) mm before."""
    for e in range(len(elongation)):
        tension[e], tangent[e] = tension_and_tangent(
            elongation[e], slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
        )


@njit(cache=True, nogil=True, error_model="numpy")
def energies(law: LinkLaw, elongation: Array, slip: Array, out: Array) -> None:
    """Stored energy (m,) mN mm of all links."""
    for e in range(len(elongation)):
        out[e] = stored_energy(
            elongation[e], slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
        )


@njit(cache=True, nogil=True, error_model="numpy")
def settle(law: LinkLaw, elongation: Array, slip: Array) -> None:
    """Moves ``slip`` (m,) mm, in place, to where the links keep it at ``elongation`` (m,) mm."""
    for e in range(len(elongation)):
        slip[e] = slip_at(
            elongation[e], slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
        )
