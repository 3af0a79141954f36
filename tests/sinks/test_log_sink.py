"""The sink keeps what it was given whatever ends the program, and tells the session when it cannot."""

from __future__ import annotations

import itertools
import math
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from waiting import PATIENCE_S, wait_for

from tests.log.log_samples import METRICS, contact, execute, header, pierce, step, task_done, write
from trainer.events import Event
from trainer.log import reader, seal
from trainer.log.record import Metric
from trainer.log.recovery import recover
from trainer.log.schema import STALE_S, LogError, open_log
from trainer.sinks import log
from trainer.sinks.log import LogSink

ROOT = Path(__file__).parents[2]
SESSION = "20261122-013145-7f3a"
NEXT = "20261122-020000-0001"
NEVER_S = 1e9
PAUSED_AFTER = 170


def stored_events(path: Path, session: str = SESSION) -> list[Event]:
    with open_log(path) as db:
        return list(reader.load(db, session).events)


def wait_for_events(path: Path, count: int) -> None:
    """Returns once the log holds ``count`` events; gives up after so long that the writer must have failed."""
    assert wait_for(lambda: len(stored_events(path)) >= count), f"the log never held {count} events"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "folder" / "s.db"


def test_the_record_for_scoring_is_what_the_log_gives_later(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as sink:
        for tick in range(30):
            sink.tick(step(tick, pierce(tick)))
        sink.tick(step(29, task_done(29, 1, "failed", "dropped")))
        before = sink.record("failed", 30, 0.3)
        sink.finish("failed", "dropped", 30, 0.3, {"overruns": 1}, {"gaps": 2}, METRICS)
    with open_log(path) as db:
        after = reader.load(db, SESSION)
        summary = reader.summary(db, SESSION)
        assert seal.check(db) == []
    assert (before.header, before.events) == (after.header, after.events)
    for name in ("status", "outcome", "ticks", "duration_s", "first_tick"):
        assert getattr(before, name) == getattr(after, name)
    for name in ("position", "quaternion", "closure", "valid"):
        assert (getattr(before, name) == getattr(after, name)).all()
    assert (summary.reason, summary.realtime, summary.device_summary) == ("dropped", {"overruns": 1}, {"gaps": 2})


def test_an_event_that_matters_is_written_at_once_with_all_before_it(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "BATCH_S", NEVER_S)
    monkeypatch.setattr(log, "PROMPT_S", NEVER_S)
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, contact(0)))
        sink.tick(step(1, pierce(1)))
        wait_for_events(path, 2)


def test_a_full_batch_is_written_at_once(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "BATCH_S", NEVER_S)
    monkeypatch.setattr(log, "PROMPT_S", NEVER_S)
    with closing(LogSink(path, header(SESSION))) as sink:
        for tick in range(log.BATCH_ROWS):
            sink.tick(step(tick, contact(tick)))
        wait_for_events(path, log.BATCH_ROWS)


def test_a_tick_sets_the_thread_to_work_when_it_is_time(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "BATCH_S", NEVER_S)
    monkeypatch.setattr(log, "PROMPT_S", 0.0)
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, contact(0)))
        wait_for_events(path, 1)


def test_nothing_waits_for_the_end_of_the_session(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, contact(0)))
        wait_for_events(path, 1)


def test_ticks_follow_one_another(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(4))
        sink.tick(step(5))
        for wrong in (4, 7):
            with pytest.raises(ValueError, match=f"tick {wrong} does not follow tick 5"):
                sink.tick(step(wrong))
        sink.finish("completed", "", 2, 0.02, None, None, ())
        with pytest.raises(ValueError, match="tick 6 comes too late"):
            sink.tick(step(6))
    with open_log(path) as db:
        assert reader.load(db, SESSION).first_tick == 4


def test_a_metric_that_is_not_finite_is_refused(path: Path) -> None:
    """SQLite would store NaN as NULL, which means that there was nothing to measure."""
    with closing(LogSink(path, header(SESSION))) as sink:
        for value in (math.nan, math.inf):
            with pytest.raises(ValueError, match=f"metric 'm' is {value}"):
                sink.finish("completed", "", 0, 0.0, None, None, (Metric("m", value, "mm", None, None, "", "1"),))


def test_a_session_that_nobody_finished_is_closed_as_aborted(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as sink:
        for tick in range(3):
            sink.tick(step(tick, contact(tick)))
    with open_log(path) as db:
        summary = reader.summary(db, SESSION)
        assert (summary.status, summary.outcome, summary.ticks, summary.duration_s) == ("aborted", "aborted", 3, 0.03)
        assert seal.check(db) == []
        assert recover(db) == []


def test_sessions_may_be_written_at_the_same_time(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as one, closing(LogSink(path, header(NEXT))) as two:
        for tick in range(50):
            one.tick(step(tick, pierce(tick)))
            two.tick(step(tick, pierce(tick)))
        two.finish("completed", "", 50, 0.5, None, None, METRICS)
        one.finish("completed", "", 50, 0.5, None, None, METRICS)
    assert stored_events(path) == stored_events(path, NEXT) == [pierce(t) for t in range(50)]
    with open_log(path) as db:
        assert seal.check(db) == []


def test_a_session_id_is_used_once(path: Path) -> None:
    write(path, SESSION)
    with pytest.raises(LogError, match=r"s\.db: UNIQUE constraint failed: sessions\.id"):
        LogSink(path, header(SESSION))


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Another program holds a transaction in which it writes."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("begin immediate")
        yield
        other.execute("rollback")


def go_on(sink: LogSink, tick: int) -> None:
    """Many more ticks, at a pace that a writer can follow."""
    ends = time.monotonic() + PATIENCE_S
    while time.monotonic() < ends:
        sink.tick(step(tick, contact(tick)))
        tick += 1
        time.sleep(0.001)


def test_a_folder_that_goes_away_stops_the_session(path: Path, tmp_path: Path) -> None:
    """SQLite itself would go on writing into the file that nobody finds any more, without a word."""
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, pierce(0)))
        wait_for_events(path, 1)
        path.parent.rename(tmp_path / "elsewhere")
        with pytest.raises(LogError, match=f"^{path}: the log was moved or replaced during the session$"):
            go_on(sink, 1)
        with pytest.raises(LogError, match="moved or replaced"):
            sink.finish("completed", "", 1, 0.01, None, None, ())
    assert stored_events(tmp_path / "elsewhere" / "s.db") == [pierce(0)]


def test_a_session_that_was_closed_elsewhere_is_not_written_any_more(path: Path) -> None:
    """Another program took it for dead and sealed it: more rows would break the seal."""
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, pierce(0)))
        wait_for_events(path, 1)
        execute(path, "update sessions set status = 'aborted'")
        with pytest.raises(LogError, match="was closed by another program while it ran"):
            go_on(sink, 1)
    execute(path, "update sessions set status = 'running'")
    assert stored_events(path)[0] == pierce(0)


def retried(monkeypatch: pytest.MonkeyPatch, times: int) -> threading.Event:
    """Set when the writer has failed to commit so often, for whatever reason."""
    failures, commit, enough = itertools.count(1), LogSink._commit, threading.Event()

    def counted(sink: LogSink, *given: Any) -> None:
        try:
            commit(sink, *given)
        except sqlite3.Error:
            if next(failures) == times:
                enough.set()
            raise

    monkeypatch.setattr(LogSink, "_commit", counted)
    return enough


def test_a_log_that_another_program_locks_for_a_while_loses_nothing(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A database browser, a migration. What comes meanwhile, and events that matter, wait in memory."""
    enough = retried(monkeypatch, 3)
    with closing(LogSink(path, header(SESSION))) as sink:
        with locked(path):
            for tick in range(300):
                sink.tick(step(tick, pierce(tick)))
            assert enough.wait(PATIENCE_S)
            sink.tick(step(300, pierce(300)))
            assert sink.waiting == 301
        sink.tick(step(301))
        sink.finish("completed", "", 302, 3.02, None, None, METRICS)
    with open_log(path) as db:
        record = reader.load(db, SESSION)
        assert seal.check(db) == []
    assert (record.status, record.ticks, len(record.position)) == ("ended", 302, 302)
    assert list(record.events) == [pierce(t) for t in range(301)]


def test_a_log_that_stays_locked_is_told_in_one_line_and_keeps_what_was_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "PATIENCE_S", 0.05)
    with closing(LogSink(path, header(SESSION))) as sink:
        sink.tick(step(0, pierce(0)))
        wait_for_events(path, 1)
        with locked(path):
            sink.tick(step(1, pierce(1)))
            with pytest.raises(LogError, match=f"^{path}: locked by another program; end that one"):
                sink.finish("completed", "", 2, 0.02, None, None, ())
    execute(path, "update sessions set heartbeat = heartbeat - ?", (STALE_S + 1.0,))
    with open_log(path) as db:
        assert [i.ticks for i in recover(db)] == [1]
        assert seal.check(db) == []


@pytest.mark.parametrize("place", ["file/s.db", "file/deeper/s.db", "."])
def test_a_place_that_cannot_hold_a_log(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LogError) as told:
        LogSink(tmp_path / place, header(SESSION))
    assert str(told.value).startswith(f"{tmp_path / place}: ")
    assert "\n" not in str(told.value)


def in_subprocess(code: str, *arguments: str, **options: object) -> subprocess.Popen[str]:
    script = f"import sys; sys.path.insert(0, {str(ROOT)!r})\nfrom pathlib import Path\n{code}"
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )  # type: ignore[call-overload, no-any-return]


needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and resource limits are POSIX")

WRITES_FOREVER = f"""
import itertools, time
from tests.log.log_samples import contact, header, step
from trainer.sinks.log import LogSink
sink = LogSink(Path(sys.argv[1]), header(sys.argv[2], recording=sys.argv[3] or None))
for tick in itertools.count():
    sink.tick(step(tick, contact(tick)))
    print(tick, flush=True)
    if tick == {PAUSED_AFTER}:
        sys.stdin.readline()
    time.sleep(0.005)
"""


@needs_posix
def test_kill_9_loses_no_event_that_had_time_to_be_written(path: Path, tmp_path: Path) -> None:
    """Events that do not matter are written because time passes: there are too few of them for a batch, and no more
    come. Nothing of that is lost where a kill comes in the middle of writing more. How much time it is is BATCH_S.
    """
    assert PAUSED_AFTER < log.BATCH_ROWS
    assert log.BATCH_S <= 0.1
    recording = tmp_path / "it's here.rrd"
    recording.touch()
    process = in_subprocess(WRITES_FOREVER, str(path), SESSION, str(recording), stdin=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdin is not None
    while process.stdout.readline() != f"{PAUSED_AFTER}\n":
        assert process.poll() is None
    wait_for_events(path, PAUSED_AFTER + 1)
    process.stdin.write("\n")
    process.stdin.flush()
    for _ in range(100):
        process.stdout.readline()
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL

    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("pragma integrity_check").fetchall() == [("ok",)]
    with open_log(path) as db:
        (found,) = recover(db)
        assert recover(db) == []
        record = reader.load(db, SESSION)
        assert seal.check(db) == []
    assert (record.status, record.outcome, record.ticks) == ("aborted", "aborted", len(record.position))
    stored = [e.tick for e in record.events]
    assert stored == list(range(len(stored)))
    assert stored[-1] >= PAUSED_AFTER
    assert record.ticks == len(stored)  # poses and events of a tick are stored together
    good = tmp_path / "it's here.repaired.rrd"
    quoted = [
        f"'{str(p).replace(chr(39), chr(39) + chr(34) + chr(39) + chr(34) + chr(39))}'" for p in (recording, good)
    ]
    assert f"{Path(sys.executable).parent / 'rerun'} rrd optimize {quoted[0]} -o {quoted[1]}" in str(found)

    write(path, NEXT)
    with open_log(path) as db:
        assert [s.outcome for s in reader.list_sessions(db)] == ["aborted", "completed"]
        assert seal.check(db) == []


def test_a_running_session_is_left_alone_until_its_heart_has_stopped(path: Path) -> None:
    with closing(LogSink(path, header(SESSION))) as sink, open_log(path) as db:
        assert recover(db) == []
        sink.record("completed", 0, 0.0)  # the writer has stopped, and with it the heart
        execute(path, "update sessions set heartbeat = heartbeat - ?", (STALE_S + 1.0,))
        assert [i.session for i in recover(db)] == [SESSION]


def test_an_interrupted_session_is_left_as_it_is_where_the_disk_is_full(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def abort(*_: object, **__: object) -> bool:
        full = sqlite3.OperationalError("database or disk is full")
        full.sqlite_errorname = "SQLITE_FULL"
        raise full

    with closing(LogSink(path, header(SESSION))) as sink, open_log(path) as db:
        sink.record("completed", 0, 0.0)
        execute(path, "update sessions set heartbeat = heartbeat - ?", (STALE_S + 1.0,))
        with monkeypatch.context() as patched:
            patched.setattr("trainer.log.recovery.abort", abort)
            assert recover(db) == []
        assert [s.id for s in reader.list_sessions(db)] == [SESSION]
        assert [i.session for i in recover(db)] == [SESSION]


def test_the_heart_beats_without_ticks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiling kernels may take longer than a heart may stop."""
    monkeypatch.setattr(log, "BEAT_S", 0.0)
    with closing(LogSink(path, header(SESSION))), open_log(path) as db:

        def beat() -> float:
            return float(next(db.query("select heartbeat from sessions"))["heartbeat"])

        first = beat()
        assert wait_for(lambda: beat() > first)


FILLS_THE_DISK = """
import resource, time
from tests.log.log_samples import header, pierce, step
from trainer.log import reader
from trainer.log.schema import LogError, open_log
from trainer.sinks.log import LogSink
path = Path(sys.argv[1])
sink = LogSink(path, header(sys.argv[2]))
sink.tick(step(0, *(pierce(0, i) for i in range(20))))
with open_log(path) as db:
    while not reader.load(db, sys.argv[2]).events:
        time.sleep(0.005)  # all that waits for a disk that is full is lost: what is kept must have been written
if sys.argv[3] == "limit":
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
else:
    (path.parent / "ballast").write_bytes(b"0" * 2_000_000)
try:
    for tick in range(1, 1_000_000):
        sink.tick(step(tick, *(pierce(tick, i) for i in range(20))))
        time.sleep(0.0005)
except LogError as error:
    print(error)
try:
    sink.finish("completed", "", 1, 1.0, None, None, ())
except LogError as error:
    print(error)
sink.close()
"""


def assert_told_and_kept(path: Path, process: subprocess.Popen[str], reason: str) -> None:
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert output.splitlines() == [f"{path}: {reason}"] * 2
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("pragma integrity_check").fetchall() == [("ok",)]
    with open_log(path) as db:
        (found,) = recover(db)
        assert found.ticks > 0
        stored = [(e.tick, e.seq) for e in reader.load(db, SESSION).events]
        assert stored == [(tick, seq) for tick in range(found.ticks) for seq in range(20)]
        assert seal.check(db) == []


@needs_posix
def test_a_file_that_may_not_grow_is_told_in_one_line_and_costs_nothing_written(path: Path) -> None:
    process = in_subprocess(FILLS_THE_DISK, str(path), SESSION, "limit")
    assert_told_and_kept(path, process, "the disk refuses to write or read (full, over quota or gone)")


@needs_posix
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_is_told_in_one_line_and_costs_nothing_written(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)], check=False).returncode:
        pytest.skip("this machine lets nobody mount a disk")
    try:
        process = in_subprocess(FILLS_THE_DISK, str(disk / "s.db"), SESSION, "disk")
        process.wait()
        (disk / "ballast").unlink()  # room for all that waits in the write-ahead file, a second time
        assert_told_and_kept(disk / "s.db", process, "the disk is full")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


IN_AN_UNWRITABLE_FOLDER = """
import os
from tests.log.log_samples import header, write
from trainer.log.schema import LogError
from trainer.sinks.log import LogSink
session, following, *places = sys.argv[1:]
write(Path(places[0]), session)
Path(places[0]).chmod(0o444)
Path(places[0]).parent.chmod(0o555)
if os.geteuid() == 0:
    os.setuid(65534)  # nothing is unwritable for root
for place in places:
    try:
        LogSink(Path(place), header(following))
    except LogError as error:
        print(error)
"""


@needs_posix
def test_an_unwritable_folder_is_told_in_one_line() -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        path = Path(folder) / "locked" / "s.db"
        places = [path, path.parent / "new.db", path.parent / "deeper" / "new.db"]
        process = in_subprocess(IN_AN_UNWRITABLE_FOLDER, SESSION, NEXT, *map(str, places))
        output, errors = process.communicate()
        path.parent.chmod(0o755)
    lines = output.splitlines()
    assert [line.split(": ")[0] for line in lines] == list(map(str, places)), errors
    assert "cannot be written" in lines[0]
    assert "may not be written to; name another log" in lines[1]
    assert "Permission denied" in lines[2]
