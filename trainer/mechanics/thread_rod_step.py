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

from numba import njit

from trainer.geometry import Array
from trainer.mechanics.thread_rod_newton import Contacts, Law, Work, solve
from trainer.mechanics.thread_rod_solve import turn_frame

MILNE = 8.0 / 23.0
DEEPEST = 12  # a tick is halved so often at most


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
def advance(
    law: Law, work: Work, load: Array, x: Array, v: Array, x_before: Array, v_before: Array, tension: Array,
    clock: Array, frame: Array, holds: Array, targets: Array, limit: Array, bears: Array, contacts: Contacts,
    tick: float, tolerance: float, outcome: Array,
) -> None:  # fmt: skip
    """One tick, in place. ``outcome`` (4,): substeps, iterations, steps refused, 1 if the shortest substep found no
    end: the rod is then left where the last good one ended.

    ``clock`` (2,): the last substep's length and the one to try next, s. ``holds`` (k,) nodes, ``targets`` (k, 3)
    where they are at the tick's end, ``limit`` (k,) mN, ``bears`` (k, 3) mN the force of each hold on the rod.
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
        for i in range(n):
            work.held[i] = False
            work.tension[i] = tension[i]
            for c in range(3):
                work.begin[i, c] = x[i, c]
                work.x[i, c] = work.came[i, c]
                work.force[i, c] = load[i, c]
        share = part / (1.0 - done)
        for k in range(len(holds)):
            i = holds[k]
            work.held[i] = True
            for c in range(3):
                work.x[i, c] = x[i, c] + share * (targets[k, c] - x[i, c])
        iterations = solve(law, work, frame, contacts, done + part, part)
        loosened = False
        if iterations > 0:
            for k in range(len(holds)):
                i = holds[k]
                size = math.sqrt(work.left[i, 0] ** 2 + work.left[i, 1] ** 2 + work.left[i, 2] ** 2)
                for c in range(3):
                    bears[k, c] = -work.left[i, c]
                if size > limit[k]:
                    loosened = True
                    work.held[i] = False
                    for c in range(3):
                        bears[k, c] = -work.left[i, c] * limit[k] / size
                        work.force[i, c] += bears[k, c]
            if loosened:
                for i in range(n):
                    work.tension[i] = tension[i]
                    if not work.held[i]:
                        for c in range(3):
                            work.x[i, c] = work.came[i, c]
                iterations = solve(law, work, frame, contacts, done + part, part)
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
            for k in range(contacts.count[0]):
                contacts.push[k] = 0.0
                for c in range(3):
                    contacts.grip[k, c] = 0.0
            continue
        if iterations < 0:
            outcome[3] = 1.0
            return
        _accept(law, work, x, v, x_before, v_before, tension, frame, kh, h, clock[0])
        clock[0] = h
        done += part
        outcome[0] += 1.0
        # A step twice as long errs eight times as much; it must also end where steps of its length end.
        if halvings > 0 and 8.0 * error < tolerance and (done * 2.0 ** (halvings - 1)) % 1.0 == 0.0:
            halvings -= 1
        clock[1] = tick * 0.5**halvings


@njit(cache=True, nogil=True, error_model="numpy")
def _accept(
    law: Law, work: Work, x: Array, v: Array, x_before: Array, v_before: Array, tension: Array, frame: Array,
    kh: float, h: float, h_before: float,
) -> None:  # fmt: skip
    """Take the trial over as the state, and carry the frame with the first link."""
    r = h / h_before if h_before > 0.0 else 0.0
    now, before = (1.0 + r) * (1.0 + r) / (1.0 + 2.0 * r), r * r / (1.0 + 2.0 * r)
    ax, ay, az = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    for i in range(len(x)):
        tension[i] = work.tension[i]
        for c in range(3):
            new = work.x[i, c]
            speed = (new - now * x[i, c] + before * x_before[i, c]) / kh
            x_before[i, c], v_before[i, c] = x[i, c], v[i, c]
            x[i, c], v[i, c] = new, speed
    if law.curved:
        size = math.sqrt(ax * ax + ay * ay + az * az)
        bx, by, bz = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
        turned = math.sqrt(bx * bx + by * by + bz * bz)
        if size > 0.0 and turned > 0.0:
            turn_frame(frame, ax / size, ay / size, az / size, bx / turned, by / turned, bz / turned)
