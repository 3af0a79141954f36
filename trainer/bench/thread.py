"""The thread's swing and drag: time against error of the rod, the chain, XPBD and follow-the-leader.

Two threads. *bare*: a chain of 1 m without stiffness in a vacuum, whose free end cracks like a whip: the hardest case
for a step in time, and what peers can be given. *suture*: 100 mm of nylon as thin as 10-0 in air, what a scene holds.

The reference shares no code with the methods: accelerations of the chain with one tension per link from a tridiagonal
system, integrated by the classical Runge-Kutta method at a step that resolves every wave. Bending waves of a suture are
faster by 25 with 5 times the links, so that it is solved with 50 links (200 unless quick); finer threads are compared
at these places, from which they differ by the discretisation, (d / L)².

In the drag all methods are told where the held end is five times a frame, or at each of their substeps if these are
longer: what lies between is then next to nothing of their error. A tracker at 100 Hz tells it once a frame; what the
bare chain loses by that, however exactly it is solved, has a row of its own. A method is lost where a node is off by
more than a tenth of the thread, or the length of a link by more than a tenth (assumed).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter_ns
from typing import Protocol

import numpy as np
from numba import njit

from trainer.bench.rows import Row, median_and_p90, worst
from trainer.geometry import Array
from trainer.mechanics.thread import ThreadModel, follow
from trainer.mechanics.thread_chain import begin_chain, step_chain
from trainer.mechanics.thread_rod import Holds, RodModel, begin, holds, monofilament, step
from trainer.mechanics.thread_xpbd import begin_xpbd, step_xpbd

FRAME_S = 0.01
SECONDS = 1.0
PLACES = 5  # of a held end that moves, told in a frame
LOST = 0.1  # of the thread's length, for a node, and of a link's
STEPS = 1.0  # radians of the fastest wave a step; Runge-Kutta is stable to 2.8
LENGTHS = "largest relative error of a link's length"
ERROR_OF = "solver: largest distance of a node at a frame's end from {}, over the thread's length"
#: At which errors, in lengths, the methods are compared.
COMPARED_AT = 5e-3
REFERENCE = "a Runge-Kutta integration of {} links with exact tensions, h = {:.1e} s"


def bare(links: int) -> RodModel:
    """1 m of chain, 1 mg/mm; stretched by less than 1e-7 by its weight."""
    return RodModel(links + 1, 1000.0 / links, 1e-6, 0.0, 1e9)


def suture(links: int) -> RodModel:
    """100 mm of nylon, 0.022 mm thick. Density 1.14 g/cm³ and 2.5 GPa: usual for polyamide 6, assumed here."""
    return monofilament(0.022, 1.14e-6, 2.5e6, 100.0, links + 1)


def still(model: RodModel, time_s: float) -> Array:
    """A held end that stays, (3,) mm."""
    return np.zeros(3)


def forceps(model: RodModel, time_s: float) -> Array:
    """A held end's path (3,) mm: a loop of a tenth of the thread's length in a vertical plane, from rest, in 1 s."""
    angle = 2.0 * math.pi * (time_s - math.sin(2.0 * math.pi * time_s) / (2.0 * math.pi))
    return 0.1 * model.length * np.array([math.cos(angle) - 1.0, 0.0, math.sin(angle)])


Path = Callable[[RodModel, float], Array]


def told(model: RodModel, path: Path, frame: int, count: int) -> Array:
    """Where the held end is (count + 1, 3) mm: at the begin of a frame and ``count`` times until its end."""
    return np.array([path(model, (frame + k / count) * FRAME_S) for k in range(count + 1)])


def straight(model: RodModel) -> Array:
    """Nodes (n, 3) mm along +x from the origin."""
    x = np.zeros((model.count, 3))
    x[:, 0] = model.link * np.arange(model.count)
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def _accelerations(
    x: Array, v: Array, mass: Array, drag: float, bend: float, ax: float, az: float, a: Array, work: Array
) -> None:
    """Of a chain whose node 0 has the acceleration (ax, 0, az): a (n, 3). ``drag`` 1/s; ``work`` (3, n)."""
    n = len(x)
    for i in range(n):
        a[i, 0], a[i, 1], a[i, 2] = -drag * v[i, 0], -drag * v[i, 1], -drag * v[i, 2] - 9810.0
    for i in range(1, n - 1):
        for c in range(3):
            moment = bend * (x[i - 1, c] - 2.0 * x[i, c] + x[i + 1, c])
            a[i - 1, c] -= moment / mass[i - 1]
            a[i, c] += 2.0 * moment / mass[i]
            a[i + 1, c] -= moment / mass[i + 1]
    a[0, 0], a[0, 1], a[0, 2] = ax, 0.0, az
    ratio, right, pull = work[0], work[1], work[2]
    for i in range(1, n):
        ee = ed = vv = lower = upper = 0.0
        for c in range(3):
            e, w = x[i, c] - x[i - 1, c], v[i, c] - v[i - 1, c]
            ee += e * e
            vv += w * w
            ed += e * (a[i, c] - a[i - 1, c])
            if i > 1:
                lower += e * (x[i - 1, c] - x[i - 2, c])
            if i < n - 1:
                upper += e * (x[i + 1, c] - x[i, c])
        here, before = 1.0 / mass[i], 1.0 / mass[i - 1] if i > 1 else 0.0
        diagonal = -ee * (here + before)
        if i > 1:
            diagonal -= lower * before * ratio[i - 1]
        ratio[i] = upper * here / diagonal
        right[i] = (-vv - ed - (lower * before * right[i - 1] if i > 1 else 0.0)) / diagonal
    pull[n - 1] = right[n - 1]
    for i in range(n - 2, 0, -1):
        pull[i] = right[i] - ratio[i] * pull[i + 1]
    for i in range(1, n):
        for c in range(3):
            e = x[i, c] - x[i - 1, c]
            a[i, c] -= pull[i] * e / mass[i]
            if i > 1:
                a[i - 1, c] += pull[i] * e / mass[i - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _runge_kutta(
    x: Array, v: Array, mass: Array, drag: float, bend: float, radius: float, start: float, h: float, steps: int,
    k: Array, y: Array, w: Array, work: Array,
) -> None:  # fmt: skip
    """Classical steps of h; the held node moves along ``forceps`` of this ``radius`` (0: stays). ``k`` (4, n, 3)."""
    n = len(x)
    turn = 2.0 * math.pi
    for s in range(steps):
        for stage in range(4):
            part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            time = start + (s + part) * h
            angle = turn * time - math.sin(turn * time)
            rate = turn * (1.0 - math.cos(turn * time))
            gain = turn * turn * math.sin(turn * time)
            ax = radius * (-math.sin(angle) * gain - math.cos(angle) * rate * rate)
            az = radius * (math.cos(angle) * gain - math.sin(angle) * rate * rate)
            for i in range(n):
                for c in range(3):
                    if stage == 0:
                        y[i, c], w[i, c] = x[i, c], v[i, c]
                    elif stage == 1:
                        y[i, c] = x[i, c] + 0.5 * h * v[i, c]
                        w[i, c] = v[i, c] + 0.5 * h * k[0, i, c]
                    elif stage == 2:
                        y[i, c] = x[i, c] + 0.5 * h * (v[i, c] + 0.5 * h * k[0, i, c])
                        w[i, c] = v[i, c] + 0.5 * h * k[1, i, c]
                    else:
                        y[i, c] = x[i, c] + h * (v[i, c] + 0.5 * h * k[1, i, c])
                        w[i, c] = v[i, c] + h * k[2, i, c]
            _accelerations(y, w, mass, drag, bend, ax, az, k[stage], work)
        for i in range(n):
            for c in range(3):
                x[i, c] += h * v[i, c] + h * h / 6.0 * (k[0, i, c] + k[1, i, c] + k[2, i, c])
                v[i, c] += h / 6.0 * (k[0, i, c] + 2.0 * k[1, i, c] + 2.0 * k[2, i, c] + k[3, i, c])


def reference_step(model: RodModel) -> float:
    """A Runge-Kutta step, s, of ``STEPS`` radians of the fastest bending wave and, of a bare chain, of the whip's.

    With half of it the bare chains of 50, 200 and 1000 links are elsewhere by less than 2e-6 of their length.
    """
    bend = 4.0 * math.sqrt(model.bending / model.mass) / model.link**2
    whip = 4e4 * max(1.0, (model.count - 1) / 200.0)
    return STEPS / max(bend, whip)


def answers(model: RodModel, path: Path, h: float) -> Array:
    """Places (frames + 1, n, 3) mm at the ends of the frames."""
    x, v = straight(model), np.zeros((model.count, 3))
    mass, steps = model.mass * model.node_lengths(), math.ceil(FRAME_S / h)
    radius = 0.1 * model.length if path is forceps else 0.0
    work = np.zeros((4, model.count, 3)), np.zeros_like(x), np.zeros_like(x), np.zeros((3, model.count))
    found = [x.copy()]
    for frame in range(round(SECONDS / FRAME_S)):
        _runge_kutta(
            x, v, mass, model.drag / model.mass, model.bending / model.link**3, radius, frame * FRAME_S,
            FRAME_S / steps, steps, *work,
        )  # fmt: skip
        found.append(x.copy())
    return np.array(found)


class Method(Protocol):
    """What is timed: a frame of a thread whose held end goes through ``places`` (k + 1, 3) mm at even times."""

    name: str
    setting: str

    def frame(self, places: Array) -> Array:
        """Places (n, 3) mm at the frame's end."""


def at_substeps(places: Array, substeps: int) -> Array:
    """The held end (substeps, 3) mm at the end of each substep, on the straight lines between ``places``."""
    told = np.linspace(0.0, 1.0, len(places))
    when = np.arange(1, substeps + 1) / substeps
    return np.stack([np.interp(when, told, places[:, c]) for c in range(3)], axis=1)


class Rod:
    """The rod at a substep (s), or with a tolerance (mm) and substeps of its own."""

    name = "rod"

    def __init__(self, model: RodModel, held: Holds, setting: float, adaptive: bool) -> None:
        self.held, self.state = held, begin(model, straight(model))
        self.substeps = 0 if adaptive else round(FRAME_S / setting)
        self.tolerance = setting if adaptive else 0.0
        self.setting = f"tolerance {setting:g} mm a substep" if adaptive else f"{setting * 1e3:g} ms"

    def frame(self, places: Array) -> Array:
        aims = at_substeps(places, self.substeps) if self.substeps else places[1:]
        for aim in aims:
            self.held.target[0] = aim
            step(self.state, self.held, FRAME_S / len(aims), self.tolerance)
        return self.state.x


class Chain:
    """The bare chain with a tolerance (mm)."""

    name = "chain"

    def __init__(self, model: RodModel, held: Holds, tolerance: float) -> None:
        self.model, self.held, self.tolerance = model, held, tolerance
        self.state, self.setting = begin_chain(model, straight(model)), f"tolerance {tolerance:g} mm a substep"

    def frame(self, places: Array) -> Array:
        for aim in places[1:]:
            self.held.target[0] = aim
            step_chain(self.model, self.state, self.held, FRAME_S / (len(places) - 1), self.tolerance)
        return self.state.x


class Untold(Chain):
    """The same, told once a frame where its held end is."""

    name = "chain, told once a frame"

    def frame(self, places: Array) -> Array:
        return super().frame(places[[0, -1]])


class Beads:
    """XPBD, one sweep a substep."""

    name = "xpbd"

    def __init__(self, model: RodModel, held: Holds, substeps: int) -> None:
        self.model, self.held, self.substeps = model, held, substeps
        self.state, self.setting = begin_xpbd(model, straight(model)), f"{substeps} substeps a frame"

    def frame(self, places: Array) -> Array:
        aims = at_substeps(places, min(self.substeps, len(places) - 1))
        for aim in aims:
            self.held.target[0] = aim
            step_xpbd(self.model, self.state, self.held, FRAME_S / len(aims), self.substeps // len(aims))
        return self.state.x


class Leader:
    """The paper's follow-the-leader: no inertia, no weight. Its error is that of leaving them out."""

    name, setting = "follow-the-leader", "paper"

    def __init__(self, model: RodModel) -> None:
        self.model, self.x = ThreadModel(0.0, model.link, model.count), straight(model)
        self.pieces, self.arc = self.model.whole(), np.zeros(1)

    def frame(self, places: Array) -> Array:
        for aim in places[1:]:
            follow(self.model, self.x, self.arc, aim.reshape(1, 3), self.pieces)
        return self.x


@dataclass
class Tally:
    """What the frames of one method came to."""

    method: Method
    ms: list[float] = field(default_factory=list)
    error: float = 0.0
    stretch: float = 0.0


def run(case: str, model: RodModel, path: Path, methods: list[Method], expected: Array, of: str) -> list[Row]:
    """All methods frame by frame in turn, so that a noisy machine is noisy for all of them.

    ``expected`` (frames + 1, m, 3) at m places evenly along the thread; ``of`` says what it is.
    """
    tallies = [Tally(method) for method in methods]
    turns = list(tallies)
    every = (model.count - 1) // (expected.shape[1] - 1)
    count = 1 if path is still else PLACES
    for frame in range(1, len(expected)):
        places = told(model, path, frame - 1, count)
        turns = turns[1:] + turns[:1]
        for tally in turns:
            begun = perf_counter_ns()
            x = tally.method.frame(places)
            tally.ms.append((perf_counter_ns() - begun) * 1e-6)
            far = np.linalg.norm(x[::every] - expected[frame], axis=1)
            tally.error = worst(tally.error, float(np.max(far)) / model.length)
            sizes = np.linalg.norm(np.diff(x, axis=0), axis=1)
            tally.stretch = worst(tally.stretch, float(np.max(np.abs(sizes / model.link - 1.0))))
    rows = []
    for tally in tallies:
        median, p90 = median_and_p90(tally.ms)
        ended = "done" if max(tally.error, tally.stretch) < LOST else "lost"
        rows.append(
            Row(case, model.count - 1, tally.method.name, tally.method.setting, len(tally.ms), median, p90, tally.error,
                ERROR_OF.format(of), tally.stretch, f"{ended}, lengths within {tally.stretch:.0e}", LENGTHS,
                COMPARED_AT)
        )  # fmt: skip
    return rows


def methods(model: RodModel, quick: bool, whip: bool, drag: bool) -> list[Method]:
    """The methods with their settings; ``whip``: the chain, and substeps of the rod's own choice.

    ``drag``: follow-the-leader too, and a chain that is told less of the way.
    """

    def held() -> Holds:
        return holds(model, [0], [[0, 0, 0]])

    chosen: list[Method] = [Rod(model, held(), h, False) for h in (1e-2, 2e-3)]
    if whip:
        chosen += [Rod(model, held(), t * model.length, True) for t in ((1e-4, 1e-5) if quick else (1e-4, 1e-5, 1e-6))]
        chosen += [Chain(model, held(), t * model.length) for t in ((1e-5,) if quick else (1e-4, 1e-5, 1e-6, 1e-7))]
        if drag:
            chosen.append(Untold(model, held(), 1e-5 * model.length))
    elif not quick:
        chosen.append(Rod(model, held(), 1e-3, False))
    for substeps in (1, 10) if quick else (1, 10, 100, 1000):
        chosen.append(Beads(model, held(), substeps))
    return [*chosen, Leader(model)] if drag else chosen


def measure(quick: bool, sizes: tuple[int, ...] = (50, 200, 1000)) -> list[Row]:
    """All rows, ``sizes`` links each (multiples of the reference's).

    ``quick``: fewer settings, no bare chain of 1000 links; below 15 s.
    """
    links = 50 if quick else 200
    tiny = suture(50)
    run("", tiny, still, methods(tiny, True, False, True), np.zeros((3, 51, 3)), "")  # compiles
    tiny = bare(50)
    run("", tiny, still, methods(tiny, True, True, True), np.zeros((3, 51, 3)), "")
    rows: list[Row] = []
    for name, path in (("swing", still), ("drag", forceps)):
        for size in sizes:
            for kind, build in (("suture", suture), ("bare", bare)):
                if quick and kind == "bare" and size > 200:
                    continue
                model = build(size)
                reference = build(min(size, links)) if kind == "suture" else model
                h = reference_step(reference)
                rows += run(
                    f"{name}, {kind}", model, path, methods(model, quick, kind == "bare", path is forceps),
                    answers(reference, path, h), REFERENCE.format(reference.count - 1, h),
                )  # fmt: skip
    return rows
