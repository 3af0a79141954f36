"""The long run: what its gauges say, what its report holds, and that it writes it whatever ends it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import CommandLine

from trainer.bench import soak as bench
from trainer.bench.soak import SETTLED, Gauges, Session, Soak, with_rest
from trainer.bench.soak_page import WARM_S, document, rows
from trainer.clock import Realtime
from trainer.curriculum import load_task, parse_task
from trainer.drivers.latency import BIN_MS, LatencyCount
from trainer.drivers.minibird import Minibird

ABOUT = {"cpu": "x", "cores": 2, "system": "y", "load_before": 1.0, "load_after": 2.0, "versions": {}}


def test_counted_latencies_have_the_percentiles_of_all() -> None:
    """Each is told as the upper edge of its bin: at most a bin too late, never too early."""
    rng = np.random.default_rng(0)
    ms = rng.uniform(1.0, 30.0, 5000)
    one, other = LatencyCount(), LatencyCount()
    for k, value in enumerate(ms.tolist()):
        (one, other)[k % 2].add(value)
    one.merge(other)
    for fraction in (0.5, 0.99):
        exact = np.percentile(ms, 100 * fraction, method="inverted_cdf")
        assert exact <= one.percentile_ms(fraction) + 1e-9 <= exact + BIN_MS + 2e-9
    assert one.longest_ms == ms.max()
    assert one.summary()["poses"] == 5000
    assert LatencyCount().summary() == {"poses": 0, "p50": 0.0, "p99": 0.0, "max": 0.0}


def test_a_task_with_rest_is_the_task_with_a_step_more_and_time_for_it() -> None:
    file = load_task("anastomosis/single-stitch")
    long = parse_task(with_rest(file.text, 30.0), "long")
    assert long.step[:-1] == file.task.step
    assert long.step[-1].kind == "withdraw"
    assert long.time_limit_s > 30 * 60
    assert long.metric == file.task.metric


class Queue:
    waiting = 3


class Apart(Minibird):
    """Clocks that part by a fifth of a tick in each second, but for one tick in ten, which begins late."""

    def __init__(self) -> None:
        self.ticks = 0

    def apart_ticks(self) -> tuple[float, int]:
        self.ticks += 1
        return 0.2 * (self.ticks // 100) - (5.0 if self.ticks % 10 == 0 else 0.0), 1


def test_gauges_are_read_once_a_second_and_late_ticks_are_no_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 s at 100 Hz on a clock of the test: the drift is that since the line has settled, 0.2 ticks a second."""
    now = [0.0]
    monkeypatch.setattr(bench.time, "monotonic", lambda: now[0])
    said: list[str] = []
    soak = Soak(sessions=[Session()])
    gauges = Gauges(soak, Apart(), [Queue(), object()], said.append)
    for k in range(4001):
        now[0] = k * 0.01
        gauges.tick(None)
    assert soak.at_s.tolist() == pytest.approx(range(41))
    assert soak.sessions[0].waiting == {"Queue": 3}
    # The first reading is at once; the one after SETTLED readings is where drift is counted from.
    assert soak.sessions[0].drift_ticks == pytest.approx(0.2 * (41 - SETTLED), abs=0.21)
    assert len(said) == 1
    assert "session 1" in said[0]


@contextmanager
def nothing_played(folder: Path, motion: str) -> Iterator[Path]:
    yield folder


class Device:
    latency = LatencyCount()


def test_sessions_for_half_of_the_time_and_one_for_the_rest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Sessions of 20 s in two minutes: three, then one that is cut short when the time is over."""
    now = [0.0]
    monkeypatch.setattr(bench.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(bench, "played", nothing_played)
    asked: list[bool] = []

    def perform(
        profile: Path, clock: Realtime, enough: Callable[[], bool], observed: Any, long: bool
    ) -> dict[str, Any]:
        asked.append(long)
        observed(Device(), []).tick(None)
        clock.work_ms.extend([1.0] * 10)
        now[0] += 60.0 if long else 20.0
        return {"outcome": "aborted" if enough() else "completed", "device": {"losses": 1}}

    soak = Soak()
    bench.measure(soak, perform, tmp_path, "", 100.0, 2.0, lambda line: None)
    assert asked == [False, False, False, True]
    assert [s.outcome for s in soak.sessions] == ["completed"] * 3 + ["aborted"]
    found = document(soak, 2.0, 100.0, ABOUT)
    assert (found["losses"], found["pace"]["overruns"], len(found["sessions"])) == (4, 0, 4)


def stopped(perform: bool) -> Callable[..., dict[str, Any]]:
    def session(*_: object) -> dict[str, Any]:
        if perform:
            raise KeyboardInterrupt
        return {"outcome": "aborted", "device": {"losses": 0}}

    return session


def test_ctrl_c_ends_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In a session, which it ends as aborted; or between its ticks, where it raises: what was measured stays."""
    monkeypatch.setattr(bench, "played", nothing_played)
    soak = Soak()
    bench.measure(soak, stopped(False), tmp_path, "", 100.0, 2.0, lambda line: None)
    assert [s.outcome for s in soak.sessions] == ["aborted"]
    with pytest.raises(KeyboardInterrupt):
        bench.measure(soak, stopped(True), tmp_path, "", 100.0, 2.0, lambda line: None)
    assert len(soak.sessions) == 2
    assert rows(document(soak, 2.0, 100.0, ABOUT))


def test_the_slope_of_memory_is_that_of_the_warm_part() -> None:
    """Two sessions of a minute: what the first takes does not count, nor the beginning of the last."""
    soak = Soak(sessions=[Session(), Session()])
    for k in range(120):
        soak.at_s.append(float(k))
        soak.session_of.append(int(k >= 60))
        soak.rss_mb.append(300.0 + k if k < 60 else 400.0 + 10.0 * (k < 60 + WARM_S) + k / 60.0)
    memory = document(soak, 2.0, 100.0, ABOUT)["memory_mb"]
    assert memory["start"] == 300.0
    assert memory["slope_per_minute_last_session"] == pytest.approx(1.0)
    assert memory["slope_per_minute"] < 0.0


def test_a_short_run_writes_its_report(command_line: CommandLine, tmp_path: Path) -> None:
    """A few seconds through bytes, with a device's process and all; the page has every figure."""
    text = load_task("anastomosis/needle-drive").text
    task = tmp_path / "drive.toml"
    text = text.replace('name = "needle-drive"', 'name = "drive"', 1)
    task.write_text(text.replace("time_limit_s = ", "time_limit_s = 4.0 # "))
    out = tmp_path / "reports"
    code, said, err = command_line("bench", "soak", "--minutes", "0.1", "--task", task, "--out", out, "--json")
    assert code == 0, err
    found = json.loads(said)
    assert found == json.loads((out / "realtime.json").read_text())
    assert found["pace"]["p50_ms"] > 0.0
    assert found["latency_ms"]["poses"] > 0
    assert set(found["waiting_most"]) == {"LogSink", "RecordingSink"}
    page = (out / "realtime.md").read_text()
    for what, value in rows(found):
        assert f"| {what} | {value} |" in page
