"""What a link between two elements answers to its strain: linear, a J-curve, or plastic (Gibson et al. 1998, 3.2.2).

A link of rest length h between two elements that share a face of area A answers an elongation e with the force
A T(e/h), and an offset sideways s with A G s/h. Soft tissue is linear in shear and compression; in tension its curve
is shaped like a J (the paper's Fig. 3), for which Fung's exponential is the usual form, T(ε) = E/b (exp(b ε) − 1)
(Fung 1993, Biomechanics: Mechanical Properties of Living Tissues): E is the slope at rest, b the steepness. From the
strain ``straight_from`` on it goes along its tangent. A plastic tissue has, as the paper puts it, a range of optimal
configurations: strains up to the yield strain cost nothing, and what is beyond pulls back to it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.volume import Volume

#: Columns of :func:`constants`.
YOUNG, SHEAR, STEEPNESS, STRAIGHT_FROM, YIELD = range(5)


def constants(volume: Volume) -> Array:
    """(m, 5) of each material: Young's and shear modulus kPa, steepness, strain of the tangent, yield strain."""
    return np.array(
        [[m.young_kPa, m.shear_kPa, m.steepness, m.straight_from, m.yield_strain] for m in volume.materials]
    )


def rest_stiffness(volume: Volume) -> Array:
    """(m, 3, 3) mN/mm of a link by material, axis and component, at rest: A E/h along the link, A G/h aside."""
    out = np.empty((len(volume.materials), 3, 3))
    for m, of in enumerate(volume.materials):
        for axis, h in enumerate(volume.spacing_mm):
            area = volume.element_mm3 / h
            out[m, axis] = area * of.shear_kPa / h
            out[m, axis, axis] = area * of.young_kPa / h
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def beyond(strain, most):  # type: ignore[no-untyped-def]
    """What of a strain is beyond the yield strain."""
    return strain - min(max(strain, -most), most)


@njit(cache=True, nogil=True, error_model="numpy")
def stress(law, strain):  # type: ignore[no-untyped-def]
    """Stress along a link, kPa, by the law of a material: its row of :func:`constants` as a tuple."""
    e = beyond(strain, law[4])
    b = law[2]
    if e <= 0.0 or b == 0.0:
        return law[0] * e
    bend = min(e, law[3])
    return law[0] * ((math.exp(b * bend) - 1.0) / b + math.exp(b * bend) * (e - bend))


@njit(cache=True, nogil=True, error_model="numpy")
def slope(law, strain):  # type: ignore[no-untyped-def]
    """Slope of stress against strain, kPa; that at rest while a plastic link does not answer."""
    e = beyond(strain, law[4])
    if e <= 0.0 or law[2] == 0.0:
        return law[0]
    return law[0] * math.exp(law[2] * min(e, law[3]))


@njit(cache=True, nogil=True, error_model="numpy")
def link_answer(law, other, alone, axial, strain):  # type: ignore[no-untyped-def]
    """Stress and its slope, kPa, of a link of two halves in series, by the laws of their materials.

    ``alone`` says that the other half is rigid or of the same material. In series the stresses of two linear halves at
    the common strain combine to their harmonic mean; that is used for curved laws, too, where it is an approximation.
    """
    if axial:
        t, k = stress(law, strain), slope(law, strain)
        if not alone:
            t, k = _in_series(t, stress(other, strain)), _in_series(k, slope(other, strain))
    else:
        t, k = law[1] * beyond(strain, law[4]), law[1]
        if not alone:
            t, k = _in_series(t, other[1] * beyond(strain, other[4])), _in_series(k, other[1])
    return t, k


@njit(cache=True, nogil=True, error_model="numpy")
def _in_series(one, other):  # type: ignore[no-untyped-def]
    """Harmonic mean of two numbers of the same sign; 0 if either is."""
    return 2.0 * one * other / (one + other) if one * other > 0.0 else 0.0
