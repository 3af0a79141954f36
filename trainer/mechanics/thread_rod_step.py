"""A tick of a rod: BDF2 with substeps of its own choice, and holds that give way at a force.

BDF2 with a variable step: with r the step over the one before, the derivative at the end of a step h is
(x - X) / (κ h), X = ((1 + r)² x_n - r² x_{n-1}) / (1 + 2 r), κ = (1 + r) / (1 + 2 r) (Hairer, Nørsett, Wanner 1993,
"Solving Ordinary Differential Equations I", section III.5); it is stable for r < 1 + √2, a step doubles at most. The
first step is backward Euler. On constraints of position it keeps its order 2 (Hairer, Wanner 1996, II, section
VII.3), and it damps what is too fast to follow: the bending waves of a link, 1e5 rad/s in a fine suture.

The error of a step is estimated from its distance to a parabola through the last two steps (Milne's device): for equal
steps the parabola errs by 5/12 h³ x''' and BDF2 by -2/9 h³ x''', so 8/23 of their distance is BDF2's.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_rod_newton import NEAR, Contacts, Law, Work, solve
from trainer.mechanics.thread_rod_solve import turn_frame

MILNE = 8.0 / 23.0
DEEPEST = 12  # a tick is halved so often at most
SLIPS_AT = 1.001  # limits: what a hold bears before it slips; two holds of one limit on one thread do not slip in turns
MOST_CHANGES = 4  # of what slips, in a step


@njit(cache=True, nogil=True, error_model="numpy")
def _prepare(
    law: Law, work: Work, x: Array, v: Array, x_before: Array, v_before: Array, h: float, h_before: float
) -> float:
    """Weights and aims of a step, and a first guess of its end; returns κ h. ``work.came`` holds the guess."""
    r = h / h_before if h_before > 0.0 else 0.0
    kh = h * (1.0 + r) / (1.0 + 2.0 * r)
    now, before = (1.0 + r) * (1.0 + r) / (1.0 + 2.0 * r), r * r / (1.0 + 2.0 * r)
    for i in range(len(x)):
        inertia, drag = law.mass[i] / (kh * kh), law.drag[i] / kh
        work.weight[i] = inertia + drag
        for c in range(3):
            stay = now * x[i, c] - before * x_before[i, c]
            go = now * v[i, c] - before * v_before[i, c]
            work.y[i, c] = stay + inertia / (inertia + drag) * kh * go
            came = x[i, c] + h * v[i, c]
            if r > 0.0:
                came += 0.5 * r * h * (v[i, c] - v_before[i, c])
            work.came[i, c] = came
    return kh


@njit(cache=True, nogil=True, error_model="numpy")
def _place(
    work: Work, load: Array, x: Array, tension: Array, holds: NDArray[np.int32], targets: Array, limit: Array,
    slips: NDArray[np.bool_], share: float,
) -> None:  # fmt: skip
    """First guess of a step's end. A firm hold's node goes its share of the way; one that slips is drawn that way."""
    for i in range(len(x)):
        work.held[i] = False
        work.pull[i] = 0.0
        work.tension[i] = tension[i]
        for c in range(3):
            work.begin[i, c] = x[i, c]
            work.x[i, c] = work.came[i, c]
            work.force[i, c] = load[i, c]
    for k in range(len(holds)):
        i = holds[k]
        work.held[i] = not slips[k]
        work.pull[i] = limit[k] if slips[k] else 0.0
        for c in range(3):
            work.aim[i, c] = targets[k, c]
            if slips[k]:
                work.x[i, c] = x[i, c]
            else:
                work.x[i, c] = x[i, c] + share * (targets[k, c] - x[i, c])


@njit(cache=True, nogil=True, error_model="numpy")
def _change_holds(
    work: Work, x: Array, link: float, holds: NDArray[np.int32], targets: Array, limit: Array,
    slips: NDArray[np.bool_], bears: Array, converged: bool,
) -> bool:  # fmt: skip
    """Loosen the hold that would bear too much by most, fasten those whose node has come to its place.

    Without convergence, those loosen whose node is a link or more from its place, where the thread may be too short,
    and those fasten that were loose. True if any changed.
    """
    changed = False
    worst, excess = -1, SLIPS_AT
    for k in range(len(holds)):
        i = holds[k]
        dx, dy, dz = targets[k, 0] - x[i, 0], targets[k, 1] - x[i, 1], targets[k, 2] - x[i, 2]
        if slips[k]:
            rx, ry, rz = targets[k, 0] - work.x[i, 0], targets[k, 1] - work.x[i, 1], targets[k, 2] - work.x[i, 2]
            size = math.sqrt(rx * rx + ry * ry + rz * rz)
            force = limit[k] / max(size, NEAR * link)
            bears[k, 0], bears[k, 1], bears[k, 2] = force * rx, force * ry, force * rz
            if not converged or size < NEAR * link:
                slips[k] = False
                changed = True
        elif converged:
            fx, fy, fz = work.left[i, 0], work.left[i, 1], work.left[i, 2]
            bears[k, 0], bears[k, 1], bears[k, 2] = -fx, -fy, -fz
            size = math.sqrt(fx * fx + fy * fy + fz * fz)
            if size > excess * limit[k]:
                worst, excess = k, size / max(limit[k], 1e-300)
        elif limit[k] < math.inf and dx * dx + dy * dy + dz * dz > link * link:
            slips[k] = True
            changed = True
    if worst >= 0 and not changed:
        slips[worst] = True
        changed = True
    return changed


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    law: Law, work: Work, load: Array, x: Array, v: Array, x_before: Array, v_before: Array, tension: Array,
    clock: Array, frame: Array, holds: NDArray[np.int32], targets: Array, limit: Array, slips: NDArray[np.bool_],
    bears: Array, contacts: Contacts, tick: float, tolerance: float, outcome: Array,
) -> None:  # fmt: skip
    """One tick, in place. ``outcome`` (4,): substeps, iterations, steps refused, 1 if the shortest substep found no
    end: the rod is then left where the last good one ended.

    ``clock`` (2,): the last substep's length and the one to try next, s. ``holds`` (k,) nodes, ``targets`` (k, 3)
    where they are at the tick's end, ``limit`` (k,) mN, ``slips`` (k,) whether it is reached, ``bears`` (k, 3) mN
    the force of each hold on the rod.
    ``tolerance`` mm a substep, or 0 for one substep a tick.
    """
    n = len(x)
    halvings = 0
    if tolerance > 0.0 and clock[1] > 0.0:
        while tick * 0.5**halvings > 1.0001 * clock[1] and halvings < DEEPEST:
            halvings += 1
    done = 0.0  # of the tick; sums of powers of two are exact
    for k in range(4):
        outcome[k] = 0.0
    while done < 1.0:
        part = 0.5**halvings
        h = part * tick
        kh = _prepare(law, work, x, v, x_before, v_before, h, clock[0])
        share = part / (1.0 - done)
        iterations = 0
        for _ in range(MOST_CHANGES):
            _place(work, load, x, tension, holds, targets, limit, slips, share)
            spent = solve(law, work, frame, contacts, done + part, part)
            iterations = abs(iterations) + spent if spent > 0 else spent - abs(iterations)
            if not _change_holds(work, x, law.link, holds, targets, limit, slips, bears, spent > 0):
                break
        loosened = False
        for k in range(len(holds)):
            loosened = loosened or slips[k]
        error = 0.0
        if tolerance > 0.0 and iterations > 0 and not loosened:
            for i in range(n):
                if not work.held[i]:
                    dx, dy = work.x[i, 0] - work.came[i, 0], work.x[i, 1] - work.came[i, 1]
                    dz = work.x[i, 2] - work.came[i, 2]
                    error = max(error, dx * dx + dy * dy + dz * dz)
            error = MILNE * math.sqrt(error)
        outcome[1] += abs(iterations)
        if (iterations < 0 or error > tolerance) and halvings < DEEPEST and (tolerance > 0.0 or iterations < 0):
            halvings += 1
            outcome[2] += 1.0
            for k in range(contacts.used[0]):
                contacts.push[k] = 0.0
                for c in range(3):
                    contacts.grip[k, c] = 0.0
            continue
        if iterations < 0:
            outcome[3] = 1.0
            return
        carry_frame(law, x, work.x, frame)
        _accept(work, x, v, x_before, v_before, tension, kh, h, clock[0])
        clock[0] = h
        done += part
        outcome[0] += 1.0
        # A step twice as long errs eight times as much; it must also end where steps of its length end.
        if halvings > 0 and 8.0 * error < tolerance and (done * 2.0 ** (halvings - 1)) % 1.0 == 0.0:
            halvings -= 1
        clock[1] = tick * 0.5**halvings


@njit(cache=True, nogil=True, error_model="numpy")
def carry_frame(law: Law, x: Array, new: Array, frame: Array) -> None:
    """Turn the frame with the first link, from ``x`` to ``new`` (n, 3)."""
    ax, ay, az = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    bx, by, bz = new[1, 0] - new[0, 0], new[1, 1] - new[0, 1], new[1, 2] - new[0, 2]
    a, b = math.sqrt(ax * ax + ay * ay + az * az), math.sqrt(bx * bx + by * by + bz * bz)
    if law.curved and a > 0.0 and b > 0.0:
        turn_frame(frame, ax / a, ay / a, az / a, bx / b, by / b, bz / b)


@njit(cache=True, nogil=True, error_model="numpy")
def _accept(
    work: Work, x: Array, v: Array, x_before: Array, v_before: Array, tension: Array, kh: float, h: float,
    h_before: float,
) -> None:  # fmt: skip
    """Take the trial over as the state."""
    r = h / h_before if h_before > 0.0 else 0.0
    now, before = (1.0 + r) * (1.0 + r) / (1.0 + 2.0 * r), r * r / (1.0 + 2.0 * r)
    for i in range(len(x)):
        tension[i] = work.tension[i]
        for c in range(3):
            new = work.x[i, c]
            speed = (new - now * x[i, c] + before * x_before[i, c]) / kh
            x_before[i, c], v_before[i, c] = x[i, c], v[i, c]
            x[i, c], v[i, c] = new, speed
