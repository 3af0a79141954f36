"""``trainer sessions`` shows what the log holds, and a replay tells the first difference."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from tests.log.log_samples import METRICS, contact, execute, header, pierce, step, task_done, write
from trainer import metrics, resimulation
from trainer.cli.sessions import app
from trainer.curriculum import Task
from trainer.events import Event, TickOverrun
from trainer.log import reader
from trainer.log.record import ANATOMY, Metric, SessionRecord
from trainer.log.schema import LogError, open_log
from trainer.poses import ToolPoses
from trainer.sinks.log import LogSink

FIRST, SECOND = "20261122-013145-7f3a", "20261122-020000-0001"
runner = CliRunner()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "s.db"
    write(path, FIRST)
    write(path, SECOND, ticks=3, trainee="Bo")
    monkeypatch.setenv("TRAINER_DB", str(path))
    return path


def answer(*arguments: str, exit_code: int = 0) -> object:
    got = runner.invoke(app, [*arguments, "--json"])
    assert got.exit_code == exit_code, got.output
    return json.loads(got.stdout)


def test_the_list_tells_knees_where_there_are_several(path: Path) -> None:
    """One knee throughout needs no word; JSON has it always."""

    def listed(number: int, knee: str) -> str:
        write(path, f"20261122-03000{number}-0000", versions={"trainer": "0.1.0", ANATOMY: knee})
        return " ".join(runner.invoke(app, ["list"]).stdout.split())

    assert " in " not in listed(1, "knee")
    both = listed(2, "/data/my-knee")
    assert "anastomosis/needle-drive in built-in knee" in both
    assert "anastomosis/needle-drive in my-knee" in both
    assert [s["anatomy"] for s in answer("list")] == ["", "", "built-in knee", "my-knee"]


def complaint(*arguments: str) -> str:
    got = runner.invoke(app, list(arguments))
    assert isinstance(got.exception, LogError), got.output
    return str(got.exception)


def test_list(path: Path) -> None:
    assert [s["session"] for s in answer("list")] == [FIRST, SECOND]
    (bo,) = answer("list", "--trainee", "Bo")
    assert (bo["trainee"], bo["outcome"], bo["ticks"], bo["duration_s"]) == ("Bo", "completed", 3, 0.03)
    shown = runner.invoke(app, ["list"]).stdout
    for text in (FIRST, SECOND, "Ana", "Bo", "anastomosis/needle-drive", "completed"):
        assert text in shown
    assert "'Cy'; known: Ana, Bo" in complaint("list", "--trainee", "Cy")


def test_a_narrow_screen_shows_all_of_a_session(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A table of seven columns would lose six of them."""
    narrow = partial(Console, width=40)
    monkeypatch.setattr("rich.console.Console", lambda width: narrow())
    shown = runner.invoke(app, ["list", "--trainee", "Bo"]).stdout.splitlines()
    assert max(map(len, shown)) <= 40
    assert (shown[0], shown[2]) == (SECOND, "  trainee: Bo")
    assert {"  task: anastomosis/needle-drive", "  outcome: completed", "  duration: 0.0 s"} <= set(shown)


def test_list_closes_interrupted_sessions_and_says_so(path: Path) -> None:
    with closing(LogSink(path, header("20261122-030000-0002"))) as sink:
        sink.tick(step(0, contact(0)))
        sink.record("", 0, 0.0)  # stops the writer
        execute(path, "update sessions set heartbeat = 0 where status = 'running'")
        got = runner.invoke(app, ["list", "--json"])
        sink._closed = True
    assert [s["outcome"] for s in json.loads(got.stdout)] == ["completed", "completed", "aborted"]
    assert got.stderr == "session 20261122-030000-0002 was interrupted: its first 0.01 s are kept, listed as aborted\n"


def test_show(path: Path) -> None:
    document = answer("show", FIRST, "--events")
    assert document["events"] == {"pierce": 4, "task_done": 1}
    assert document["metrics"] == [asdict(m) for m in METRICS]
    assert document["versions"] == {"trainer": "0.1.0", "numpy": "2.4"}
    assert [(e["kind"], e["tick"]) for e in document["event_list"]] == [
        ("pierce", 0), ("pierce", 3), ("pierce", 6), ("pierce", 9), ("task_done", 11),
    ]  # fmt: skip
    assert document["event_list"][0]["axial_mm"] == pierce(0).axial_mm
    assert "event_list" not in answer("show", FIRST)
    shown = runner.invoke(app, ["show", "last", "--events"]).stdout
    for text in (SECOND, "Bo", "1 pierce", "bite_mm", "0.30 mm", "nothing measured", "axial_mm 0.35", "seed 7"):
        assert text in shown


def test_score_is_computed_from_the_log_and_the_stored_task(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def count(record: SessionRecord, task: Task) -> tuple[Metric, ...]:
        assert task.name == "needle-drive"
        return (Metric("count", float(len(record.events)), "", None, 9.0, "test", "1"),)

    monkeypatch.setattr(metrics, "score", count)
    assert answer("score", FIRST) == [
        {"name": "count", "value": 5.0, "unit": "", "target_low": None, "target_high": 9.0, "source": "test",
         "version": "1"},
    ]  # fmt: skip


class FakeScene:
    """Pierces at every third tick, as the samples' events say, provided that the poses are the recorded ones."""

    def __init__(self, task: Task, anatomy: object = None) -> None:
        self.tick = 0
        self.outcome = ""

    def step(self, poses: ToolPoses) -> tuple[Event, ...]:
        recorded = step(self.tick).poses.pack()
        assert poses.pack().tobytes() == recorded.tobytes()
        events = (pierce(self.tick),) if self.tick % 3 == 0 else ()
        self.tick += 1
        return events

    def finish(self, outcome: str, reason: str) -> tuple[Event, ...]:
        self.outcome = outcome
        return (task_done(self.tick - 1, 5, outcome, reason),)


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> type[FakeScene]:
    monkeypatch.setattr(resimulation.scene, "build", FakeScene)
    return FakeScene


def test_replay_of_the_same_simulation_is_identical(path: Path, scene: type[FakeScene]) -> None:
    counts = {"pierce": 4, "task_done": 1}
    assert answer("replay", FIRST) == {"session": FIRST, "ticks": 12, "events": counts}
    assert answer("replay", FIRST, "--verify") == {
        "session": FIRST, "ticks": 12, "events": counts, "identical": True, "difference": None,
    }  # fmt: skip
    got = runner.invoke(app, ["replay", FIRST, "--verify"])
    assert (got.exit_code, got.stderr) == (0, "")
    assert "identical" in got.stdout


def test_replay_tells_the_first_difference_of_a_single_bit(
    path: Path, scene: type[FakeScene], monkeypatch: pytest.MonkeyPatch
) -> None:
    same = FakeScene.step

    def step(self: FakeScene, poses: ToolPoses) -> tuple[Event, ...]:
        events = same(self, poses)
        if events and events[0].tick >= 6:
            return (replace(events[0], point=(0.1, 0.0, 1e-17)),)  # recorded: -0.0
        return events

    monkeypatch.setattr(FakeScene, "step", step)
    got = runner.invoke(app, ["replay", FIRST, "--verify"])
    assert got.exit_code == 1
    lines = got.stderr.splitlines()
    assert lines[0] == "not the same: event 3 differs"
    assert lines[1].startswith("  recorded: tick 6, 0: ")
    assert "[0.1, -0.0, 1e-17]" in lines[1]
    assert "[0.1, 0.0, 1e-17]" in lines[2]
    assert lines[3] == "recorded with trainer 0.1.0, numpy 2.4"
    assert answer("replay", FIRST, "--verify", exit_code=1)["identical"] is False


@pytest.mark.parametrize(
    ("sql", "side"),
    [
        ("delete from events where tick = 9", "recorded: tick 11"),
        ("delete from events where tick > 8", "recorded: nothing"),
    ],
)
def test_replay_tells_a_missing_event(path: Path, scene: type[FakeScene], sql: str, side: str) -> None:
    execute(path, sql + f" and session = '{FIRST}'")
    got = runner.invoke(app, ["replay", FIRST, "--verify"])
    assert got.exit_code == 1
    assert "event 4 differs" in got.stderr
    assert side in got.stderr


def test_replay_leaves_out_what_depends_on_the_clock(path: Path, scene: type[FakeScene]) -> None:
    third = "20261122-030000-0002"
    with closing(LogSink(path, header(third))) as sink:
        sink.tick(step(0, pierce(0), TickOverrun(0, 1, 0.0, "", 30.0, 10.0)))
        sink.finish("completed", "", 1, 0.01, None, None, ())
    assert answer("replay", third, "--verify")["identical"] is True


def test_replay_ends_where_the_scene_does(path: Path, scene: type[FakeScene], monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene that ends by itself is neither stepped further nor ended again."""
    same = FakeScene.step

    def step(self: FakeScene, poses: ToolPoses) -> tuple[Event, ...]:
        events = same(self, poses)
        return (*events, *self.finish("completed", "")) if self.tick == 12 else events

    monkeypatch.setattr(FakeScene, "step", step)
    assert answer("replay", FIRST, "--verify")["identical"] is True


def test_view_opens_the_recording_for_this_machine_only(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "r.rrd"
    recording.touch()
    third = "20261122-030000-0002"
    write(path, third, recording=str(recording))
    called = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(subprocess, "call", lambda command: called.append(command) or 3)
    assert runner.invoke(app, ["view", "last"]).exit_code == 3
    assert called == [[sys.executable, "-m", "rerun_cli", str(recording), "--bind", "127.0.0.1"]]
    recording.unlink()
    assert f"{recording}: the recording of session {third} is gone" in complaint("view", "last")
    assert "was made without a recording" in complaint("view", FIRST)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a display needs no variable")
def test_view_without_a_display_says_where_the_recording_is(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "r.rrd"
    recording.touch()
    write(path, "20261122-030000-0002", recording=str(recording))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(subprocess, "call", lambda command: pytest.fail("the viewer was started"))
    assert complaint("view", "last").startswith(f"{recording}: no display to show it on here")


def test_unknown_sessions_and_logs_are_said_so(path: Path, tmp_path: Path) -> None:
    for command in ("show", "score", "replay", "view"):
        assert "among the 2 of" in complaint(command, "20270101")
        assert "no log here" in complaint(command, "last", "--db", str(tmp_path / "none.db"))


def test_the_same_answer_by_every_name(path: Path) -> None:
    assert answer("show", "last") == answer("show", SECOND) == answer("show", "20261122-02", "--db", str(path))
    with open_log(path) as db:
        assert reader.load(db, "last").header == header(SECOND, trainee="Bo")
