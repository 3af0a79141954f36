"""``trainer practice``: from the command line to the log, the recording and the scores.

The exercise is a coarse vessel with a time limit of a third of a second, so that a whole session with all its
parts takes a moment. What a stitch is worth is tested elsewhere.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from trainer import curriculum
from trainer.choice import choose_tissue
from trainer.cli.scores import suggestion
from trainer.cli.warmup import warm_up
from trainer.clock import Fast
from trainer.drivers.scripted import ScriptedHands
from trainer.log import reader, seal
from trainer.log.repair import repair_command
from trainer.log.schema import open_log
from trainer.metrics.registry import score
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.reporting.session import MetricRow
from trainer.scene import build
from trainer.session import run
from trainer.sinks import recording
from trainer.sinks.recording import RecordingSink
from trainer.sinks.rrd_file import RecordingError
from trainer.sinks.surface import TickRecord

CommandLine = Callable[..., tuple[int, str, str]]
TICKS = 33


@pytest.fixture
def task(tmp_path: Path) -> Path:
    """A task's file that ends after ``TICKS`` ticks."""
    text = curriculum.load_task("anastomosis/single-stitch").text
    text = text.replace("layers = 21", "layers = 9").replace("around = 24", "around = 8")
    text = text.replace("time_limit_s = 300.0", f"time_limit_s = {TICKS / 100.0}")
    path = tmp_path / "short.toml"
    path.write_text(text.replace('name = "single-stitch"', 'name = "short"', 1))
    return path


def test_the_document_says_all_that_the_contract_asks(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    db = tmp_path / "new folder" / "log.db"
    code, out, err = command_line("practice", task, "--fast", "--trainee", " Ada ", "--seed", "3", "--db", db, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in the document"))
    assert found["task"] == str(task)
    assert (found["trainee"], found["outcome"], found["ticks"]) == ("Ada", "timeout", TICKS)
    assert found["duration_s"] == TICKS / 100.0
    assert found["events"]["task_started"] == found["events"]["task_done"] == 1
    keys = {"name", "value", "unit", "target_low", "target_high", "source", "version"}
    assert found["metrics"]
    assert all(set(metric) == keys for metric in found["metrics"])
    assert set(found["realtime"]) == {"tick_hz", "overruns", "p50_ms", "p99_ms", "max_ms", "skipped_s"}
    assert 0.0 < found["realtime"]["p50_ms"] <= found["realtime"]["p99_ms"] <= found["realtime"]["max_ms"]
    assert found["device"]["name"] == "scripted-expert"
    assert set(found["methods"]) == {"tissue", "thread", "region"}
    tissue = found["methods"]["tissue"]
    assert tissue == asdict(choose_tissue(curriculum.load_task(str(task)).task, str(task)))
    assert tissue["measured_solver_error_mm"] <= tissue["budget"]["node_error_mm"] == 0.003
    assert (found["methods"]["thread"]["method"], found["methods"]["thread"]["links"]) == ("follow the leader", 100)
    rrd = db.parent / "recordings" / f"{found['session']}.rrd"
    assert found["recording"] == str(rrd)
    assert rrd.stat().st_size > 0
    assert found["dropped_frames"] == 0


def test_what_is_printed_is_what_the_log_holds(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    """Events, scores and header; the scores are also those that anybody computes from the log later."""
    db = tmp_path / "log.db"
    _, out, _ = command_line("practice", task, "--fast", "--seed", "3", "--db", db, "--no-record", "--json")
    found = json.loads(out)
    with open_log(db) as log:
        assert seal.check(log) == []
        stored = reader.load(log, found["session"])
        summary = reader.summary(log, found["session"])
        metrics = [asdict(metric) for metric in reader.stored_metrics(log, found["session"])]
    assert metrics == found["metrics"]
    task_file = curriculum.load_task(str(task))
    assert [asdict(metric) for metric in score(stored, task_file.task)] == found["metrics"]
    assert sum(found["events"].values()) == len(stored.events)
    assert len(stored.position) == stored.ticks == TICKS
    assert (summary.status, summary.outcome, summary.reason) == ("ended", "timeout", found["reason"])
    assert stored.header.task_toml == task_file.text
    assert stored.header.seed == 3
    assert stored.header.tools == ("left", "right")
    assert set(stored.header.versions) == {"trainer", "python", "numpy", "scipy", "numba", "machine", "tolerance_mN"}
    assert float(stored.header.versions["tolerance_mN"]) == found["methods"]["tissue"]["tolerance_mN"]
    assert found["recording"] is stored.header.recording is None


def test_the_same_seed_gives_the_same_events(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    """Bit for bit, at full speed and in real time; only overruns belong to the machine."""
    db = tmp_path / "log.db"
    recorded = []
    for pace in ("--fast", "--fast", "--realtime"):
        _, out, _ = command_line("practice", task, pace, "--seed", "7", "--db", db, "--no-record", "--json")
        with open_log(db) as log:
            stored = reader.load(log, json.loads(out)["session"])
        recorded.append([repr(event) for event in stored.events if event.simulated])
    assert recorded[0] == recorded[1] == recorded[2]


def test_a_person_reads_a_table_and_where_things_are(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    db, rrd = tmp_path / "log.db", tmp_path / "made" / "x.rrd"
    code, out, err = command_line("practice", task, "--fast", "--db", db, "--record", rrd)
    assert (code, err) == (0, "")
    for expected in (
        "timeout after 0.3 s",
        "Entry angle",
        "70 to 90°",
        "methods        tissue by kept factor to ",
        "thread by follow the leader",
        str(db),
        str(rrd),
        f"next           {task} again",
    ):
        assert expected in out
    assert "Wall grasp count" not in out  # measured, but the task does not ask for it
    assert rrd.exists()


def test_without_db_the_log_of_the_environment_is_used(command_line: CommandLine, task: Path, own_log: Path) -> None:
    assert command_line("practice", task, "--fast", "--no-record")[0] == 0
    assert own_log.exists()


def test_a_session_without_streams_is_recorded_by_a_process_that_imports_rerun_alone(
    task: Path, tmp_path: Path
) -> None:
    """The file's number is none of the three that the shell has closed; and what is written to them goes nowhere."""
    rrd = tmp_path / "x.rrd"
    code = "import sys, trainer.cli.main as m\ntry:\n    m.main()\nfinally:\n    assert 'rerun' not in sys.modules"
    arguments = ["practice", str(task), "--fast", "--db", str(tmp_path / "log.db"), "--record", str(rrd)]
    command = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, "-c", code, *arguments]
    assert subprocess.run(command, cwd=Path(__file__).parents[2], check=False).returncode == 0
    assert repair_command(rrd) == ""


def test_an_existing_recording_is_not_overwritten(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    rrd = tmp_path / "x.rrd"
    rrd.write_bytes(b"precious")
    code, out, err = command_line("practice", task, "--fast", "--db", tmp_path / "log.db", "--record", rrd)
    assert (code, out) == (1, "")
    assert err == f"trainer: {rrd}: exists already; give --record another name, or remove it\n"
    assert rrd.read_bytes() == b"precious"
    assert not (tmp_path / "log.db").exists()


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        ("file/x.rrd", "{folder}/file is a file, not a folder"),
        ("file/deeper/x.rrd", "{folder}/file is a file, not a folder"),
        ("folder.rrd", "is a folder, not a file"),
    ],
)
def test_where_no_recording_can_be_is_one_line_that_names_it(
    command_line: CommandLine, task: Path, tmp_path: Path, record: str, complaint: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.rrd").mkdir()
    log = tmp_path / "log.db"
    code, out, err = command_line("practice", task, "--fast", "--db", log, "--record", tmp_path / record)
    assert (code, out) == (1, "")
    complaint = complaint.format(folder=tmp_path)
    assert err == f"trainer: {tmp_path / record}: {complaint}; give --record another place, or --no-record\n"
    assert not log.exists()


def test_where_no_log_can_be_is_one_line_that_names_it(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for db, complaint in (
        ("file/x.db", f"{tmp_path / 'file'} is a file, not a folder"),
        ("", "is a folder, not a file"),
    ):
        code, out, err = command_line("practice", task, "--fast", "--no-record", "--db", tmp_path / db)
        assert (code, out, err) == (1, "", f"trainer: {tmp_path / db}: {complaint}; name another log\n")
    deep = tmp_path / "new" / "folders" / "log.db"
    assert command_line("practice", task, "--fast", "--no-record", "--db", deep)[0] == 0
    assert deep.is_file()


REFUSED = [
    (["anastomosis/nothing"], "unknown task 'anastomosis/nothing'; known: "),
    (["anastomosis/single-stitch", "--device", "nobody"], "unknown device profile 'nobody'; known: "),
    (["anastomosis/single-stitch", "--device", "no.toml"], "no.toml: no such file"),
    (["anastomosis/single-stitch", "--device", "no.mha"], "no.mha: no such file"),
    (["wrong.toml"], "wrong.toml: [scene.vessel[0]]: unknown key 'wall_um', did you mean 'wall_mm'?"),
    (
        ["exact.toml"],
        "exact.toml: nothing that a scene can run on was measured to keep 'solver.node_error_mm' = 1e-12",
    ),
    (["metric.toml"], "no metric 'entry_angle_rad', did you mean 'entry_angle_deg'?"),
    (["anastomosis/single-stitch", "--db", "folder"], "folder: "),
    (["anastomosis/single-stitch", "--db", "text.db"], "text.db: not a log"),
    (["anastomosis/single-stitch", "--record", "text.db/x.rrd"], "text.db is a file, not a folder"),
    (["anastomosis/single-stitch", "--trainee", " "], "a trainee's name must not be empty"),
    (["anastomosis/single-stitch", "--trainee", "x" * 101], "has at most 100 characters, found 101"),
    (["anastomosis/single-stitch", "--trainee", "A\nB"], "must be plain text in one line, found '\\n' in it"),
    (["anastomosis/single-stitch", "--trainee", "A\x1b[31m"], "in one line, found '\\x1b' in it"),
    (["anastomosis/single-stitch", "--trainee", "A\udcff"], "in one line, found '\\udcff' in it"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_cannot_be_used_is_refused_in_one_line(
    arguments: list[str], message: str, command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 1, nothing on stdout, one line on stderr, and no session in the log."""
    monkeypatch.chdir(tmp_path)
    text = curriculum.load_task("anastomosis/single-stitch").text
    Path("wrong.toml").write_text(text.replace("wall_mm = 0.15", "wall_um = 150.0"))
    Path("exact.toml").write_text(text.replace("node_error_mm = 0.003", "node_error_mm = 1e-12"))
    Path("metric.toml").write_text(text.replace('"entry_angle_deg"', '"entry_angle_rad"'))
    Path("folder").mkdir()
    Path("text.db").write_text("this is no log, only some text")
    if "--db" not in arguments:
        arguments = [*arguments, "--db", "log.db"]
    code, out, err = command_line("practice", "--fast", *arguments)
    assert (code, out) == (1, "")
    assert err.startswith("trainer: ")
    assert err.count("\n") == 1
    assert message in err
    if Path("log.db").exists():
        with open_log(Path("log.db")) as log:
            assert reader.list_sessions(log) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["--record", "x.rrd", "--no-record"],
        ["--record", "x.txt"],
        ["--seed", "-1"],
        ["--seed", str(2**63)],
        ["--seed", "x"],
        ["--speed", "3"],
    ],
    ids=" ".join,
)
def test_wrong_usage_exits_with_2(arguments: list[str], command_line: CommandLine) -> None:
    code, out, err = command_line("practice", "anastomosis/single-stitch", *arguments)
    assert (code, out) == (2, "")
    assert "Usage: trainer practice" in err


@pytest.fixture
def at_tick_10(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Has something happen while the scripted hands are asked for tick 10; None from it ends the input."""

    def arrange(happens: Callable[[], object]) -> None:
        before = ScriptedHands.poll

        def poll(hands: ScriptedHands, tick: int, view: Any) -> ToolPoses | None:
            return before(hands, tick, view) if tick != 10 or happens() else None

        monkeypatch.setattr(ScriptedHands, "poll", poll)

    return arrange


def press_ctrl_c() -> bool:
    os.kill(os.getpid(), signal.SIGINT)
    return True


def unplug() -> bool:
    raise OSError(5, "Input/output error", "/dev/tracker")


@pytest.mark.parametrize(
    ("happens", "outcome", "reason", "ticks"),
    [
        (lambda: False, "failed", "the input ended before the task was done", 10),
        (press_ctrl_c, "aborted", "interrupted", 10),
    ],
)
def test_a_session_that_stops_early_is_whole(
    happens: Callable[[], object],
    outcome: str,
    reason: str,
    ticks: int,
    command_line: CommandLine,
    task: Path,
    tmp_path: Path,
    at_tick_10: Callable[[Callable[[], object]], None],
) -> None:
    """It is stored, scored and sealed; after Ctrl-C no tick begins. Exit code 0: it ran."""
    at_tick_10(happens)
    db = tmp_path / "log.db"
    code, out, err = command_line("practice", task, "--fast", "--db", db, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert (found["outcome"], found["reason"], found["ticks"]) == (outcome, reason, ticks)
    assert found["duration_s"] == ticks / 100.0
    with open_log(db) as log:
        assert seal.check(log) == []
        stored = reader.load(log, found["session"])
    assert len(stored.position) == ticks
    assert stored.status == "ended"


def test_a_device_that_breaks_costs_nothing_that_was_recorded(
    command_line: CommandLine, task: Path, tmp_path: Path, at_tick_10: Callable[[Callable[[], object]], None]
) -> None:
    at_tick_10(unplug)
    db = tmp_path / "log.db"
    code, out, err = command_line("practice", task, "--fast", "--db", db)
    assert (code, out, err) == (1, "", "trainer: /dev/tracker: Input/output error\n")
    with open_log(db) as log:
        assert seal.check(log) == []
        [summary] = reader.list_sessions(log)
        assert len(reader.load(log, summary.id).position) == 10
    assert (summary.status, summary.outcome) == ("aborted", "aborted")


def test_a_recording_that_fails_costs_only_itself(
    command_line: CommandLine, task: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The session is stored and its scores are printed; then comes the line, and exit code 1."""
    whole = RecordingSink.close

    def close(sink: RecordingSink) -> None:
        whole(sink)
        raise RecordingError(sink.path, OSError(28, "No space left on device"))

    monkeypatch.setattr(RecordingSink, "close", close)
    db, rrd = tmp_path / "log.db", tmp_path / "x.rrd"
    code, out, err = command_line("practice", task, "--fast", "--db", db, "--record", rrd, "--json")
    assert (code, err) == (1, f"trainer: {rrd}: cannot write the recording: No space left on device\n")
    with open_log(db) as log:
        assert reader.summary(log, json.loads(out)["session"]).outcome == "timeout"


def test_pictures_that_a_busy_machine_left_out_are_told(
    command_line: CommandLine, task: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder stands still from the first of nine pictures on, one every 4 ticks, and its pipe has no room for it:
    no other is taken but the last one."""
    monkeypatch.setattr(recording, "PIPE_BYTES", 1)  # the system makes that a page
    tick = RecordingSink.tick

    def told(sink: RecordingSink, record: TickRecord) -> None:
        if record.tick == 0:
            os.kill(sink.pid, signal.SIGSTOP)
        tick(sink, record)
        if record.tick == TICKS - 1:
            os.kill(sink.pid, signal.SIGCONT)

    monkeypatch.setattr(RecordingSink, "tick", told)
    code, out, err = command_line("practice", task, "--db", tmp_path / "log.db", "--json")
    assert code == 0
    assert json.loads(out)["dropped_frames"] == 7
    assert err == ("trainer: the machine was too busy: the recording lacks 7 of its pictures; the log lacks nothing\n")


def test_a_session_that_was_killed_is_announced_and_the_next_one_starts(
    command_line: CommandLine, task: Path, tmp_path: Path
) -> None:
    """A row that says "running" by a process that is gone is what kill -9 leaves."""
    db = tmp_path / "log.db"
    _, out, _ = command_line("practice", task, "--fast", "--db", db, "--no-record", "--json")
    killed = json.loads(out)["session"]
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    with open_log(db) as log:
        log.conn.execute("delete from chains")
        log.conn.execute("update sessions set status = 'running', hash = null, pid = ?", [int(gone.stdout)])
        log.conn.commit()
    code, _, err = command_line("practice", task, "--fast", "--db", db, "--no-record")
    assert code == 0
    assert err.startswith(f"trainer: session {killed} was interrupted: its first 0.33 s are kept, listed as aborted")


def test_a_recording_is_remembered_by_its_whole_path(
    command_line: CommandLine, task: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _, out, _ = command_line("practice", task, "--fast", "--db", "log.db", "--record", "x.rrd", "--json")
    with open_log(Path("log.db")) as log:
        stored = reader.summary(log, "last").recording
    assert stored == json.loads(out)["recording"] == str(tmp_path / "x.rrd")


class Still:
    """A clock on the wall by which all work takes no time."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.slept: list[float] = []

    def perf_counter(self) -> float:
        return self.seconds

    def perf_counter_ns(self) -> int:
        return round(self.seconds * 1e9)

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.seconds += seconds


@pytest.mark.parametrize(("pace", "expected"), [("--realtime", [0.01] * (TICKS - 1)), ("--fast", [])])
def test_ticks_are_paced_in_real_time_only(
    pace: str, expected: list[float], command_line: CommandLine, task: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before every tick but the first the loop waits for a slot of 10 ms; sums of 33 of them round to 1e-15 s."""
    wall = Still()
    monkeypatch.setattr("trainer.clock.time", wall)
    assert command_line("practice", task, pace, "--no-record", "--json")[0] == 0
    assert wall.slept == pytest.approx(expected, abs=1e-12)


def row(value: float | None, low: float | None, high: float | None) -> MetricRow:
    return MetricRow("bite_ratio", "Bite ratio", "", "", value, "ratio", low, high, "", "1")


@pytest.mark.parametrize(
    ("outcome", "rows", "expected"),
    [
        ("timeout", [], "anastomosis/needle-drive again: it was not completed"),
        ("completed", [row(5.0, 1.0, 4.0)], "anastomosis/needle-drive again, with an eye on bite ratio"),
        ("completed", [row(2.0, 1.0, 4.0)], "anastomosis/single-stitch"),
        ("completed", [row(None, 1.0, 4.0), row(9.0, None, None)], "anastomosis/single-stitch"),
    ],
)
def test_what_comes_next(outcome: str, rows: list[MetricRow], expected: str) -> None:
    assert suggestion("anastomosis/needle-drive", outcome, rows) == expected


def test_after_the_last_task_and_after_a_task_of_ones_own_nothing_new_comes() -> None:
    for reference in ("anastomosis/single-stitch", "my/task.toml"):
        assert suggestion(reference, "completed", []) == f"{reference} again, faster and with less movement"


def test_warm_up_leaves_no_kernel_of_the_session_to_compile(task: Path) -> None:
    """After it, a session at the task's own mesh and tick adds no compiled signature to any kernel."""
    warm_up(curriculum.load_task("anastomosis/single-stitch").task)
    before = compiled()
    assert before
    scene = build(curriculum.load_task(str(task)).task)
    run(scene, ScriptedHands(Hand(), scene.world.task, scene.home, 0), [], Fast(100.0))
    assert compiled() <= before  # kernels of other tests may have gone since


def compiled() -> set[tuple[str, int]]:
    """Every kernel of ours that is in memory, with the number of types it was compiled for."""
    kernels = [thing for thing in gc.get_objects() if isinstance(thing, Dispatcher)]
    return {(f"{k.py_func.__module__}.{k.__name__}", len(k.signatures)) for k in kernels if k.signatures}
