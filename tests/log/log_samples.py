"""Small sessions for the tests of the log."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from trainer import curriculum, events
from trainer.geometry import Array
from trainer.log.record import Metric, SessionHeader
from trainer.poses import ToolPoses
from trainer.sinks.log import LogSink
from trainer.sinks.surface import TickRecord

TICK_HZ = 100.0
METRICS = (
    Metric("bite_mm", 0.1 + 0.2, "mm", 0.2, None, "assumed", "1"),
    Metric("angle_deg", None, "deg", 70.0, 90.0, "nobody", "2"),
)


def header(session_id: str, **changes: Any) -> SessionHeader:
    task = curriculum.load_task("anastomosis/needle-drive")
    plain = SessionHeader(
        id=session_id,
        trainee="Ana",
        task=task.path,
        task_toml=task.text,
        task_sha256=task.sha256,
        device="scripted-expert",
        device_toml="name = 'ä'",
        device_sha256="00",
        seed=7,
        tick_hz=TICK_HZ,
        tools=("left", "right"),
        started_at=f"2026-11-22T{session_id[9:11]}:{session_id[11:13]}:{session_id[13:15]}+00:00",
        versions={"trainer": "0.1.0", "numpy": "2.4"},
        recording=None,
    )
    return replace(plain, **changes)


def poses(tick: int) -> ToolPoses:
    """Poses whose every bit depends on the tick."""
    rng = np.random.default_rng(tick)
    return ToolPoses(rng.normal(size=(2, 3)), rng.normal(size=(2, 4)), rng.uniform(size=2), rng.uniform(size=2) < 0.5)


def pierce(tick: int, seq: int = 0) -> events.Pierce:
    return events.Pierce(
        tick=tick,
        seq=seq,
        time_s=tick / TICK_HZ + 1e-3 / 3.0,
        tool="right",
        body="A",
        wall="outer",
        direction="in",
        pass_number=1,
        hole=seq,
        point=(0.1, -0.0, 1e-17),
        axial_mm=0.35,
        clock_deg=1.0 / 3.0,
        tangent=(0.0, 0.6, 0.8),
        normal=(0.0, 0.0, 1.0),
        entry_angle_deg=53.13,
        force_mN=4.0,
        depth_mm=0.0,
    )


def contact(tick: int, seq: int = 0) -> events.Contact:
    return events.Contact(tick, seq, tick / TICK_HZ, "right", "A", "outer", "in", (1.0, 2.0, 3.0), 0.3, 12.0)


def task_done(tick: int, seq: int = 0, outcome: str = "completed", reason: str = "") -> events.TaskDone:
    here = (0.0, 0.0, 0.0)
    return events.TaskDone(
        tick, seq, tick / TICK_HZ, "", outcome, reason, here, (1.0, 0.0, 0.0), here, 1e-9, 2.5, 0.0
    )  # fmt: skip


def no_snapshot() -> Array:
    raise AssertionError("the log draws nothing")


def step(tick: int, *happened: events.Event) -> TickRecord:
    return TickRecord(tick, tick / TICK_HZ, poses(tick), happened, no_snapshot)


def write(path: Path, session_id: str, ticks: int = 12, metrics: tuple[Metric, ...] = METRICS, **changes: Any) -> None:
    """A finished session: an event in every third tick, the last one done."""
    with closing(LogSink(path, header(session_id, **changes))) as sink:
        for tick in range(ticks):
            sink.tick(step(tick, *([pierce(tick)] if tick % 3 == 0 else [])))
        sink.tick(step(ticks - 1, task_done(ticks - 1, 5)))
        sink.finish("completed", "", ticks, ticks / TICK_HZ, {"overruns": 0}, None, metrics)


def execute(path: Path, sql: str, values: tuple[Any, ...] = ()) -> None:
    """Change a log as somebody with another program would: no foreign keys enforced."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(sql, values)
