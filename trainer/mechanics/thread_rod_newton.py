"""Newton's iterations for one implicit problem of a rod, with contacts as augmented Lagrangian terms.

A contact holds a point of one link above a plane, or apart from a point of another link of the same rod. Its
multipliers, the push N and the friction F, follow an augmented Lagrangian (Alart and Curnier 1991, "A mixed
formulation for frictional contact problems prone to Newton like solution methods"): in each iteration

    N = max(0, N - k gap),    F = (F - k slip), cut to |F| <= mu N,

so that a gap or a slip is left where the forces allow it and none where they do not. The bound of the friction is
renewed with the multipliers: between two renewals friction has a potential, and the matrix is symmetric. Two links
that touch see one another's last place: their coupling is far from the band.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_rod_solve import (
    BAND,
    assemble,
    directions,
    factor,
    hold,
    imbalance,
    rest_bends,
    substitute,
)

MOST_TURN = 1.0  # link lengths that an iteration may move a node against its neighbour
MOST_ITERATIONS = 30
MOST_CONTACT_ITERATIONS = 100
CLOSE = 1e-5  # link lengths: an iteration that moves no node further is the last; what it leaves is of second order
SETTLED = 0.2  # of the change that is due: the multipliers are renewed after iterations that move no node further
FAIR = 1e-3  # of the largest push: to this the multipliers agree with the nodes in the end
PATIENCE = 60  # iterations after which an obstacle's multipliers stay, and two links' forces; lengths are found anyway
SOFT = 4.0  # the same for two links, over their inertia
STIFF = 20.0  # a contact's k over the stiffness of the nodes it acts on; decides iterations, not the answer

NEAR = 1e-3  # links: a slipping hold this close to its place has caught it


class Law(NamedTuple):
    """What the rod is, per node. All (n, ...) float64."""

    mass: Array  # (n,) kg
    drag: Array  # (n,) mN s/mm
    curvature: Array  # (n, 2) 1/mm, rest curvature about the carried frame
    curved: bool
    bend: float  # EI / d³, mN/mm
    stretch: float  # d / EA, mm/mN
    link: float  # mm


class Contacts(NamedTuple):
    """Where the rod may touch. A row is a contact; ``thread_contact`` fills them. Capacity m."""

    used: NDArray[np.int64]  # (1,) rows in use
    link: NDArray[np.int32]  # (m,) first node of the link
    other: NDArray[np.int32]  # (m,) first node of the other link, or -1 for an obstacle
    place: Array  # (m, 2) where along the link, and along the other, 0..1
    normal: Array  # (m, 3) from the obstacle or the other link to the link
    offset: Array  # (m,) mm: the gap is normal · (point - other point) - offset
    move: Array  # (m, 3) mm: the obstacle's way in this tick
    friction: Array  # (m,) coefficient mu
    push: Array  # (m,) mN, the answer
    grip: Array  # (m, 3) mN, friction on the link, the answer
    stiff: Array  # (m,) mN/mm, the k of the augmented Lagrangian


class Work(NamedTuple):
    """Working space, and the forces that a hold must bear."""

    t: Array  # (n, 3)
    size: Array  # (n,)
    rest: Array  # (n, 3)
    left: Array  # (n, 3) mN
    a: Array  # (4 n + BAND, WIDTH)
    b: Array  # (4 n + BAND,)
    y: Array  # (n, 3)
    weight: Array  # (n,)
    force: Array  # (n, 3) mN
    x: Array  # (n, 3) mm, the trial
    tension: Array  # (n,) mN, the trial
    came: Array  # (n, 3) mm, where inertia alone would bring the node
    begin: Array  # (n, 3) mm, places at the start of the problem
    held: NDArray[np.bool_]  # (n,)
    pull: Array  # (n,) mN with which a slipping hold draws its node
    aim: Array  # (n, 3) mm where to


@njit(cache=True, nogil=True, error_model="numpy")
def _point(x: Array, contacts: Contacts, k: int, c: int) -> float:
    """Coordinate ``c`` of the link's point, less that of the other link's point."""
    i, j, s = contacts.link[k], contacts.other[k], contacts.place[k, 0]
    p = (1.0 - s) * x[i, c] + s * x[i + 1, c]
    if j >= 0:
        s = contacts.place[k, 1]
        p -= (1.0 - s) * x[j, c] + s * x[j + 1, c]
    return float(p)


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(x: Array, begin: Array, contacts: Contacts, moved: float, part: float, k: int) -> tuple[float, ...]:
    """Push, friction (3) and how much of a stick's stiffness is left (1: sticks), at ``x``; gap and slip left."""
    nx, ny, nz = contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2]
    px, py, pz = _point(x, contacts, k, 0), _point(x, contacts, k, 1), _point(x, contacts, k, 2)
    mx, my, mz = contacts.move[k, 0], contacts.move[k, 1], contacts.move[k, 2]
    gap = nx * (px - moved * mx) + ny * (py - moved * my) + nz * (pz - moved * mz) - contacts.offset[k]
    push = max(0.0, contacts.push[k] - contacts.stiff[k] * gap)
    ux = px - _point(begin, contacts, k, 0) - part * mx
    uy = py - _point(begin, contacts, k, 1) - part * my
    uz = pz - _point(begin, contacts, k, 2) - part * mz
    along = nx * ux + ny * uy + nz * uz
    ux, uy, uz = ux - along * nx, uy - along * ny, uz - along * nz
    fx = contacts.grip[k, 0] - contacts.stiff[k] * ux
    fy = contacts.grip[k, 1] - contacts.stiff[k] * uy
    fz = contacts.grip[k, 2] - contacts.stiff[k] * uz
    size = math.sqrt(fx * fx + fy * fy + fz * fz)
    most = contacts.friction[k] * contacts.push[k]
    sticks = 1.0
    if size > most:
        sticks = most / size
    return push, fx * sticks, fy * sticks, fz * sticks, sticks


@njit(cache=True, nogil=True, error_model="numpy")
def _residual(law: Law, work: Work, frame: Array, contacts: Contacts, moved: float, part: float) -> None:
    """All forces that are left at the nodes, into ``work.left``."""
    x, left = work.x, work.left
    directions(x, work.t, work.size)
    if law.curved:
        rest_bends(x, frame, law.curvature, law.link, work.t, work.rest)
    imbalance(x, work.tension, work.y, work.weight, work.force, law.bend, work.rest, work.t, left)
    for i in range(len(x)):
        if work.pull[i] > 0.0:
            dx, dy, dz = work.aim[i, 0] - x[i, 0], work.aim[i, 1] - x[i, 1], work.aim[i, 2] - x[i, 2]
            k = work.pull[i] / max(math.sqrt(dx * dx + dy * dy + dz * dz), NEAR * law.link)
            left[i, 0] += k * dx
            left[i, 1] += k * dy
            left[i, 2] += k * dz
    for k in range(contacts.used[0]):
        i, j, s, r = contacts.link[k], contacts.other[k], contacts.place[k, 0], contacts.place[k, 1]
        push, fx, fy, fz, _ = _touch(x, work.begin, contacts, moved, part, k)
        force = (
            push * contacts.normal[k, 0] + fx,
            push * contacts.normal[k, 1] + fy,
            push * contacts.normal[k, 2] + fz,
        )
        for c in range(3):
            left[i, c] += (1.0 - s) * force[c]
            left[i + 1, c] += s * force[c]
            if j >= 0:
                left[j, c] -= (1.0 - r) * force[c]
                left[j + 1, c] -= r * force[c]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_pulls(work: Work, link: float) -> None:
    """How the forces of slipping holds turn with their nodes, or give, into the matrix."""
    for i in range(len(work.x)):
        if work.pull[i] > 0.0:
            r = (work.aim[i, 0] - work.x[i, 0], work.aim[i, 1] - work.x[i, 1], work.aim[i, 2] - work.x[i, 2])
            size2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
            away = math.sqrt(size2) > NEAR * link
            k = work.pull[i] / (math.sqrt(size2) if away else NEAR * link)
            for c in range(3):
                for e in range(c, 3):
                    work.a[4 * i + c, e - c] += k * (1.0 if c == e else 0.0)
                    if away:
                        work.a[4 * i + c, e - c] -= k * r[c] * r[e] / size2


@njit(cache=True, nogil=True, error_model="numpy")
def _add_contacts(work: Work, contacts: Contacts, moved: float, part: float) -> None:
    """Stiffness of the contacts into the matrix."""
    a = work.a
    for k in range(contacts.used[0]):
        i, j = contacts.link[k], contacts.other[k]
        push, _, _, _, sticks = _touch(work.x, work.begin, contacts, moved, part, k)
        if push > 0.0:
            # The other link answers to the same force in its own rows: twice the stiffness, and neither overshoots.
            stiff = contacts.stiff[k] * (1.0 if j < 0 else 2.0)
            for side in range(1 if j < 0 else 2):
                node = i if side == 0 else j
                s = contacts.place[k, side]
                for c in range(3):
                    for e in range(c, 3):
                        nn = contacts.normal[k, c] * contacts.normal[k, e]
                        value = stiff * (nn * (1.0 - sticks) + (sticks if c == e else 0.0))
                        a[4 * node + c, e - c] += (1.0 - s) * (1.0 - s) * value
                        a[4 * node + 4 + c, e - c] += s * s * value
                        a[4 * node + c, 4 + e - c] += s * (1.0 - s) * value
                        if e > c:
                            a[4 * node + e, 4 + c - e] += s * (1.0 - s) * value


@njit(cache=True, nogil=True, error_model="numpy")
def _change_contacts(
    x: Array, contacts: Contacts, moved: float, part: float, begin: Array, take: bool
) -> tuple[float, float]:
    """The largest change of a multiplier that is due: the way in mm that its k makes of it, and its part of the largest
    push. ``take``: make it.
    """
    worst, strongest, largest = 0.0, 0.0, 0.0
    for k in range(contacts.used[0]):
        push, fx, fy, fz, _ = _touch(x, begin, contacts, moved, part, k)
        change = abs(push - contacts.push[k])
        change = max(change, abs(fx - contacts.grip[k, 0]))
        change = max(change, abs(fy - contacts.grip[k, 1]))
        change = max(change, abs(fz - contacts.grip[k, 2]))
        worst = max(worst, change / contacts.stiff[k])
        strongest = max(strongest, change)
        largest = max(largest, push)
        if take:
            contacts.push[k] = push
            contacts.grip[k, 0], contacts.grip[k, 1], contacts.grip[k, 2] = fx, fy, fz
    return worst, strongest / largest if largest > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def solve(law: Law, work: Work, frame: Array, contacts: Contacts, moved: float, part: float) -> int:
    """Bring ``work.x`` and ``work.tension`` to the stationary point; iterations, or -1 without convergence.

    ``moved`` is the part of the obstacles' way at the end of this problem, ``part`` what it adds to it. On return
    ``work.left`` holds, at held nodes, minus the force of the hold, mN.
    """
    x, tension = work.x, work.tension
    n = len(x)
    touching = contacts.used[0] > 0
    for iteration in range(1, (MOST_CONTACT_ITERATIONS if touching else MOST_ITERATIONS) + 1):
        _residual(law, work, frame, contacts, moved, part)
        for k in range(contacts.used[0]):  # as stiff as the tensions have made the nodes by now
            i = contacts.link[k]
            if contacts.other[k] >= 0:  # not stiffer than inertia can answer: these two wait for one another
                contacts.stiff[k] = SOFT * work.weight[i] if iteration <= PATIENCE else 0.0
                continue
            stiff = work.weight[i] + 6.0 * law.bend + 2.0 * max(abs(tension[i]), abs(tension[i + 1])) / law.link
            contacts.stiff[k] = STIFF * stiff if iteration == 1 else max(contacts.stiff[k], STIFF * stiff)
        for compression in range(2):
            assemble(tension, work.weight, law.bend, law.stretch, law.link, work.t, work.size, compression == 0, work.a)
            _add_contacts(work, contacts, moved, part)
            _add_pulls(work, law.link)
            hold(work.held, work.a)
            if factor(work.a, 4 * n):
                break
        for i in range(n):
            for c in range(3):
                work.b[4 * i + c] = 0.0 if work.held[i] else work.left[i, c]
            work.b[4 * i + 3] = law.link - work.size[i] + law.stretch * tension[i]
        work.b[3] = 0.0
        for k in range(BAND):
            work.b[4 * n + k] = 0.0
        substitute(work.a, 4 * n, work.b)
        turn = 0.0
        furthest = 0.0
        for i in range(n):
            for c in range(3):
                furthest = max(furthest, abs(work.b[4 * i + c]))
                if i > 0:
                    turn = max(turn, abs(work.b[4 * i + c] - work.b[4 * i - 4 + c]))
        if not (furthest < math.inf):
            return -1
        step = 1.0
        if turn > MOST_TURN * law.link:
            step = MOST_TURN * law.link / turn
        for i in range(n):
            for c in range(3):
                x[i, c] += step * work.b[4 * i + c]
            tension[i] += step * work.b[4 * i + 3]
        enough = furthest <= CLOSE * law.link
        if touching and iteration <= PATIENCE:
            # The multipliers wait until the nodes have answered to the last ones: k makes much of a small gap.
            way, share = _change_contacts(x, contacts, moved, part, work.begin, False)
            enough = enough and way <= CLOSE * law.link and share <= FAIR
            if enough or furthest <= SETTLED * way:
                _change_contacts(x, contacts, moved, part, work.begin, True)
        if enough:
            _residual(law, work, frame, contacts, moved, part)
            return iteration
    return -1
