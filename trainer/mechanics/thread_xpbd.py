"""The common rival of the rod: extended position-based dynamics with distance and bending constraints.

Macklin, Müller, Chentanez 2016, "XPBD: position-based simulation of compliant constrained dynamics", algorithm 1 and
equation 18; many substeps with one iteration each (Macklin et al. 2019, "Small steps in physics simulation"). Links are
distance constraints with the compliance d / EA; bending is |x_{i-1} - 2 x_i + x_{i+1}| with the compliance d³ / EI, the
same discrete energy as the rod's. Constraints are swept from node 0 on. Air drag is taken implicitly in the speeds. A
rest curvature, contacts and giving holds are not part of this comparison.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_rod import Holds, RodModel


@dataclass(frozen=True)
class BeadState:
    """Where the beads are and how they move; ``step_xpbd`` changes the arrays in place."""

    x: Array  # (n, 3) mm
    v: Array  # (n, 3) mm/s
    _before: Array
    _mobility: Array  # (n,) 1/kg
    _multiplier: Array  # (2, n)


def begin_xpbd(model: RodModel, x: Array) -> BeadState:
    """Beads at rest at ``x`` (n, 3) mm. Raises ValueError for another shape or numbers that are not finite."""
    places = np.array(x, dtype=np.float64, order="C")
    if places.shape != (model.count, 3) or not np.isfinite(places).all():
        raise ValueError(f"beads need finite places of shape ({model.count}, 3)")
    zero = np.zeros_like(places)
    return BeadState(places, zero, places.copy(), np.zeros(model.count), np.zeros((2, model.count)))


@njit(cache=True, nogil=True, error_model="numpy")
def _substeps(
    x: Array, v: Array, before: Array, mobility: Array, multiplier: Array, mass: Array, drag: Array, gravity: Array,
    holds: NDArray[np.int32], targets: Array, link: float, stretch: float, bend: float, tick: float, substeps: int,
    iterations: int,
) -> None:  # fmt: skip
    n = len(x)
    h = tick / substeps
    for i in range(n):
        mobility[i] = 1.0 / mass[i]
    for k in range(len(holds)):
        mobility[holds[k]] = 0.0
    for substep in range(substeps):
        for i in range(n):
            multiplier[0, i] = multiplier[1, i] = 0.0
            slow = 1.0 / (1.0 + h * drag[i] / mass[i])
            for c in range(3):
                before[i, c] = x[i, c]
                if mobility[i] > 0.0:
                    x[i, c] += h * slow * (v[i, c] + h * gravity[c])
        for k in range(len(holds)):
            i = holds[k]
            for c in range(3):
                x[i, c] += (targets[k, c] - x[i, c]) / (substeps - substep)
        for _ in range(iterations):
            for i in range(1, n):
                w = mobility[i] + mobility[i - 1]
                dx, dy, dz = x[i, 0] - x[i - 1, 0], x[i, 1] - x[i - 1, 1], x[i, 2] - x[i - 1, 2]
                size = math.sqrt(dx * dx + dy * dy + dz * dz)
                if w > 0.0 and size > 0.0:
                    soft = stretch / (h * h)
                    change = (link - size - soft * multiplier[0, i]) / (w + soft)
                    multiplier[0, i] += change
                    s = change / size
                    x[i, 0] += mobility[i] * s * dx
                    x[i, 1] += mobility[i] * s * dy
                    x[i, 2] += mobility[i] * s * dz
                    x[i - 1, 0] -= mobility[i - 1] * s * dx
                    x[i - 1, 1] -= mobility[i - 1] * s * dy
                    x[i - 1, 2] -= mobility[i - 1] * s * dz
            if bend > 0.0:
                for i in range(1, n - 1):
                    w = mobility[i - 1] + 4.0 * mobility[i] + mobility[i + 1]
                    dx = x[i - 1, 0] - 2.0 * x[i, 0] + x[i + 1, 0]
                    dy = x[i - 1, 1] - 2.0 * x[i, 1] + x[i + 1, 1]
                    dz = x[i - 1, 2] - 2.0 * x[i, 2] + x[i + 1, 2]
                    size = math.sqrt(dx * dx + dy * dy + dz * dz)
                    if w > 0.0 and size > 0.0:
                        soft = 1.0 / (bend * h * h)
                        change = (-size - soft * multiplier[1, i]) / (w + soft)
                        multiplier[1, i] += change
                        s = change / size
                        for c in range(3):
                            d = dx if c == 0 else (dy if c == 1 else dz)
                            x[i - 1, c] += mobility[i - 1] * s * d
                            x[i, c] -= 2.0 * mobility[i] * s * d
                            x[i + 1, c] += mobility[i + 1] * s * d
        for i in range(n):
            for c in range(3):
                v[i, c] = (x[i, c] - before[i, c]) / h


def step_xpbd(model: RodModel, state: BeadState, held: Holds, tick: float, substeps: int, iterations: int = 1) -> None:
    """Let ``tick`` s pass in ``substeps`` of ``iterations`` sweeps each.

    Raises ValueError for a tick or numbers of steps that are not above 0, or a target that is not finite.
    """
    if not (math.isfinite(tick) and tick > 0.0 and substeps > 0 and iterations > 0):
        raise ValueError(f"{tick} s in {substeps} substeps of {iterations} sweeps: give more than 0 of each")
    if not np.isfinite(held.target).all():
        raise ValueError("a hold's target is not finite")
    law = model.law()
    _substeps(
        state.x, state.v, state._before, state._mobility, state._multiplier, law.mass, law.drag,
        np.array(model.gravity), held.node, held.target, law.link, law.stretch, law.bend, tick, substeps, iterations,
    )  # fmt: skip
