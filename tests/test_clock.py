"""The pace of a session. No test here depends on how fast the machine is: time itself is a fake."""

from __future__ import annotations

import pytest

from trainer import clock


class Time:
    """A clock on the wall that moves only when somebody works or sleeps."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000_000
        self.slept: list[float] = []

    def perf_counter(self) -> float:
        return self.ns * 1e-9

    def perf_counter_ns(self) -> int:
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.ns += round(seconds * 1e9)

    def work(self, ms: float) -> None:
        self.ns += round(ms * 1e6)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(clock, "time", time)
    return time


def begins(paced: clock.Fast, wall: Time, work_ms: list[float]) -> list[float]:
    """When each tick began, ms after the first."""
    found = []
    for ms in work_ms:
        paced.begin()
        found.append(wall.ns)
        wall.work(ms)
        paced.end()
    return [(ns - found[0]) * 1e-6 for ns in found]


def test_ticks_in_real_time_begin_at_multiples_of_the_slot(wall: Time) -> None:
    """Tick k begins at k / rate, whatever each tick's work was; tolerance: the fake's nanosecond, as ms, per sleep."""
    begun = begins(clock.Realtime(100.0), wall, [1.0, 9.0, 0.0, 5.0, 2.0])
    assert begun == pytest.approx([0.0, 10.0, 20.0, 30.0, 40.0], abs=1e-5)


def test_lateness_does_not_add_up(wall: Time) -> None:
    """A tick of 25 ms delays the two after it, and tick 4 is on time again: deadlines are absolute."""
    begun = begins(clock.Realtime(100.0), wall, [1.0, 25.0, 1.0, 1.0, 1.0, 1.0])
    assert begun == pytest.approx([0.0, 10.0, 35.0, 36.0, 40.0, 50.0], abs=1e-5)


def test_after_a_long_pause_the_missed_ticks_are_not_run_in_a_burst(wall: Time) -> None:
    """One second behind is more than LARGEST_LAG_S: the next slots count from now, and 0.99 s are told as skipped."""
    paced = clock.Realtime(100.0)
    begun = begins(paced, wall, [1.0, 1000.0, 1.0, 1.0])
    assert begun == pytest.approx([0.0, 10.0, 1010.0, 1020.0], abs=1e-5)
    assert paced.report()["skipped_s"] == pytest.approx(0.99, abs=1e-8)


def test_time_lost_between_two_ticks_is_told(wall: Time) -> None:
    """Half a second between the ticks is no tick's work, but 0.49 s of it have no tick: ``begin`` says so, once."""
    paced = clock.Realtime(100.0)
    begins(paced, wall, [1.0])
    wall.work(499.0)
    assert paced.begin() == pytest.approx(0.49, abs=1e-8)
    paced.end()
    assert paced.begin() == 0.0
    assert paced.report()["skipped_s"] == pytest.approx(0.49, abs=1e-8)


def test_the_first_slot_begins_with_the_first_tick_and_not_with_the_clock(wall: Time) -> None:
    paced = clock.Realtime(100.0)
    wall.work(500.0)
    begins(paced, wall, [1.0])
    assert wall.slept == []


def test_fast_never_sleeps(wall: Time) -> None:
    assert begins(clock.Fast(100.0), wall, [1.0, 2.0, 3.0]) == pytest.approx([0.0, 1.0, 3.0], abs=1e-5)
    assert wall.slept == []


@pytest.mark.parametrize("kind", [clock.Fast, clock.Realtime])
def test_the_report_counts_work_and_not_waiting(kind: type[clock.Fast], wall: Time) -> None:
    """98 ticks of 2 ms, one of 9 and one of 11: by nearest rank the median is 2 and the 99th of 100 values 9 ms."""
    paced = kind(100.0)
    begins(paced, wall, [2.0] * 50 + [11.0, 9.0] + [2.0] * 48)
    report = paced.report()
    assert report == {
        "tick_hz": 100.0,
        "overruns": 1,
        "p50_ms": pytest.approx(2.0),
        "p99_ms": pytest.approx(9.0),
        "max_ms": pytest.approx(11.0),
        "skipped_s": 0.0,
    }


def test_end_returns_the_work_of_the_tick(wall: Time) -> None:
    paced = clock.Realtime(50.0)
    paced.begin()
    wall.work(7.5)
    assert paced.end() == pytest.approx(7.5)
    assert paced.slot_ms == 20.0


def test_a_session_without_ticks_reports_zeros() -> None:
    nothing = {"overruns": 0, "p50_ms": 0.0, "p99_ms": 0.0, "max_ms": 0.0, "skipped_s": 0.0}
    assert clock.Fast(100.0).report() == {"tick_hz": 100.0, **nothing}
