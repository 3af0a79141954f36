"""Session records built by hand, with events and motions whose scores are known."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from trainer.curriculum import Task, load_task
from trainer.events import (
    Cut,
    Event,
    Grasp,
    Pierce,
    PortalEnter,
    PortalExit,
    Probe,
    PullThrough,
    StepDone,
    Tack,
    TaskDone,
    TaskStarted,
    Tear,
    Vector,
    Withdraw,
)
from trainer.geometry import Array, unit
from trainer.log.record import SessionHeader, SessionRecord

STITCH = "anastomosis/single-stitch"
DRIVE = "anastomosis/needle-drive"
LIGAMENT = "arthroscopy/ligament-2d"
LANDMARKS = "arthroscopy/probe-landmarks"
PCL = "posterior cruciate ligament"
TICK_HZ = 100.0
TOOLS = ("left", "right")


def task_of(reference: str = STITCH) -> Task:
    return load_task(reference).task


def record(
    events: tuple[Event, ...] = (),
    *,
    reference: str = STITCH,
    left: Array | None = None,
    right: Array | None = None,
    valid: np.ndarray | None = None,
    outcome: str = "completed",
    tick_hz: float = TICK_HZ,
    session: str = "S-0001",
    trainee: str = "Ada",
    started_at: str = "2026-11-20T09:00:00+00:00",
) -> SessionRecord:
    """A record of a task; an instrument without positions (n, 3) waits at the origin."""
    n = max((len(p) for p in (left, right) if p is not None), default=2)
    rest = np.zeros((n, 3))
    position = np.stack([rest if left is None else left, rest if right is None else right], axis=1)
    quaternion = np.zeros((n, 2, 4))
    quaternion[..., 0] = 1.0
    file = load_task(reference)
    header = SessionHeader(
        id=session, trainee=trainee, task=reference, task_toml=file.text, task_sha256=file.sha256,
        device="scripted-expert", device_toml="", device_sha256="", seed=1, tick_hz=tick_hz, tools=TOOLS,
        started_at=started_at, versions={"trainer": "0.1.0"}, recording=None,
    )  # fmt: skip
    return SessionRecord(
        header=header, status="ended", outcome=outcome, ticks=n, duration_s=n / tick_hz,
        events=tuple(sorted(events, key=lambda e: (e.tick, e.seq))), first_tick=0, position=position,
        quaternion=quaternion, closure=np.zeros((n, 2)),
        valid=np.ones((n, 2), dtype=bool) if valid is None else valid,
    )  # fmt: skip


def at(tick: int, seq: int = 0, tool: str = "right") -> dict[str, Any]:
    """The fields that all events share."""
    return {"tick": tick, "seq": seq, "time_s": tick / TICK_HZ, "tool": tool}


def tilted(angle_deg: float, normal: Vector = (0.0, 0.0, 1.0)) -> Vector:
    """A direction at this angle to the plane with this normal."""
    n = unit(normal)
    aside = unit(np.cross(n, [0.3, -0.5, 0.8]))
    a = math.radians(angle_deg)
    x, y, z = math.cos(a) * aside - math.sin(a) * n
    return (float(x), float(y), float(z))


def pierce(tick: int, body: str = "A", wall: str = "outer", direction: str = "in", **given: Any) -> Pierce:
    """A crossing; upright at 12 o'clock with a bite of 0.35 mm unless told otherwise."""
    angle = given.pop("angle", 90.0)
    values: dict[str, Any] = {
        "pass_number": 1, "hole": tick, "point": (0.0, 0.0, 0.5), "axial_mm": 0.35, "clock_deg": 0.0,
        "tangent": tilted(angle), "normal": (0.0, 0.0, 1.0), "entry_angle_deg": angle, "force_mN": 4.0,
        "depth_mm": 0.05,
    }  # fmt: skip
    return Pierce(**at(tick), body=body, wall=wall, direction=direction, **(values | given))


def pull_through(tick: int, p: Pierce, reached_mm: float = 1.0) -> PullThrough:
    """The needle's rear end through the hole of a crossing."""
    return PullThrough(**at(tick), body=p.body, wall=p.wall, hole=p.hole, pass_number=p.pass_number,
                       reached_mm=reached_mm)  # fmt: skip


def withdraw(tick: int, p: Pierce, reached_mm: float = 1.0) -> Withdraw:
    """The tip backwards out of the hole of a crossing."""
    return Withdraw(**at(tick), body=p.body, wall=p.wall, hole=p.hole, pass_number=p.pass_number, end="tip",
                    reached_mm=reached_mm)  # fmt: skip


def stitch(bite_a: float = 0.35, bite_b: float = 0.35, clock_a: float = 0.0, clock_b: float = 0.0,
           angle: float = 90.0, exit_angle: float = 90.0) -> tuple[Event, ...]:  # fmt: skip
    """One pass through both ends, pulled through, with the steps of ``single-stitch``."""
    a = {"axial_mm": bite_a, "clock_deg": clock_a % 360.0, "angle": angle}
    b = {"axial_mm": bite_b, "clock_deg": clock_b % 360.0, "angle": exit_angle}
    crossings = (
        pierce(600, "A", "outer", "in", **a),
        pierce(640, "A", "inner", "in", **a),
        pierce(800, "B", "inner", "out", **b),
        pierce(850, "B", "outer", "out", **b),
    )
    pulled = tuple(pull_through(1100 + i, p) for i, p in enumerate(crossings))
    drawn = (0.0, 0.0, 0.0)
    return (
        TaskStarted(**at(0, tool=""), task=STITCH),
        Grasp(**at(300, tool="left"), target="wall", body="A", arc_mm=0.0, point=drawn, force_mN=40.0),
        *crossings,
        StepDone(**at(640, 1, ""), step="through the wall of A, from outside in", index=0),
        StepDone(**at(850, 1, ""), step="through the wall of B, from inside out", index=1),
        *pulled,
        StepDone(**at(1400, 0, ""), step="pull the thread through to a short tail", index=2),
        StepDone(**at(1700, 0, ""), step="draw the ends together", index=3),
        TaskDone(**at(1700, 1, ""), outcome="completed", reason="", needle_tip=drawn, needle_tangent=(1.0, 0.0, 0.0),
                 thread_end=drawn, thread_length_error=1e-9, tail_mm=2.4, gap_mm=0.08),
    )  # fmt: skip


def ligament() -> SessionRecord:
    """A whole ``ligament-2d``: grasped 3 mm and cut 4 mm from the marks, the tibia touched once, 12 mm³ torn.

    The marks are at (-4, -14, 0) and (0, -7, 0) mm; the two strokes' mean, weighed 3 to 1, is at (4, -7, 0).
    """
    zero = (0.0, 0.0, 0.0)
    names = [s.name for s in task_of(LIGAMENT).step]
    left, right = {"tool": "left"}, {"tool": "right"}
    return record(
        (
            TaskStarted(**at(0, tool=""), task=LIGAMENT),
            Grasp(**at(100, **left), target="tissue", body=PCL, arc_mm=0.0, point=(-4.0, -11.0, 0.0), force_mN=5e4),
            StepDone(**at(100, 1, ""), step=names[0], index=0),
            StepDone(**at(150, 0, ""), step=names[1], index=1),
            Tear(**at(160, tool=""), body=PCL, wall="", hole=-1, point=zero, force_mN=9e3, limit_mN=0.0,
                 volume_mm3=12.0),
            Tack(**at(170, **left), body=PCL, point=zero, volume_mm3=90.0, force_mN=8e3),
            StepDone(**at(170, 1, ""), step=names[2], index=2),
            Probe(**at(180, **right), body="tibia", point=zero),
            Cut(**at(200, **right), body=PCL, point=(3.0, -7.0, 0.0), volume_mm3=60.0),
            Cut(**at(250, **right), body=PCL, point=(7.0, -7.0, 0.0), volume_mm3=20.0),
            StepDone(**at(250, 1, ""), step=names[3], index=3),
            StepDone(**at(260, 0, ""), step=names[4], index=4),
            TaskDone(**at(260, 1, ""), outcome="completed", reason="", needle_tip=zero, needle_tangent=(1.0, 0.0, 0.0),
                     thread_end=zero, thread_length_error=0.0, tail_mm=0.0, gap_mm=1.6, pull_max_mN=9e3),
        ),
        reference=LIGAMENT,
    )  # fmt: skip


def landmarks() -> SessionRecord:
    """``probe-landmarks`` given up after three of four: in twice through the portal, the femur touched once, 640 mN."""
    zero = (0.0, 0.0, 0.0)
    right = {"tool": "right"}
    steps = task_of(LANDMARKS).step[:3]
    return record(
        (
            TaskStarted(**at(0, tool=""), task=LANDMARKS),
            PortalEnter(**at(50, **right), point=zero),
            Probe(**at(60, **right), body="femur", point=zero, force_mN=60.0),
            PortalExit(**at(70, **right), point=zero),
            PortalEnter(**at(80, **right), point=zero),
            *(Probe(**at(100 + i, **right), body=s.structure, point=zero, force_mN=55.0) for i, s in enumerate(steps)),
            *(StepDone(**at(100 + i, 1, ""), step=s.name, index=i) for i, s in enumerate(steps)),
            TaskDone(**at(260, 1, ""), outcome="aborted", reason="", needle_tip=zero, needle_tangent=(1.0, 0.0, 0.0),
                     thread_end=zero, thread_length_error=0.0, tail_mm=0.0, gap_mm=0.0, press_max_mN=640.0),
        ),
        reference=LANDMARKS,
    )  # fmt: skip


def reach(start: Vector, end: Vector, seconds: float, tick_hz: float = TICK_HZ) -> Array:
    """A minimum-jerk movement (n, 3) from start to end (Flash and Hogan 1985): 10 s³ - 15 s⁴ + 6 s⁵."""
    s = np.linspace(0.0, 1.0, round(seconds * tick_hz) + 1)[:, None]
    return np.asarray(start) + (10 * s**3 - 15 * s**4 + 6 * s**5) * (np.asarray(end) - np.asarray(start))


def hold(place: Vector, seconds: float, tick_hz: float = TICK_HZ) -> Array:
    """A rest (n, 3) at a place."""
    return np.tile(np.asarray(place, dtype=np.float64), (round(seconds * tick_hz), 1))


def performed(seed: int = 0, skill: float = 0.5, **named: str) -> SessionRecord:
    """A whole ``single-stitch`` with noise: skill 0 is a first attempt, 1 an expert's."""
    rng = np.random.default_rng(seed)
    rough = 1.0 - skill
    events = stitch(
        bite_a=0.35 + 0.18 * rough * rng.standard_normal() ** 2,
        bite_b=0.35 + 0.08 * rough * rng.standard_normal(),
        clock_a=14.0 * rough * rng.standard_normal(),
        clock_b=14.0 * rough * rng.standard_normal(),
        angle=90.0 - min(abs(4.0 + 40.0 * rough * (0.5 + 0.3 * rng.standard_normal())), 85.0),
        exit_angle=90.0 - min(abs(6.0 + 40.0 * rough * (0.4 + 0.3 * rng.standard_normal())), 85.0),
    )
    slow = 1.0 + 2.0 * rough + 0.2 * rng.random()
    events = tuple(_stretched(e, slow) for e in events)
    places = [(0.0, 0.0, 4.0), *(tuple(rng.normal(0.0, 3.0 + 4.0 * rough, 3)) for _ in range(5)), (0.0, 0.0, 1.0)]
    ways = [reach(p, q, 2.7 * slow) for p, q in itertools.pairwise(places)]
    right = np.concatenate([hold((0.0, 0.0, 4.0), 1.0), *ways])
    last = max(e.tick for e in events)
    right = np.concatenate([right, hold((0.0, 0.0, 1.0), max(0, last + 1 - len(right)) / TICK_HZ)])
    right += rng.normal(0.0, 0.01, right.shape)
    left = np.concatenate([hold((0.0, 5.0, 4.0), 1.5), reach((0.0, 5.0, 4.0), (0.0, 1.0, 1.0), 2.0)])
    left = np.concatenate([left, np.tile(left[-1], (len(right) - len(left), 1))])
    return record(events, left=left, right=right, **named)  # type: ignore[arg-type]


def _stretched(event: Event, factor: float) -> Event:
    return dataclasses.replace(event, tick=round(event.tick * factor), time_s=event.time_s * factor)
