"""A made-up stitch for tests and pictures of the recording: it looks like the real thing, and obeys no physics."""

from __future__ import annotations

import itertools
import math
import pickle
from collections.abc import Iterator

import numpy as np

from trainer import events
from trainer.geometry import Array, Rigid, quaternion_from_axes
from trainer.instruments import forceps
from trainer.log.record import Metric, SessionHeader
from trainer.poses import ToolPoses
from trainer.sinks.surface import Frame, InstrumentPart, Layout, Surface, TickRecord

TOOLS = ("left", "right")
NEEDLE_RADIUS_MM = 3.8 / math.radians(135.0)
LAYERS, AROUND = 21, 24
TASK_TOML = """
[[step]]
name = "through the wall of A"
[[step]]
name = "pull the thread through"
"""


def header(seed: int = 1) -> SessionHeader:
    return SessionHeader(
        id="20261122-made-up",
        trainee="A. Person",
        task="anastomosis/single-stitch",
        task_toml=TASK_TOML,
        task_sha256="0" * 64,
        device="scripted-expert",
        device_toml="",
        device_sha256="0" * 64,
        seed=seed,
        tick_hz=100.0,
        tools=TOOLS,
        started_at="2026-11-22T10:00:00+00:00",
        versions={"trainer": "0.1.0", "python": "3.11"},
        recording=None,
    )


def vessel(edge_x: float, side: float, squeeze: float) -> Array:
    """Both hulls of a tube along ``side`` x from its cut edge, (2 LAYERS AROUND, 3); squeezed near the edge."""
    s = np.linspace(0.0, 2.0, LAYERS)
    phi = np.arange(AROUND) * (2.0 * math.pi / AROUND)
    hulls = []
    for radius in (0.5, 0.35):
        r = radius * (1.0 - squeeze * np.exp(-((s[:, None] / 0.5) ** 2)) * np.cos(phi) ** 2)
        x = np.broadcast_to(edge_x + side * s[:, None], r.shape)
        hulls.append(np.stack([x, r * np.sin(phi), r * np.cos(phi)], axis=-1).reshape(-1, 3))
    return np.concatenate(hulls)


def vessel_triangles(side: float) -> np.ndarray:
    """Outer hull outwards, inner hull towards the lumen, and the rings at both ends."""
    n = LAYERS * AROUND

    def strip(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        an, bn = np.roll(a, -1), np.roll(b, -1)
        return np.concatenate([np.stack([a, an, b], 1), np.stack([an, bn, b], 1)])

    rows = np.arange(n).reshape(LAYERS, AROUND)
    outer = np.concatenate([strip(a, b) for a, b in itertools.pairwise(rows)])
    faces = np.concatenate(
        [outer, (outer + n)[:, ::-1], strip(rows[0] + n, rows[0]), strip(rows[-1], rows[-1] + n)]
    ).astype(np.int32)
    return np.ascontiguousarray(faces if side < 0 else faces[:, ::-1])


def needle_line() -> Array:
    """An arc of 135 degrees in the needle's xz-plane, tip first at the origin, heading -x there (50, 3)."""
    a = np.linspace(0.0, math.radians(135.0), 50)
    return NEEDLE_RADIUS_MM * np.stack([np.sin(a), np.zeros_like(a), 1.0 - np.cos(a)], axis=1)


def layout() -> Layout:
    flesh = (226, 120, 110, 205)
    return Layout(
        frame=unpacked,
        surfaces=(
            Surface("vessel/A", vessel_triangles(-1.0), flesh),
            Surface("vessel/B", vessel_triangles(1.0), flesh),
        ),
        parts=tuple(
            InstrumentPart(f"{tool}/{blade.name}", k, blade.vertices, blade.triangles)
            for k, tool in enumerate(TOOLS)
            for blade in forceps.parts()
        ),
        needle=needle_line(),
        needle_radius_mm=0.035,
        thread_radius_mm=0.0125,
    )


def tool_pose(tool: int, phase: float) -> Rigid:
    """The right hand holds the needle's rear third, the left steadies the edge of A."""
    if tool == 0:
        return Rigid(
            np.array([-0.45, 0.52 + 0.3 * (1.0 - phase), 0.1]), quaternion_from_axes([0.35, -1.0, -0.8], [1, 0, 0.3])
        )
    needle = needle_pose(phase)
    hold = needle.apply(needle_line()[34])
    return Rigid(hold, quaternion_from_axes([-1.0, 0.75, -0.7], [0.1, 0.6, 0.7]))


def needle_pose(phase: float) -> Rigid:
    """The needle turns about the middle of its arc; at phase 1 its tip has come through both edges."""
    turn = math.radians(-95.0 + 95.0 * phase)
    q = np.array([math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0])
    centre = np.array([0.0, 0.0, 1.55])
    about_centre = Rigid(np.zeros(3), q)
    return Rigid(centre - about_centre.rotate([0.0, 0.0, NEEDLE_RADIUS_MM]), q)


def thread(phase: float) -> tuple[Array, ...]:
    """100 links from the needle's rear end, in a loose curve over the near side."""
    needle = needle_pose(phase)
    rear = needle.apply(needle_line()[-1])
    s = np.linspace(0.0, 1.0, 101)
    curve = np.stack(
        [
            2.6 * s + 0.5 * np.sin(7.0 * s) * s,
            -2.2 * s**1.3 + 0.5 * np.sin(9.0 * s + phase) * s,
            -1.9 * np.minimum(1.0, 1.6 * s) ** 0.8 * (1.0 - 0.05 * np.cos(11.0 * s)),
        ],
        axis=1,
    )
    return (rear + curve,)


def frame(tick: int, ticks: int) -> Frame:
    phase = tick / max(1, ticks)
    positions, quaternions = zip(
        *(forceps.part_poses(tool_pose(k, phase), closure(k, phase)) for k in range(2)), strict=True
    )
    needle = needle_pose(phase)
    squeeze = 0.12 * math.sin(math.pi * phase) ** 2
    return Frame(
        vertices=(vessel(-0.2, -1.0, squeeze), vessel(0.2, 1.0, 0.5 * squeeze)),
        part_position=np.concatenate(positions),
        part_quaternion=np.concatenate(quaternions),
        needle_position=needle.position,
        needle_quaternion=needle.quaternion,
        thread=thread(phase),
        force_mN=4.0 * abs(math.sin(9.0 * phase)) * math.exp(-((phase - 0.5) ** 2) * 8.0),
        tension_mN=2.0 + 1.5 * phase,
    )


def packed(frame: Frame) -> Array:
    """As a tick hands it over: whole float64, of which only the layout knows what they mean."""
    data = pickle.dumps(frame)
    return np.frombuffer(data + bytes(-len(data) % 8))


def unpacked(values: Array) -> Frame:
    frame: Frame = pickle.loads(values.tobytes())
    return frame


def closure(tool: int, phase: float) -> float:
    return 0.93 if tool == 1 else 0.5 + 0.4 * phase


def records(ticks: int = 300, hz: float = 100.0) -> Iterator[TickRecord]:
    """The session, tick by tick, with one event of most levels."""
    happened = made_up_events(ticks, hz)
    for tick in range(ticks + 1):
        phase = tick / ticks
        poses = [tool_pose(k, phase) for k in range(2)]
        yield TickRecord(
            tick,
            tick / hz,
            ToolPoses(
                np.stack([p.position for p in poses]),
                np.stack([p.quaternion for p in poses]),
                np.array([closure(k, phase) for k in range(2)]),
                np.ones(2, dtype=bool),
            ),
            tuple(e for e in happened if e.tick == tick),
            lambda tick=tick: packed(frame(tick, ticks)),
        )


def made_up_events(ticks: int, hz: float) -> tuple[events.Event, ...]:
    origin = (0.0, 0.0, 0.5)

    def at(part: float) -> tuple[int, float]:
        tick = int(part * ticks)
        return tick, tick / hz

    def shared(part: float, tool: str = "right", seq: int = 0) -> tuple[int, int, float, str]:
        tick, time_s = at(part)
        return tick, seq, time_s, tool

    pierce = shared(0.4)
    return (
        events.TaskStarted(*shared(0.0, ""), task="anastomosis/single-stitch"),
        events.Grasp(*shared(0.0, seq=1), target="needle", body="", arc_mm=2.6, point=origin, force_mN=200.0),
        events.Contact(*shared(0.3), "A", "outer", "in", origin, 0.35, 0.0),
        events.Pierce(
            pierce[0], 0, pierce[2] - 0.004, "right", "A", "outer", "in", 1, 0, origin, 0.35, 0.0,
            (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 84.0, 4.02, 0.0,
        ),
        events.Overforce(*shared(0.5, "left"), body="A", quantity="tissue_pull", value=71.0, limit=60.0, unit="mN"),
        events.StepDone(*shared(0.7, ""), step="through the wall of A", index=0),
        events.Release(*shared(0.8), target="needle", body=""),
        events.Tear(*shared(0.9), body="A", wall="outer", hole=0, point=origin, force_mN=151.0, limit_mN=150.0),
        events.TaskDone(
            *shared(1.0, ""), outcome="completed", reason="all steps done", needle_tip=origin,
            needle_tangent=(0.0, 0.0, -1.0), thread_end=origin, thread_length_error=0.0, tail_mm=2.0, gap_mm=0.1,
        ),
    )  # fmt: skip


METRICS = (
    Metric("entry_angle_deg", 84.0, "deg", 70.0, 90.0, "assumed", "1"),
    Metric("extra_holes", 0.0, "1", 0.0, 0.0, "every hole in a wall is a leak", "1"),
    Metric("time_s", 3.0, "s", None, None, "no target", "1"),
    Metric("side_mismatch_mm", None, "mm", 0.0, 0.15, "assumed", "1"),
)
