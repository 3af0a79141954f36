"""The bare chain: point masses on rigid links without bending, explicit in time; for threads that are all whip.

Where a thread has no stiffness worth the name (wet silk, or a peer's ball chain to compare with) its motion has no
scale that an implicit method could step over, and an explicit one of high order costs a hundredth of it at the same
error: ``thread_chain_step`` says how. Links are rigid: a chain pulled straight between two holds bears without end,
and a tick that would ask more of a hold than its limit, or for a place out of reach, is refused and moves nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from trainer.geometry import Array
from trainer.mechanics.thread_chain_step import DONE, ENDED, FORCE, HOLD, MASS, ROWS, STAGES, TAUT, advance_chain
from trainer.mechanics.thread_rod import Holds, RodModel

TOLERANCE = 1e-6  # lengths of the chain a substep, where none is asked for


class ChainTaut(ArithmeticError):
    """A hold would have to bear more than its limit, or the chain is too short; nothing has moved."""


class ChainStalled(ArithmeticError):
    """No substep, however short, led on from here; nothing has moved."""


@cache
def _coefficients() -> Array:
    """Dormand's and Prince's of order 8 as scipy holds them, and their squares for places (29, 12)."""
    from scipy.integrate import DOP853

    speed, end, error = DOP853.A[:STAGES, :STAGES], DOP853.B, DOP853.E5[:STAGES]
    return np.vstack([speed, speed @ speed, end, end @ speed, error, error @ speed, DOP853.C[:STAGES]])


@dataclass(frozen=True)
class ChainState:
    """Where the chain is and how it moves; ``step_chain`` changes the arrays in place."""

    x: Array  # (n, 3) mm
    v: Array  # (n, 3) mm/s
    tension: Array  # (n,) mN of the link into each node, negative in compression; entry 0 is none
    numbers: Array  # (12,) as ``thread_chain_step`` names them: of the last tick the steps taken, refused …
    _secant: Array
    _rows: Array


def _finite(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(values, dtype=np.float64, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")
    return array


def begin_chain(model: RodModel, x: ArrayLike, v: ArrayLike | None = None) -> ChainState:
    """A chain at places ``x`` (n, 3) mm with speeds ``v`` (n, 3) mm/s, at rest if not given.

    Each link must have its length to a millionth; the first tick projects what is left, and the speeds. Raises
    ValueError for a model that bends, another shape, numbers that are not finite, or links of another length.
    """
    if model.bending > 0.0 or model.curvature is not None:
        raise ValueError("a chain does not bend: take the rod for a thread with bending stiffness")
    n = model.count
    places = _finite("places", x, (n, 3))
    speeds = np.zeros((n, 3)) if v is None else _finite("speeds", v, (n, 3))
    sizes = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if np.max(np.abs(sizes - model.link)) > 1e-6 * model.link:
        raise ValueError(f"links must be {model.link} mm long, not {sizes.min():.6g} to {sizes.max():.6g}")
    rows = np.zeros((ROWS, n))
    rows[MASS] = model.mass * model.node_lengths()
    numbers = np.array([*[0.0] * 7, model.link, model.drag / model.mass, *model.gravity])
    return ChainState(places, speeds, np.zeros(n), numbers, speeds.copy(), rows)


def _check_reach(model: RodModel, held: Holds) -> None:
    """Refuse holds between which a rigid chain cannot be."""
    at = dict(zip(held.node.tolist(), held.target.tolist(), strict=True))
    for a, b in pairwise(sorted(at)):
        if b == a + 1:
            raise ValueError(f"nodes {a} and {b} are neighbours: a rigid link between two holds bears anything")
        reach, apart = (b - a) * model.link, math.dist(at[a], at[b])
        if apart >= reach:
            raise ChainTaut(f"nodes {a} and {b} cannot be {apart:.6g} mm apart on {reach:.6g} mm of thread")


def step_chain(model: RodModel, state: ChainState, held: Holds, tick: float, tolerance: float | None = None) -> None:
    """Let ``tick`` s pass. ``tolerance`` mm: the error a substep may make, by default 1e-6 of the length.

    ``state.tension`` and ``held.bears`` say afterwards what the links and holds bear. Raises ValueError for targets
    that are not finite, a tick or tolerance that is not above 0 or two neighbours held; ChainTaut where a hold would
    bear more than its limit or the thread is too short, ChainStalled where no substep is short enough. The chain is
    then as it was before the tick.
    """
    if not (math.isfinite(tick) and tick > 0.0):
        raise ValueError(f"a tick cannot last {tick} s")
    allowed = TOLERANCE * model.length if tolerance is None else tolerance
    if not (math.isfinite(allowed) and allowed > 0.0):
        raise ValueError(f"a tolerance cannot be {allowed} mm")
    if not all(map(math.isfinite, held.target.ravel().tolist())):
        raise ValueError("a hold's target is not finite")
    if len(held.node) > 1:
        _check_reach(model, held)
    advance_chain(
        _coefficients(), state._rows, state.x, state.v, state.tension, state._secant, state.numbers, held.node,
        held.target, held.limit, held.bears, tick, allowed,
    )  # fmt: skip
    if state.numbers[ENDED] == TAUT:
        k = int(state.numbers[HOLD])
        force, limit = state.numbers[FORCE], held.limit[k]
        raise ChainTaut(f"node {held.node[k]} would pull with {force:.3g} mN, of which {limit:.3g} can be held")
    if state.numbers[ENDED] != DONE:
        raise ChainStalled("no substep of the chain was short enough: it is taut, or too fast to be followed")
