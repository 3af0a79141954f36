"""Volumes of elements: time against positions that differ from the published order of ChainMail.

A block is dragged by its middle element so far that all of it goes along, or a little so that only its neighbourhood
does; a volume of two materials; relaxation of the whole; the drag of a free part of a volume of the size of a clinical
image; and four bodies of 64³ that move at once through an occupancy map. The pace of the memory stands beside them:
scaling the same displacements in place, on one core. The methods of a case take turns, frame by frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter_ns

import numpy as np

from trainer.bench.chart import LIMIT
from trainer.bench.rows import Row, median_and_p90
from trainer.bench.stream import scale
from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.contact_response import push_out, surface_normals
from trainer.mechanics.elastic_relaxation import SWEEPS, relax, sweep
from trainer.mechanics.occupancy import OccupancyMap, surface_elements
from trainer.mechanics.sharing import share_out
from trainer.mechanics.volume import Material, Volume, VolumeState, build, bytes_per_element, places, start, wake
from trainer.mechanics.volume_drag import drag

SIZES, QUICK_SIZES = (50, 128, 256), (50, 64)
#: A clinical image (paper, 4.2.1) and the side of its free part.
IMAGE, FREE_PART = (512, 512, 90), 80
#: Random blocks, pulls, limits and held elements that lists and scan are compared on; and a short run's.
TRIALS, QUICK_TRIALS = 100, 10
TRIAL_SIDE, QUICK_TRIAL_SIDE = 256, 32
FRAMES, QUICK_FRAMES = 20, 6
#: How far a whole block is dragged, in sides, and a neighbourhood, in element lengths.
FAR, NEAR = 2.0, 1.0
#: The bodies that move at once.
BODY = 64
#: The bodies move into each other: for so many times the frames of other cases, most of them pressed together.
PRESSED = 3
TISSUE = Material("tissue", (1.2,) * 3, (0.8,) * 3, (0.2,) * 3, young_kPa=100.0, shear_kPa=40.0, time_constant_s=0.1)
FIRM = Material("firm", (1.1,) * 3, (0.9,) * 3, (0.1,) * 3, young_kPa=400.0, shear_kPa=160.0, time_constant_s=0.1)

ORDER = "order: largest difference of a displacement from the published lists', mm"
LIMITS = "limits: how far the worst link is beyond its limits, mm"
NONE = "nothing: no answer is compared"
PACE = "memory: none, a pace"
#: At which errors methods are compared: the same displacements to the last bit; and the spacing of float32 at the
#: 100 mm by which a block of two materials is dragged.
SAME, ROUNDING_MM = 0.0, 1e-5

Step = Callable[[int], None]


@dataclass
class Method:
    """One way to do a case's work."""

    name: str
    setting: str
    step: Step
    error_of: str = NONE
    compared_at: float | None = None
    ms: list[float] = field(default_factory=list)


def block(side: int, materials: tuple[Material, ...] = (TISSUE,)) -> Volume:
    """A cube of elements of 1 mm, in layers of the materials."""
    labels = np.ones((side,) * 3, dtype=np.uint8)
    for m in range(1, len(materials)):
        labels[:, :, m :: len(materials)] = m + 1
    return build(labels, (1.0, 1.0, 1.0), {m + 1: of for m, of in enumerate(materials)})


def in_turn(case: str, size: int, methods: list[Method], frames: int) -> list[Row]:
    """Time all methods frame by frame; the first frame of each compiles and is left out."""
    for frame in range(-1, frames):
        for method in methods:
            begun = perf_counter_ns()
            method.step(frame)
            if frame >= 0:
                method.ms.append((perf_counter_ns() - begun) * 1e-6)
    rows = []
    for m in methods:
        median, p90 = median_and_p90(m.ms)
        rows.append(
            Row(
                case,
                size,
                m.name,
                m.setting,
                len(m.ms),
                median,
                p90,
                math.nan,
                m.error_of,
                math.nan,
                "done",
                "nothing",
                m.compared_at,
            )
        )
    return rows


def pace(volume: Volume) -> Method:
    """The memory's own: as many bytes as a volume's displacements, scaled in place."""
    values = np.full(3 * volume.labels.size // 2, 1.0)  # as many bytes as that many float32
    return Method(
        f"{LIMIT} of reading and writing displacements",
        "of all, in place",
        lambda frame: scale(values, 1.0),
        error_of=PACE,
    )


def _middle(volume: Volume) -> np.ndarray:
    i, j, k = (n // 2 for n in volume.shape)
    return np.array([np.ravel_multi_index((i, j, k), volume.shape)], dtype=np.int32)


def whole(side: int, frames: int) -> list[Row]:
    """The whole block to and fro."""
    volume = block(side)
    held, way = _middle(volume), FAR * side * np.array([1.0, 0.7, 0.3])
    states = {name: start(volume) for name in ("lists", "scan")}

    def dragging(name: str) -> Step:
        return lambda frame: _note(drag(volume, states[name], held, way * (1 - 2 * (frame % 2)), name).count)

    methods = [Method(f"ChainMail, {name}", "one material", dragging(name), ORDER, SAME) for name in states]
    rows = in_turn("drag of a whole block", side**3, [*methods, pace(volume)], frames)
    off = [_apart(states["lists"], state) for state in states.values()]
    return [*(replace(row, error=error) for row, error in zip(rows, off, strict=False)), *rows[len(off) :]]


def _note(count: int) -> None:
    """Nothing; a step returns nothing."""


def _apart(one: VolumeState, other: VolumeState) -> float:
    """The largest difference of a displacement, mm."""
    return float(np.abs(one.u - other.u).max())


def local(side: int, frames: int) -> list[Row]:
    """A pull that only the neighbourhood follows, growing a little from frame to frame."""
    volume = block(side)
    held = _middle(volume)
    states = {"lists": start(volume), "scan": start(volume), None: start(volume)}
    methods = []
    for name, state in states.items():

        def step(frame: int, state: VolumeState = state, name: str | None = name) -> None:
            drag(volume, state, held, NEAR * (1.0 + 0.02 * frame) * np.array([1.0, 0.7, 0.3]), name)

        methods.append(Method(f"ChainMail, {name or 'chosen by size'}", "one material", step, ORDER, SAME))
    rows = in_turn(f"pull by {NEAR:g} element length", side**3, methods, frames)
    off = [_apart(states["lists"], state) for state in states.values()]
    return [replace(row, error=error) for row, error in zip(rows, off, strict=True)]


def mixed(side: int, frames: int) -> list[Row]:
    """The same drag of a block in layers of two materials, and of one of one material by lists."""
    two, one = block(side, (TISSUE, FIRM)), block(side)
    held, way = _middle(two), FAR * side * np.array([1.0, 0.7, 0.3])
    states = {"largest first": start(two), "corrected": start(two), "lists": start(one)}

    def dragging(name: str) -> Step:
        volume = one if name == "lists" else two
        return lambda frame: _note(drag(volume, states[name], held, way * (1 - 2 * (frame % 2)), name).count)

    methods = [
        Method(f"ChainMail, {name}", f"{'one material' if name == 'lists' else 'two materials in layers'}",
               dragging(name), LIMITS, ROUNDING_MM)
        for name in states
    ]  # fmt: skip
    rows = in_turn("drag of a block of two materials", side**3, methods, frames)
    volumes = (two, two, one)
    return [replace(r, error=beyond_limits(v, s)) for r, v, s in zip(rows, volumes, states.values(), strict=True)]


def beyond_limits(volume: Volume, state: VolumeState) -> float:
    """How far the worst link is beyond its limits, mm; 0 if none is."""
    worst = 0.0
    m = volume.material_of[volume.labels]
    u = state.u.reshape(3, *volume.shape)
    for axis in range(3):
        near = [slice(None)] * 3
        far = [slice(None)] * 3
        near[axis], far[axis] = slice(None, -1), slice(1, None)
        a, b = m[tuple(near)], m[tuple(far)]
        for c in range(3):
            apart = u[c][tuple(far)] - u[c][tuple(near)]
            low, high = volume.low[a, b, 2 * axis, c], volume.high[a, b, 2 * axis, c]
            worst = max(worst, float(np.maximum(low - apart, apart - high).max(initial=0.0)))
    return worst


def growth(side: int, frames: int) -> list[Row]:
    """Pulls further and further: time against how many moved, with the slope of a fit in logarithms as the residual."""
    volume = block(side)
    held = _middle(volume)
    rows: list[Row] = []
    counts = []
    for length in (0.5, 1.0, 2.0, 4.0, 8.0):
        state = start(volume)
        last = [0]

        def step(frame: int, state: VolumeState = state, last: list[int] = last, length: float = length) -> None:
            state.u[:] = 0.0 if frame < 0 else state.u
            last[0] = drag(volume, state, held, length * (1.0 + 0.01 * frame) * np.array([1.0, 0.7, 0.3])).count

        of = Method("ChainMail, chosen by size", f"pull by {length:g} element lengths", step)
        rows += in_turn("growth with the elements that move", side**3, [of], frames)
        counts.append(last[0])
    slope = float(np.polyfit(np.log(counts), np.log([r.median_ms for r in rows]), 1)[0])
    return [
        replace(r, residual=slope, residual_of="exponent of time against elements moved, of all pulls",
                status=f"{count} moved, {1e6 * r.median_ms / count:.0f} ns each")
        for r, count in zip(rows, counts, strict=True)
    ]  # fmt: skip


def relaxation(side: int, frames: int) -> list[Row]:
    """A sweep of the whole block, from random displacements."""
    volume = block(side)
    state = start(volume)
    state.u[:] = np.random.default_rng(0).normal(size=state.u.shape)

    def step(frame: int) -> None:
        wake(state, np.zeros(3, np.int32), np.array(volume.shape, np.int32) - 1)
        sweep(volume, state, TISSUE.time_constant_s / SWEEPS, look=False)

    return in_turn("relaxation sweep", side**3, [Method("elastic relaxation", "linear", step), pace(volume)], frames)


def image(frames: int) -> list[Row]:
    """A volume of the size of a clinical image, one part of which is free, dragged to and fro; and all of it free."""
    rows = []
    for setting, part in ((f"{FREE_PART}³ free", FREE_PART), ("all free", max(IMAGE))):
        labels = np.full(IMAGE, 2, dtype=np.uint8)
        at = tuple(slice(max(0, (n - part) // 2), (n + part) // 2) for n in IMAGE)
        labels[at] = 1
        begun = perf_counter_ns()
        volume = build(labels, (0.25, 0.25, 1.4), {1: TISSUE}, joined=[])
        state = start(volume)
        loaded_s = (perf_counter_ns() - begun) * 1e-9
        held = _middle(volume)

        def step(frame: int, volume: Volume = volume, state: VolumeState = state, held: np.ndarray = held) -> None:
            drag(volume, state, held, 50.0 * np.array([1.0, 0.7, 0.3]) * (1 - 2 * (frame % 2)))

        of = Method("ChainMail, chosen by size", setting, step)
        each = bytes_per_element(volume, state)
        memory = f"{each:.0f} B an element, {1e-6 * each * labels.size:.0f} MB at most"
        rows += [
            replace(r, status=f"{1e3 / r.median_ms:.0f} moves/s; {memory}; made in {loaded_s:.1f} s")
            for r in in_turn("drag in a 512 × 512 × 90 image", labels.size, [of], frames)
        ]
    return rows


def trials(count: int, side: int) -> Row:
    """Lists and scan on random blocks, pulls, limits and held elements: how many of ``count`` differ in any bit."""
    rng = np.random.default_rng(0)
    differ, worst = 0, 0.0
    for _ in range(count):
        of = Material(
            "random", tuple(rng.uniform(1.0, 1.5, 3)), tuple(rng.uniform(0.5, 1.0, 3)), tuple(rng.uniform(0.0, 0.5, 3)),
            100.0, 40.0, 0.1,
        )  # fmt: skip
        volume = block(side, (of,))
        states = [start(volume), start(volume)]
        for _ in range(2):
            held = rng.integers(0, volume.labels.size, 1).astype(np.int32)
            to = rng.normal(size=3) * rng.choice([1.0, side])
            for state, name in zip(states, ("lists", "scan"), strict=True):
                drag(volume, state, held, to, name)
        worst = max(worst, float(np.abs(states[0].u - states[1].u).max()))
        differ += not np.array_equal(states[0].u, states[1].u)
    return Row(
        "lists and scan on random pulls", side**3, "ChainMail, scan", f"{count} trials", 0, math.nan, math.nan, worst,
        ORDER, float(differ), f"{differ} of {count} differ", "trials that differ in any bit",
    )  # fmt: skip


class Bodies:
    """Two rigid and two deformable cubes that move into each other, with contact of all and of tissue with itself."""

    def __init__(self, side: int) -> None:
        self.volume = block(side)
        self.states = [start(self.volume), start(self.volume)]
        outer = surface_elements(self.states[0])
        self.outer = outer
        self.rest = self.volume.rest(outer)
        self.normals = surface_normals(self.states[0], outer)
        index = np.stack(np.unravel_index(outer, self.volume.shape), axis=1)
        self.map = OccupancyMap((-side,) * 3, (3.0 * side,) * 3, 1.0, [index] * 4)
        self.side = side
        n = len(outer)
        self.points, self.facing = np.zeros((4 * n, 3)), np.tile(self.normals, (4, 1))
        self.soft = np.repeat([False, False, True, True], n)
        self.at = [np.zeros(3), np.array([0.0, side + 2.0, 0.0]), np.array([side + 0.5, 0.0, 0.0]),
                   np.array([side + 0.5, side + 0.5, 0.0])]  # fmt: skip
        self.touched = 0

    def tick(self, frame: int) -> None:
        """10 ms: bones turn, tissue is pulled and relaxes, all are entered in the map, what touches is pushed out."""
        n = len(self.outer)
        for b in range(2):
            turn = quaternion_from_axis_angle((0.0, 0.0, 1.0), 0.02 * np.sin(0.3 * frame + b))
            pose = Rigid(self.at[b] + (0.5 * np.sin(0.2 * frame), 0.0, 0.0), turn)
            self._enter(b, pose.apply(self.rest))
            self.facing[b * n : (b + 1) * n] = pose.rotate(self.normals)
        tissues = [(0, 1), (1, 2)]  # at the same time: they meet in the map alone

        def pull(tissue: tuple[int, int]) -> None:
            state = self.states[tissue[0]]
            drag(self.volume, state, _middle(self.volume), self.side * 0.3 * np.array([np.sin(0.3 * frame), 0.2, 0.1]))
            relax(self.volume, state, 0.01)

        share_out(pull, tissues)
        for b, state in enumerate(self.states):
            self._enter(2 + b, places(self.volume, state, self.outer) + self.at[2 + b])
        pairs = self.map.touching()
        self.touched = len(pairs)
        entries, by = push_out(self.points, self.facing, pairs, self.soft, self.map.cell_mm)

        def give_way(tissue: tuple[int, int]) -> None:
            b, state = tissue[0], self.states[tissue[0]]
            mine = (entries >= (2 + b) * n) & (entries < (3 + b) * n)
            held = self.outer[entries[mine] - (2 + b) * n]
            if len(held):
                drag(self.volume, state, held, state.u[:, held].T + by[mine])

        share_out(give_way, tissues)

    def _enter(self, body: int, points: Array) -> None:
        n = len(self.outer)
        self.points[body * n : (body + 1) * n] = points
        self.map.update(body, points)


def bodies(side: int, frames: int) -> list[Row]:
    """Four bodies at once."""
    four = Bodies(side)
    of = Method("occupancy map", "two rigid, two deformable, surface elements", four.tick)
    rows = in_turn("four bodies move and touch", 4 * side**3, [of], frames)
    return [replace(r, status=f"{1e3 / r.median_ms:.0f} Hz, {four.touched} pairs") for r in rows]


def measure(quick: bool, sizes: tuple[int, ...] | None = None) -> list[Row]:
    """All rows. Kernels are compiled before."""
    frames = QUICK_FRAMES if quick else FRAMES
    sizes = sizes or (QUICK_SIZES if quick else SIZES)
    rows: list[Row] = []
    for side in sizes:
        rows += whole(side, frames) + local(side, frames) + relaxation(side, frames)
    rows += mixed(sizes[0], frames) + growth(sizes[-1], frames)
    rows.append(trials(QUICK_TRIALS if quick else TRIALS, min(QUICK_TRIAL_SIDE if quick else TRIAL_SIDE, sizes[-1])))
    rows += bodies(min(BODY, sizes[-1]), PRESSED * frames)
    return rows if quick else rows + image(frames)
