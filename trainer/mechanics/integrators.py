"""Explicit time integration: forward Euler, and Runge–Kutta of second and fourth order (Brown et al. 2001, section 3).

A step of any length is divided into equal substeps that are no longer than the method's stable step. On a mode
z'' + c z' + ω² z = 0 a substep h multiplies by R(h λ), where λ² + c λ + ω² = 0 and R is the method's polynomial. With
s = h ω and d = h c, |R|² <= 1 of a pair of complex roots means

    forward Euler     R = 1 + z              1 - d + s² <= 1:                   s² <= d
    RK2 (midpoint)    R = 1 + z + z²/2       1 - d + d²/2 + (s⁴ - 2 s² d) / 4:  s⁴ <= 4 d - 2 d² + 2 s² d
    RK4               R = … + z³/6 + z⁴/24   the left half of a disc of radius 2.615 is stable

and real roots, |λ| <= c, are stable to |z| = 2 and 2, and RK4's in the same half disc (the regions of stability: Hairer
& Wanner, Solving Ordinary Differential Equations II, section IV.2). So neither forward Euler nor RK2 has a stable step
for a mesh without drag: there they are refused.

The bounds of ω and c hold for every deformed state, as the linear stability of that state; a link that is squeezed to
nothing has no such bound, but its force has.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.dynamics import Bounds, Model, State, accelerations, bounds, finite, refuse, settle_links

#: The largest half disc |z| <= r, Re z <= 0 in RK4's region of stability touches its edge at 123 degrees. (On the real
#: axis it reaches to 2.785, on the imaginary one to 2 √2.) Found by bisection; a test looks along the half disc's edge.
RK4_RADIUS = 2.615587
#: A step that needs more substeps than this is refused: it would take minutes.
MOST_SUBSTEPS = 1_000_000


class Stages(NamedTuple):
    """What substeps need besides the state; it is kept from step to step."""

    x: Array  # (n, 3) mm, positions of a stage
    v: Array  # (n, 3) mm/s, velocities of a stage
    a: Array  # (n, 3) mm/s²
    sum_v: Array  # (n, 3) weighted sum of the stages' velocities
    sum_a: Array  # (n, 3) and of their accelerations
    old_x: Array  # (n, 3) the state before the step, to which a refused step returns
    old_v: Array  # (n, 3)
    old_slip: Array  # (m,)


@njit(cache=True, nogil=True, error_model="numpy")
def moved(x: Array, h: float, v: Array, out: Array) -> None:
    """``out`` = ``x`` + h ``v``, each (n, 3); ``out`` may be ``x``."""
    for i in range(len(x)):
        out[i, 0] = x[i, 0] + h * v[i, 0]
        out[i, 1] = x[i, 1] + h * v[i, 1]
        out[i, 2] = x[i, 2] + h * v[i, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def forward_euler(model: Model, state: State, stages: Stages, h: float, substeps: int) -> None:
    """x ← x + h v, v ← v + h a(x, v), both from the old state."""
    x, v, a = state.x, state.v, stages.a
    for _ in range(substeps):
        accelerations(model, state.held, state.slip, x, v, a)
        moved(x, h, v, x)
        moved(v, h, a, v)
        settle_links(model, state)


@njit(cache=True, nogil=True, error_model="numpy")
def midpoint(model: Model, state: State, stages: Stages, h: float, substeps: int) -> None:
    """Second-order Runge–Kutta: half a step of forward Euler, then a whole one with the derivatives found there."""
    x, v, a = state.x, state.v, stages.a
    for _ in range(substeps):
        accelerations(model, state.held, state.slip, x, v, a)
        moved(x, 0.5 * h, v, stages.x)
        moved(v, 0.5 * h, a, stages.v)
        accelerations(model, state.held, state.slip, stages.x, stages.v, a)
        moved(x, h, stages.v, x)
        moved(v, h, a, v)
        settle_links(model, state)


@njit(cache=True, nogil=True, error_model="numpy")
def rk4(model: Model, state: State, stages: Stages, h: float, substeps: int) -> None:
    """The classical fourth-order method of Runge and Kutta: stages at 0, h/2, h/2 and h, weights 1, 2, 2, 1."""
    x, v, a = state.x, state.v, stages.a
    for _ in range(substeps):
        accelerations(model, state.held, state.slip, x, v, a)
        moved(x, h / 6.0, v, stages.sum_v)
        moved(v, h / 6.0, a, stages.sum_a)
        moved(x, 0.5 * h, v, stages.x)
        moved(v, 0.5 * h, a, stages.v)
        for weight, next_stage in ((h / 3.0, 0.5 * h), (h / 3.0, h)):
            accelerations(model, state.held, state.slip, stages.x, stages.v, a)
            moved(stages.sum_v, weight, stages.v, stages.sum_v)
            moved(stages.sum_a, weight, a, stages.sum_a)
            moved(x, next_stage, stages.v, stages.x)
            moved(v, next_stage, a, stages.v)
        accelerations(model, state.held, state.slip, stages.x, stages.v, a)
        moved(stages.sum_v, h / 6.0, stages.v, x)
        moved(stages.sum_a, h / 6.0, a, v)
        settle_links(model, state)


def _over(limit: float, rate: float) -> float:
    """limit / rate: where nothing swings, or nothing is damped, that is no limit."""
    return limit / rate if rate > 0.0 else math.inf


def _stable_euler(b: Bounds) -> float:
    """s² <= d for every mode: h ω² <= c; and h c <= 2."""
    return min(_over(b.least_damping, b.frequency**2), _over(2.0, b.most_damping))


def _stable_midpoint(b: Bounds) -> float:
    """s⁴ <= 2 d suffices where d <= 1, since 4 d - 2 d² >= 2 d there: h³ ω⁴ <= 2 c, h c <= 1."""
    return min(math.cbrt(_over(2.0 * b.least_damping, b.frequency**4)), _over(1.0, b.most_damping))


def _stable_rk4(b: Bounds) -> float:
    """|z| is s for a pair of complex roots and at most d for real ones."""
    return _over(RK4_RADIUS, max(b.frequency, b.most_damping))


@dataclass(frozen=True)
class Method:
    """An explicit method: its kernel, its order, and the longest substep that the modes of a mesh allow, in s."""

    name: str
    order: int
    advance: Callable[[Model, State, Stages, float, int], None]
    stable: Callable[[Bounds], float]


FORWARD_EULER = Method("forward Euler", 1, forward_euler, _stable_euler)
MIDPOINT = Method("RK2 midpoint", 2, midpoint, _stable_midpoint)
RK4 = Method("RK4", 4, rk4, _stable_rk4)
METHODS = (FORWARD_EULER, MIDPOINT, RK4)


class Explicit:
    """An explicit method at work on one mesh."""

    def __init__(self, model: Model, method: Method, held: np.ndarray) -> None:
        """``held`` (n,) bool are the nodes whose velocity is given; :meth:`hold` takes others."""
        self.model, self.method = model, method
        n, m = len(model.mass), len(model.links)
        self._stages = Stages._make([*np.zeros((7, n, 3)), np.zeros(m)])
        self.hold(held)

    def hold(self, held: np.ndarray) -> None:
        """The stable step for other held nodes (n,), as when an instrument takes one; costs about a millisecond."""
        self._held = held.copy()
        self.stable_step_s = self.method.stable(bounds(self.model, held))

    def step(self, state: State, duration: float) -> int:
        """Moves ``state`` on by ``duration`` s, in place; returns the number of substeps.

        Raises ValueError for a state or a duration that is not finite, where other nodes are held than
        :meth:`hold` was told, where the method has no stable step, and where it would take too many; ArithmeticError
        where the numbers outgrow what a float holds. The state is then as it was.
        """
        refuse(state, duration)
        if not _same(state.held, self._held):
            raise ValueError("other nodes are held than the stable step was found for: call hold() first")
        if self.stable_step_s == 0.0:
            raise ValueError(
                f"{self.method.name} is stable at no step for a mesh with a free node without drag: "
                "give the nodes drag, or take RK4 or backward Euler"
            )
        needed = duration / self.stable_step_s
        if needed > MOST_SUBSTEPS:
            raise ValueError(
                f"{self.method.name} needs {needed:.0f} substeps of {self.stable_step_s:.2g} s for a step of "
                f"{duration:g} s: take backward Euler"
            )
        substeps = max(1, math.ceil(needed))
        stages = self._stages
        stages.old_x[:], stages.old_v[:], stages.old_slip[:] = state.x, state.v, state.slip
        self.method.advance(self.model, state, stages, duration / substeps, substeps)
        if not (finite(state.x) and finite(state.v)):
            state.x[:], state.v[:], state.slip[:] = stages.old_x, stages.old_v, stages.old_slip
            raise ArithmeticError(f"a step of {self.method.name} outgrew the range of numbers")
        return substeps


@njit(cache=True, nogil=True, error_model="numpy")
def _same(a: np.ndarray, b: np.ndarray) -> bool:
    differences = 0
    for i in range(len(a)):
        differences += a[i] != b[i]
    return differences == 0
