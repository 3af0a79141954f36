"""The loop, with a scene, a device and sinks that are as small as can be."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import numpy as np
import pytest

from trainer.clock import Fast, Realtime
from trainer.events import Event, StepDone, TaskDone, TickOverrun
from trainer.geometry import Array
from trainer.poses import ToolPoses
from trainer.session import NO_POSE, admit, interruptible, run
from trainer.sinks.surface import TickRecord

NOWHERE = (0.0, 0.0, 0.0)


def poses(x: float, valid: bool = True) -> ToolPoses:
    """Two instruments, both at (x, 0, 0)."""
    position = np.zeros((2, 3))
    position[:, 0] = x
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    return ToolPoses(position, quaternion, np.zeros(2), np.full(2, valid))


class FakeScene:
    """Completes after ``ticks`` steps; an event at every step says what it was given."""

    def __init__(self, ticks: int) -> None:
        self.home = poses(-1.0)
        self.tick = 0
        self.outcome = ""
        self.given: list[ToolPoses] = []
        self._ticks = ticks

    def step(self, given: ToolPoses) -> tuple[Event, ...]:
        self.given.append(given)
        events: tuple[Event, ...] = (StepDone(self.tick, 0, 0.01 * self.tick, "", step="x", index=self.tick),)
        if self.tick + 1 == self._ticks:
            events = (*events, self._done("completed", "all steps", seq=1))
        self.tick += 1
        return events

    def finish(self, outcome: str, reason: str) -> tuple[Event, ...]:
        return (self._done(outcome, reason, seq=0),)

    def _done(self, outcome: str, reason: str, seq: int) -> TaskDone:
        self.outcome = outcome
        return TaskDone(self.tick, seq, 0.01 * self.tick, "", outcome, reason, NOWHERE, NOWHERE, NOWHERE, 0.0, 0.0, 0.0)

    def view(self) -> str:
        return f"view at {self.tick}"

    def snapshot(self) -> Array:
        return np.zeros(0)


class FakeDriver:
    """Gives ``made`` one after the other, then nothing more."""

    def __init__(self, made: list[ToolPoses], before: Callable[[int], None] = lambda tick: None) -> None:
        self._made = iter(made)
        self._before = before
        self.asked: list[tuple[int, object]] = []

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        self._before(tick)
        self.asked.append((tick, view))
        return next(self._made, None)

    def summary(self) -> dict[str, object]:
        return {}

    def close(self) -> None: ...


class FakeSink:
    def __init__(self, before: Callable[[TickRecord], None] = lambda record: None) -> None:
        self._before = before
        self.records: list[TickRecord] = []

    def tick(self, record: TickRecord) -> None:
        self._before(record)
        self.records.append(record)

    def close(self) -> None: ...

    def events(self) -> list[Event]:
        return [event for record in self.records for event in record.events]


def test_every_sink_gets_every_tick_with_what_the_scene_was_given() -> None:
    scene, sinks = FakeScene(4), (FakeSink(), FakeSink())
    driver = FakeDriver([poses(x) for x in (0.0, 1.0, 2.0, 3.0)])
    run(scene, driver, sinks, Fast(100.0))
    for sink in sinks:
        assert [record.tick for record in sink.records] == [0, 1, 2, 3]
        assert [record.time_s for record in sink.records] == [0.0, 0.01, 0.02, 0.03]
        assert [record.poses.position[0, 0] for record in sink.records] == [0.0, 1.0, 2.0, 3.0]
        assert [record.poses for record in sink.records] == scene.given
    assert driver.asked == [(k, f"view at {k}") for k in range(4)]


def test_the_session_ends_with_the_step_that_has_an_outcome() -> None:
    scene, sink = FakeScene(2), FakeSink()
    run(scene, FakeDriver([poses(0.0)] * 9), [sink], Fast(100.0))
    assert scene.outcome == "completed"
    assert [event.kind for event in sink.events()] == ["step_done", "step_done", "task_done"]


def test_the_end_of_the_input_fails_the_task_and_adds_no_step() -> None:
    """The closing event comes in a second record of the last tick, so that one row of poses stays one step."""
    scene, sink = FakeScene(99), FakeSink()
    run(scene, FakeDriver([poses(0.0), poses(1.0)]), [sink], Fast(100.0))
    assert scene.tick == 2
    assert [record.tick for record in sink.records] == [0, 1, 1]
    last = sink.events()[-1]
    assert isinstance(last, TaskDone)
    assert (last.outcome, last.reason) == ("failed", "the input ended before the task was done")


def test_an_interruption_aborts_between_two_ticks() -> None:
    scene, sink = FakeScene(99), FakeSink()
    run(scene, FakeDriver([poses(0.0)] * 99), [sink], Fast(100.0), interrupted=lambda: scene.tick == 3)
    assert [record.tick for record in sink.records] == [0, 1, 2, 2]
    last = sink.events()[-1]
    assert isinstance(last, TaskDone)
    assert (last.outcome, last.reason) == ("aborted", "interrupted")


def test_ctrl_c_lets_the_tick_finish() -> None:
    scene = FakeScene(99)

    def press(record: TickRecord) -> None:
        if record.tick == 5 and not scene.outcome:
            os.kill(os.getpid(), signal.SIGINT)

    sinks = [FakeSink(press), FakeSink()]
    with interruptible() as interrupted:
        run(scene, FakeDriver([poses(0.0)] * 99), sinks, Fast(100.0), interrupted)
    assert scene.tick == 6
    assert scene.outcome == "aborted"
    assert [record.tick for record in sinks[1].records] == [0, 1, 2, 3, 4, 5, 5]


class NotedClock(Fast):
    """Notes when a tick's work begins and ends."""

    def __init__(self, notes: list[str]) -> None:
        super().__init__(100.0)
        self._notes = notes

    def begin(self) -> float:
        self._notes.append("begin")
        return super().begin()

    def end(self) -> float:
        self._notes.append("end")
        return super().end()


class InHand(FakeDriver):
    """A device that hears when a tick's events are out."""

    def tick(self, record: object) -> None: ...


@pytest.mark.parametrize(
    ("kind", "order"), [(FakeDriver, ["poll", "begin", "end"]), (InHand, ["begin", "poll", "end"])]
)
def test_a_device_in_a_hand_is_asked_in_the_tick_and_a_scripted_hand_before_it(
    kind: type[FakeDriver], order: list[str]
) -> None:
    notes: list[str] = []
    driver = kind([poses(0.0)] * 9, lambda tick: notes.append("poll"))
    run(FakeScene(3), driver, [FakeSink()], NotedClock(notes))
    assert notes == order * 3


def test_a_second_ctrl_c_raises_and_the_handler_is_put_back() -> None:
    here = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores Ctrl-C
    try:
        with interruptible() as interrupted:
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupted()
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, here)


class SlowTime:
    """Every tick takes ``work_ms`` by this clock."""

    def __init__(self, work_ms: float) -> None:
        self.ns = 0
        self._work_ns = round(work_ms * 1e6)

    def perf_counter(self) -> float:
        return self.ns * 1e-9

    def perf_counter_ns(self) -> int:
        self.ns += self._work_ns
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)


@pytest.mark.parametrize(
    ("clock", "work_ms", "expected"),
    [(Realtime(100.0), 12.0, 4), (Realtime(100.0), 8.0, 0), (Fast(100.0), 12.0, 0)],
)
def test_an_overrun_is_logged_in_real_time_only(
    clock: Fast, work_ms: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four ticks of 12 ms in slots of 10: each is logged with the tick after it, the last with itself.

    As many as the clock counts.
    """
    monkeypatch.setattr("trainer.clock.time", SlowTime(work_ms))
    sink = FakeSink()
    run(FakeScene(4), FakeDriver([poses(0.0)] * 4), [sink], clock)
    found = [event for event in sink.events() if isinstance(event, TickOverrun)]
    assert [event.tick for event in found] == [1, 2, 3, 3][:expected]
    assert clock.report()["overruns"] == (expected if clock.realtime else 4)
    for event in found:
        assert (event.work_ms, event.slot_ms) == (pytest.approx(work_ms), 10.0)
    keys = [(event.tick, event.seq) for event in sink.events()]
    assert len(set(keys)) == len(keys)
    assert keys == sorted(keys)


def test_skipped_time_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hand thinks for a second before tick 5: with that tick it is told that as good as a second has no tick."""
    wall = SlowTime(0.0)
    monkeypatch.setattr("trainer.clock.time", wall)

    def think(tick: int) -> None:
        wall.ns += 10**9 * (tick == 5)

    clock, sink = Realtime(100.0), FakeSink()
    run(FakeScene(8), FakeDriver([poses(0.0)] * 8, think), [sink], clock)
    (found,) = [event for event in sink.events() if isinstance(event, TickOverrun)]
    assert (found.tick, found.work_ms) == (5, 0.0)
    assert found.skipped_s == clock.report()["skipped_s"] == pytest.approx(0.99)


def test_an_error_in_a_sink_ends_the_session_where_it_is() -> None:
    def full(record: TickRecord) -> None:
        if record.tick == 2:
            raise OSError(28, "No space left on device")

    kept = FakeSink()
    with pytest.raises(OSError, match="No space left"):
        run(FakeScene(9), FakeDriver([poses(0.0)] * 9), [kept, FakeSink(full)], Fast(100.0))
    assert [record.tick for record in kept.records] == [0, 1, 2]


BAD = [
    ("position", np.nan),
    ("position", np.inf),
    ("quaternion", np.nan),
    ("quaternion", 0.0),
    ("quaternion", 1e200),
    ("closure", np.nan),
]


@pytest.mark.parametrize(("field", "number"), BAD)
def test_what_is_no_pose_is_held_and_counts_as_not_seen(field: str, number: float) -> None:
    """Only the instrument with the bad number is held; the other one goes on."""
    held, seen = poses(1.0), poses(2.0)
    getattr(seen, field)[1] = number
    found = admit(seen, held)
    assert found.valid.tolist() == [True, False]
    assert found.position[:, 0].tolist() == [2.0, 1.0]
    assert found.reason == ("", NO_POSE)
    for name in ("position", "quaternion", "closure"):
        assert np.isfinite(getattr(found, name)).all()


def test_no_number_that_is_not_finite_reaches_scene_or_sink() -> None:
    nothing: Array = np.full((2, 3), np.nan)
    blind = ToolPoses(nothing, np.full((2, 4), np.nan), np.full(2, np.nan), np.zeros(2, dtype=bool))
    scene, sink = FakeScene(4), FakeSink()
    run(scene, FakeDriver([blind, poses(1.0), blind, blind]), [sink], Fast(100.0))
    assert [given.position[0, 0] for given in scene.given] == [-1.0, 1.0, 1.0, 1.0]
    assert [bool(given.valid.any()) for given in scene.given] == [False, True, False, False]
    assert all(np.isfinite(record.poses.pack()).all() for record in sink.records)


def test_good_poses_pass_untouched() -> None:
    """Bit for bit, also where the device says that it does not see the instrument: the scene decides."""
    seen = poses(2.0, valid=False)
    assert admit(seen, poses(1.0)) is seen
