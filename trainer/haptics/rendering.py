"""The force of one period of a haptic loop, such that a wall never gives back more work than was put in.

A device holds each force until the next one is there. While a tip goes into a wall the held force lags behind and takes
too little work from the hand; on the way out it lags again and gives too much. Over a press and release the wall would
push a hand that only rests on it: the stiffer and the slower the loop, the more. So the work that the hand has put in
is counted as it is done, held force times way (a passivity observer: Hannaford and Ryu 2002), and on the way out the
force is held to what is left of it: at most half in one period, if the tip goes on as it went in the last one. While
each step outwards is at most twice the one before, what is left stays above zero, and the cycle gives nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.density_field import force_at

#: Entries of a state: force (3,) mN, outward direction (3,), the last tip (3,) mm, work left of what the hand put in,
#: mN mm, and the density at the tip.
FORCE, DIRECTION, TIP, CHARGE, DENSITY = 0, 3, 6, 9, 10
STATE_SIZE = 11


def new_state() -> Array:
    """The state (11,) of a tip that has not been anywhere."""
    state = np.zeros(STATE_SIZE)
    state[TIP : TIP + 3] = np.nan
    return state


@njit(cache=True, nogil=True, error_model="numpy")
def render(density: np.ndarray, constants: Array, tip: Array, state: Array) -> None:
    """One period: counts the work of the force so far and sets the force for a ``tip`` (3,) mm in ``state`` (11,)."""
    force, direction, last = state[0:3], state[3:6], state[6:9]
    first = last[0] != last[0]
    if not first:
        state[9] -= force[0] * (tip[0] - last[0]) + force[1] * (tip[1] - last[1]) + force[2] * (tip[2] - last[2])
    d = force_at(density, constants, tip, force, direction)
    state[10] = d
    outwards = 0.0
    for k in range(3):
        outwards += (tip[k] - last[k]) * direction[k]
        last[k] = tip[k]
        if first:  # whence it comes is not known: a tip that begins in bone is not flung out
            force[k] = 0.0
    if d == 0.0:
        state[9] = min(state[9], 0.0)  # what was put in is spent when the tip is out; a debt is not forgotten
        return
    # On the way out at most half of what is left is given in a step like the last one.
    size = force[0] * direction[0] + force[1] * direction[1] + force[2] * direction[2]
    if outwards > 0.0 and 2.0 * size * outwards > state[9]:
        part = max(state[9], 0.0) / (2.0 * size * outwards)
        for k in range(3):
            force[k] *= part
