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

As long as the slip is not moved the tension is a function of Δ alone, which never falls, and so has a potential, convex
in Δ: what a static equilibrium makes least. A solve therefore leaves the slip alone, wherever its iterations wander;
``links.settle`` moves it at the equilibrium that was found.

Lengths mm, tension mN, stiffness mN/mm, energy mN mm.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from trainer.geometry import Array

#: Below this β Δ the energy is summed as a series: the closed form loses 2 / (β Δ)² units in the last place.
SERIES = 0.5


class LinkLaw(NamedTuple):
    """One law per link, by its parameters."""

    stiffness: Array  # (m,) mN/mm, k: the tangent at rest
    growth: Array  # (m,) 1/mm, β: 0 is a constant stiffness
    toe: Array  # (m,) mm, t: the elongation at which the curve becomes straight
    loss: Array  # (m,) h, 0 <= h < 1: share of the tension that the unloading branch lacks
    friction: Array  # (m,) mN/mm, κ: stiffness between the branches


class Branch(NamedTuple):
    """The law of a mesh's links, and where on it each of them is."""

    law: LinkLaw
    slip: Array  # (m,) mm, p: the links' memory; it changes in place


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
def end_of_friction(slip: float, k: float, growth: float, toe: float, loss: float, friction: float) -> float:
    """The elongation, mm, at which a link that kept ``slip`` >= 0 finds its loading branch: κ (Δ - p) = h T(Δ).

    The difference of the two is concave and rises, and is not positive at p: Newton's method from there goes up to the
    root and never over it, but for rounding, at which it ends.
    """
    at = slip
    while True:
        tension, tangent = loading(at, k, growth, toe)
        further = at + (loss * tension - friction * (at - slip)) / (friction - loss * tangent)
        if not further > at:
            return at
        at = further


@njit(cache=True, nogil=True, error_model="numpy")
def potential(
    elongation: float, slip: float, k: float, growth: float, toe: float, loss: float, friction: float
) -> float:
    """The integral, mN mm, of the tension from 0 to an elongation, the slip being ``slip`` mm all the way.

    Without loss it is the energy stored; with loss, what the next movement of the slip will lose is in it, too.
    """
    whole = area(elongation, k, growth, toe)
    if loss == 0.0 or elongation <= 0.0 or slip <= 0.0:
        return whole
    if elongation <= slip:
        return (1.0 - loss) * whole
    end = end_of_friction(slip, k, growth, toe, loss, friction)
    if elongation < end:
        return (1.0 - loss) * whole + 0.5 * friction * (elongation - slip) * (elongation - slip)
    return whole - loss * area(end, k, growth, toe) + 0.5 * friction * (end - slip) * (end - slip)


@njit(cache=True, nogil=True, error_model="numpy")
def tension_of(e: int, elongation: float, stiffness: Array, branch: Branch | None) -> tuple[float, float]:
    """Tension, mN, and tangent, mN/mm, of link ``e``: of its law, or where there is none of its ``stiffness`` (m,).

    Which of the two is decided when the kernel is compiled: a mesh without a law pays nothing for it.
    """
    if branch is None:
        return stiffness[e] * elongation, stiffness[e]
    law = branch.law
    return tension_and_tangent(
        elongation, branch.slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def potential_of(e: int, elongation: float, stiffness: Array, branch: Branch | None) -> float:
    """The integral, mN mm, of link ``e``'s tension from 0 to an elongation."""
    if branch is None:
        k: float = stiffness[e]
        return 0.5 * k * elongation * elongation
    law = branch.law
    return potential(
        elongation, branch.slip[e], law.stiffness[e], law.growth[e], law.toe[e], law.loss[e], law.friction[e]
    )
