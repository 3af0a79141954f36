"""A stored session as a device gives back every stored number, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from trainer.config import ConfigError
from trainer.curriculum import Task, load_task
from trainer.drivers import open_driver
from trainer.events import Event, TrackingLost
from trainer.geometry import Array
from trainer.log.record import SessionHeader
from trainer.log.schema import LogError
from trainer.poses import ToolPoses
from trainer.sinks.log import LogSink
from trainer.sinks.surface import TickRecord

ROWS = 60
Events = Mapping[int, tuple[Event, ...]]  # by tick
NONE: Events = {}


@pytest.fixture(scope="module")
def task() -> Task:
    return load_task("anastomosis/needle-drive").task


@pytest.fixture(scope="module")
def stored() -> list[ToolPoses]:
    rng = np.random.default_rng(5)
    q = rng.normal(size=(ROWS, 2, 4))
    q /= np.linalg.norm(q, axis=2, keepdims=True)
    return [
        ToolPoses(rng.normal(size=(2, 3)), q[k], rng.uniform(size=2), rng.uniform(size=2) < 0.5) for k in range(ROWS)
    ]


def no_snapshot() -> Array:
    raise AssertionError("the log needs no frame")


def log(
    path: Path, rows: list[ToolPoses], tools: tuple[str, ...], tick_hz: float, ticks: int, events: Events = NONE
) -> str:
    header = SessionHeader(
        id="20250101-000000-abcd", trainee="A", task="t", task_toml="", task_sha256="", device="d", device_toml="",
        device_sha256="", seed=0, tick_hz=tick_hz, tools=tools, started_at="2025-01-01T00:00:00Z", versions={},
        recording=None,
    )  # fmt: skip
    sink = LogSink(path, header)
    for tick, poses in enumerate(rows):
        sink.tick(TickRecord(tick, tick / tick_hz, poses, events.get(tick, ()), no_snapshot))
    sink.finish("failed", "the input ended", ticks, ticks / tick_hz, None, None, ())
    sink.close()
    return f"{path}#{header.id}"


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_stored_rows_come_back_bit_for_bit_by_instrument(
    tmp_path: Path, task: Task, stored: list[ToolPoses], order: tuple[str, str]
) -> None:
    reference = log(tmp_path / "s.db", stored, order, task.tick_hz, ROWS)
    file, driver = open_driver(reference, task, stored[0], seed=0)
    assert file.profile.name == "logged-session"
    columns = [order.index(instrument.tool) for instrument in task.scene.instrument]
    for tick, wanted in enumerate(stored):
        got = driver.poll(tick, None)
        assert got is not None
        for name in ("position", "quaternion", "closure", "valid"):
            assert np.array_equal(getattr(got, name), getattr(wanted, name)[columns])
    assert driver.poll(ROWS, None) is None
    assert driver.summary()["frames_consumed"] == ROWS


def test_a_lost_instrument_is_lost_for_the_same_reason(tmp_path: Path, task: Task, stored: list[ToolPoses]) -> None:
    """The reason is an input that the log keeps in the event: played or simulated again, it is there."""
    tools = ("right", "left")
    lost = TrackingLost(2, 0, 0.02, "left", reason="the port is gone")
    reference = log(tmp_path / "s.db", stored, tools, task.tick_hz, ROWS, {2: (lost,)})
    _, driver = open_driver(reference, task, stored[0], seed=0)
    reasons = {tick: poses.reason for tick in range(ROWS) if (poses := driver.poll(tick, None)) is not None}
    left = [instrument.tool for instrument in task.scene.instrument].index("left")
    wanted = ["", ""]
    wanted[left] = "the port is gone"
    assert reasons == {tick: tuple(wanted) if tick == 2 else ("", "") for tick in range(ROWS)}


def test_a_closing_row_that_was_never_stepped_is_not_played(
    tmp_path: Path, task: Task, stored: list[ToolPoses]
) -> None:
    """A session whose input ended stores one row more than it stepped: playing it would add a tick."""
    reference = log(tmp_path / "s.db", stored, ("left", "right"), task.tick_hz, ROWS - 1)
    _, driver = open_driver(reference, task, stored[0], seed=0)
    assert driver.poll(ROWS - 2, None) is not None
    assert driver.poll(ROWS - 1, None) is None


def test_a_session_that_does_not_fit_the_task_is_one_line(tmp_path: Path, task: Task, stored: list[ToolPoses]) -> None:
    other = [ToolPoses(p.position[:1], p.quaternion[:1], p.closure[:1], p.valid[:1]) for p in stored]
    with pytest.raises(ConfigError, match="has no instrument 'right'; it has left"):
        open_driver(log(tmp_path / "a.db", other, ("left",), task.tick_hz, ROWS), task, stored[0], seed=0)
    with pytest.raises(ConfigError, match="ticks at 50 Hz, the task at 100 Hz"):
        open_driver(log(tmp_path / "b.db", stored, ("left", "right"), 50.0, ROWS), task, stored[0], seed=0)
    with pytest.raises(ConfigError, match="holds no tool poses"):
        open_driver(log(tmp_path / "c.db", [], ("left", "right"), task.tick_hz, 0), task, stored[0], seed=0)
    with pytest.raises(LogError, match=r"none\.db: no log here"):
        open_driver(f"{tmp_path / 'none.db'}#x", task, stored[0], seed=0)
