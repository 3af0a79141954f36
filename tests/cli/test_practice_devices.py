"""A session with instruments in the hand: the scripted expert's motion through bytes, a fault in its middle, Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import threading
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import CommandLine
from simulated_devices import SHORT, simulated
from waiting import wait_for

from trainer import clock, curriculum, drivers
from trainer.cli.main import main
from trainer.clock import Realtime
from trainer.curriculum import Task
from trainer.drivers.minibird import Minibird
from trainer.drivers.minibird_flock import UNHURRIED
from trainer.poses import ToolPoses
from trainer.profile import ProfileFile, load_profile


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated units need no reset, only their silence before they configure themselves."""
    monkeypatch.setattr(Minibird.__init__, "__defaults__", (replace(SHORT, configure_s=UNHURRIED.configure_s),))


@pytest.fixture
def task(tmp_path: Path) -> Path:
    """The first drive of needle-drive alone, through both walls of a coarse vessel."""
    text = curriculum.load_task("anastomosis/needle-drive").text
    first, *others = re.split(r"(?=^\[\[step\]\])", text.partition("[[metric]]")[0], flags=re.MULTILINE)
    metrics = "".join(re.split(r"(?=^\[\[metric\]\])", text, flags=re.MULTILINE)[1:])
    text = first + others[0] + metrics
    text = re.sub(r"time_limit_s = .*", "time_limit_s = 30.0", text)
    path = tmp_path / "drive.toml"
    path.write_text(text.replace('name = "needle-drive"', 'name = "drive"', 1))
    return path


def verdicts(result: dict[str, Any]) -> dict[str, bool | None]:
    """Of each measure with a target: whether it is met."""
    found: dict[str, bool | None] = {}
    for m in result["metrics"]:
        low, high, value = m["target_low"], m["target_high"], m["value"]
        if low is not None or high is not None:
            met = value is not None and (low is None or value >= low) and (high is None or value <= high)
            found[m["name"]] = met
    return found


def done(result: dict[str, Any]) -> tuple[str, dict[str, bool | None], dict[str, int]]:
    """Outcome, verdicts and events, but for those of a machine that is busy with something else."""
    ignored = {"tracking_lost", "tracking_back", "tick_overrun"}
    return result["outcome"], verdicts(result), {k: n for k, n in result["events"].items() if k not in ignored}


def test_the_expert_s_hands_through_bytes_do_what_they_did(
    command_line: CommandLine, task: Path, tmp_path: Path, own_log: Path
) -> None:
    """Same outcome, same verdicts, same kinds of events in the same number, and the record says how late it was.

    Positions reach the scene within half a step of the tracker's words at the profile's scale, 0.1 · 0.056 mm, an
    eighth of the hand's tremor; times within a tick of theirs. A machine that is busy with something else may keep
    poses back until the needle jumps, so the hands may try four times.
    """
    code, out, err = command_line("practice", task, "--fast", "--no-record", "--json")
    assert code == 0, err
    direct = json.loads(out)
    assert direct["outcome"] == "completed"
    assert len(verdicts(direct)) >= 5
    motion = f"{own_log}#{direct['session']}"
    for attempt in range(4):
        with simulated(tmp_path / f"devices{attempt}", "--motion", motion, speed=1.0) as profile:
            code, out, err = command_line("practice", task, "--device", profile, "--fast", "--no-record", "--json")
        assert code == 0, err
        through = json.loads(out)
        if done(through) == done(direct):
            break
    assert done(through) == done(direct)
    device = through["device"]
    assert device["records"]["good"] > 100
    assert device["latency_ms"]["poses"] > 100
    code, out, _ = command_line("sessions", "show", "last", "--json")
    assert json.loads(out)["device_summary"]["latency_ms"] == device["latency_ms"]
    code, out, err = command_line("sessions", "replay", "last", "--verify")
    assert code == 0, err


def test_a_lost_tracker_freezes_the_needle_in_its_jaws_and_ctrl_c_keeps_all(
    command_line: CommandLine, task: Path, tmp_path: Path, own_log: Path
) -> None:
    """At rest with the needle, 1 s of motion in: the cable is out for 5 s. Then the trainee has had enough."""
    with simulated(tmp_path / "devices", "--fault", "unplug=1:5", speed=1.0) as profile:
        # Jaws that the board says are open would let go of the needle, and that is not what is asked here.
        text = profile.read_text().partition("[closure]")[0]
        profile.write_text(text)
        presses = threading.Thread(target=ctrl_c_when_back, args=(own_log, tmp_path / "devices" / "flock"), daemon=True)
        presses.start()
        code, out, err = command_line("practice", task, "--device", profile, "--no-record", "--json")
        presses.join()
    assert code == 0, err
    result = json.loads(out)
    assert result["outcome"] == "aborted"
    assert result["events"]["tracking_lost"] >= 2
    assert "release" not in result["events"]
    assert any(re.search("the port is gone|no such port", loss["reason"]) for loss in result["device"]["lost"])
    shown = json.loads(command_line("sessions", "show", "last", "--events", "--json")[1])
    lost = [(e["tick"], e["tool"], e["reason"]) for e in shown["event_list"] if e["kind"] == "tracking_lost"]
    first = [(loss["tick"], loss["tool"], loss["reason"].split("; ")[0]) for loss in result["device"]["lost"]]
    assert sorted(lost) == sorted(first)
    assert command_line("db", "check")[0] == 0
    # The reason is an input: simulated again, the same events say the same.
    code, _, err = command_line("sessions", "replay", "last", "--verify")
    assert code == 0, err


def ctrl_c_when_back(log: Path, port: Path) -> None:
    """Press it when the log holds two instruments that are back after their port was gone.

    On a busy machine they may have been lost and back before.
    """
    if wait_for(port.exists) and wait_for(lambda: not port.exists()) and wait_for(port.exists):
        before = backs(log)
        if wait_for(lambda: backs(log) >= before + 2):
            os.kill(os.getpid(), signal.SIGINT)


def backs(log: Path) -> int:
    if not log.exists():
        return 0
    try:
        with closing(sqlite3.connect(f"file:{log}?mode=ro", uri=True)) as db:
            return int(db.execute("select count(*) from events where kind = 'tracking_back'").fetchone()[0])
    except sqlite3.OperationalError:
        return 0


def test_a_device_that_is_not_there_is_one_line_and_no_session(
    command_line: CommandLine, task: Path, tmp_path: Path
) -> None:
    profile = tmp_path / "minibird-pair.toml"
    text = (Path(__file__).parents[2] / "devices" / "minibird-pair.toml").read_text()
    profile.write_text(text.replace("/dev/tty", str(tmp_path / "tty")))
    code, _, err = command_line("practice", task, "--device", profile, "--no-record")
    assert (code, err) == (
        1,
        f"trainer: {tmp_path / 'ttyACM0'}: no such port; plug the device in, or give the profile its port\n",
    )
    assert json.loads(command_line("sessions", "list", "--json")[1]) == []


class Talkative:
    """A device in a hand that a library's thread opens again and again, and prints; it ends after 20 ticks."""

    def __init__(self, home: ToolPoses) -> None:
        self._home, self._stop = home, threading.Event()
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()

    def _talk(self) -> None:
        while not self._stop.wait(0.001):
            print("a tracker found")
            os.write(1, b"1 packets transmitted")

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        return self._home if tick < 20 else None

    def tick(self, record: object) -> None:
        """It measures no latency."""

    def summary(self) -> dict[str, object]:
        return {}

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


def test_stdout_is_the_document_s_alone_and_a_hand_keeps_its_pace(
    task: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Whatever a device's library prints until the end, by child processes too. ``--fast`` does not hurry a hand: its
    clock waits for each tick, so that the waiting is no work."""
    made: list[Realtime] = []

    class Noted(Realtime):
        def __init__(self, tick_hz: float) -> None:
            super().__init__(tick_hz)
            made.append(self)

    def opened(reference: str, task: Task, home: ToolPoses, seed: int) -> tuple[ProfileFile, Talkative]:
        return load_profile("scripted-expert"), Talkative(home)

    monkeypatch.setattr(drivers, "open_driver", opened)
    monkeypatch.setattr(clock, "Realtime", Noted)
    monkeypatch.setattr("sys.argv", ["trainer", "practice", str(task), "--fast", "--no-record", "--json"])
    with suppress(SystemExit):
        main()
    result = json.loads(capfd.readouterr().out)
    assert result["reason"].startswith("the input ended")
    assert [len(c.work_ms) for c in made] == [21]


def test_only_a_device_with_a_line_can_be_simulated(command_line: CommandLine, tmp_path: Path) -> None:
    code, _, err = command_line("devices", "simulate", "scripted-expert", "--out", tmp_path)
    assert (code, err) == (1, "trainer: scripted-expert: only devices of driver 'minibird' can be simulated\n")
    code, _, err = command_line("devices", "simulate", "minibird-pair", "--out", tmp_path, "--fault", "dorp=1")
    assert code == 1
    assert "unknown fault 'dorp'" in err
