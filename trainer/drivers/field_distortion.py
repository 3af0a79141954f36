"""Metal bends a magnetic tracker's field: a polynomial takes it back, fitted to a grid of known places.

As in Kindratenko (2000, survey of tracker calibration): the error of the position is a polynomial of the measured
position, by least squares. Where the grid stands is not known to the device, so the known places are first laid
rigidly over the measured ones; what is left over is the error.

A fifth of the grid's points is held out of the fit, and the residual before and after is theirs. The order of the
polynomial is the lowest that leaves hardly more than the least residual on points left out by turns, among the others
(5-fold cross-validation). What is stored is then fitted to all points. Orientations are not corrected.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import numpy as np

from trainer.calibration import CalibrationError, Distortion
from trainer.drivers.touched_points import means, rigid, spread
from trainer.geometry import Array

ORDERS = (1, 2, 3, 4)  # beyond the fourth, a hand-made grid has too few points; assumed
POINTS_A_TERM = 2  # of a fit, at the least; assumed
FOLDS = 5
FEWEST_POINTS = 12  # of the first order's 4 terms: 8 in four fifths of four fifths

#: A higher order must leave less than this part of a lower one's residual; below a millionth of a millimetre, all are
#: as good. Assumed.
WORTH_A_HIGHER_ORDER = 0.95

#: A grid whose spread along its shortest axis is less than this part of that along its longest is flat. Assumed.
LEAST_HEIGHT = 0.1


def correct(position: Array, distortion: Distortion | None) -> Array:
    """Measured positions ``(..., 3)`` mm where they would have been in a field that nothing bends.

    Outside of the grid's box the correction of the nearest place in it is used: a polynomial runs away.
    """
    if distortion is None:
        return position
    u = (position - np.array(distortion.centre_mm)) / np.array(distortion.half_width_mm)
    table = monomials(np.clip(u, -1.0, 1.0), distortion.order)
    return np.asarray(position + table @ np.array(distortion.coefficient_mm))


def monomials(u: Array, order: int) -> Array:
    """All products of up to ``order`` of the coordinates of ``u`` ``(..., 3)``: 1, x, y, z, x², xy, xz, y² …"""
    columns = [
        np.prod(u[..., list(axes)], axis=-1)
        for degree in range(order + 1)
        for axes in combinations_with_replacement(range(3), degree)
    ]
    return np.stack(columns, axis=-1)


def fit(measured: Array, known: Array) -> Distortion:
    """The correction from ``measured`` (n, 3) readings at places known as ``known`` (n, 3), both mm, any rigid frame.

    Raises CalibrationError for a grid that is flat or has too few points, and where the correction does not help.
    """
    measured, known = means(measured, known)
    n = len(known)
    shuffled = np.random.default_rng(0).permutation(n)
    held_out, others = shuffled[: n // FOLDS], shuffled[n // FOLDS :]
    allowed = [k for k in ORDERS if POINTS_A_TERM * _terms(k) <= len(others) * (FOLDS - 1) // FOLDS]
    if not allowed:
        raise CalibrationError(f"the grid has {n} different points; a correction needs {FEWEST_POINTS} or more")
    sizes = spread(known)
    if sizes[2] < LEAST_HEIGHT * sizes[0]:
        raise CalibrationError(
            f"the grid is flat: spread {sizes[0]:.1f} mm along its longest axis, {sizes[2]:.1f} mm along its shortest; "
            "measure it at several heights"
        )
    low, high = measured.min(axis=0), measured.max(axis=0)
    box = 0.5 * (low + high), 0.5 * (high - low)
    left = {k: _residual_left_out(measured[others], known[others], k, box) for k in allowed}
    order = next(k for k in allowed if WORTH_A_HIGHER_ORDER * left[k] <= min(left.values()) + 1e-6)
    trial = _fit(measured[others], known[others], order, box)
    there = rigid(known[others], measured[others]).apply(known[held_out])
    before = _rms(measured[held_out] - there)
    after = _rms(correct(measured[held_out], trial) - there)
    if after >= before:
        raise CalibrationError(
            f"a correction does not help: on points held out of the fit the residual is {before:.3f} mm without it, "
            f"{after:.3f} mm with it; use none"
        )
    whole = _fit(measured, known, order, box)
    return Distortion(order, whole.centre_mm, whole.half_width_mm, whole.coefficient_mm, before, after, n)


def _terms(order: int) -> int:
    return (order + 1) * (order + 2) * (order + 3) // 6


def _fit(measured: Array, known: Array, order: int, box: tuple[Array, Array]) -> Distortion:
    """The correction in a ``box`` (centre, half width), its residuals left open."""
    centre, half = box
    error = rigid(known, measured).apply(known) - measured
    table = monomials((measured - centre) / half, order)
    coefficients = np.linalg.lstsq(table, error, rcond=None)[0]
    rows = tuple((x, y, z) for x, y, z in coefficients.tolist())
    (cx, cy, cz), (hx, hy, hz) = centre.tolist(), half.tolist()
    return Distortion(order, (cx, cy, cz), (hx, hy, hz), rows, 0.0, 0.0, len(known))


def _residual_left_out(measured: Array, known: Array, order: int, box: tuple[Array, Array]) -> float:
    """Residual of points that a fit has not seen, each left out once."""
    fold = np.arange(len(known)) % FOLDS
    errors = []
    for k in range(FOLDS):
        seen, left_out = fold != k, fold == k
        there = rigid(known[seen], measured[seen]).apply(known[left_out])
        errors.append(correct(measured[left_out], _fit(measured[seen], known[seen], order, box)) - there)
    return _rms(np.concatenate(errors))


def _rms(errors: Array) -> float:
    return math.sqrt(float(np.mean(np.sum(errors**2, axis=1))))
