"""The sink that writes a session to the log, from a thread with a connection of its own.

The session only puts plain values into a queue. The thread commits them at least every 100 ms, sooner after 256
rows or an event that matters; each batch is one transaction, so that whatever ends the program costs 100 ms at
the most and never an earlier batch. While another program has locked the log, batches wait in memory.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import threading
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from sqlite_utils import Database

from trainer.events import payload
from trainer.log.reader import load
from trainer.log.record import Metric, SessionHeader, SessionRecord
from trainer.log.recovery import INTERRUPTED, abort
from trainer.log.schema import LogError, clear_errors, create_log, open_log, table
from trainer.log.seal import seal
from trainer.sinks.surface import TickRecord

BATCH_S = 0.1
BATCH_ROWS = 256
PROMPT_S = 0.08  # after so long a tick sets the thread to work, which else would begin in the midst of one
BEAT_S = 1.0  # at least so often the session says that it is alive
PATIENCE_S = 30.0  # so long a session that ends waits for another program that has locked the log
URGENT = frozenset({"task_started", "pierce", "drop", "break", "tear", "overforce", "step_done", "task_done"})


@dataclass(frozen=True)
class _Written:
    """What the thread needs of one tick; nothing in it can change any more."""

    tick: int
    poses: bytes | None  # None: the tick's poses were written before
    events: tuple[tuple[str, int, int, float, str, str, str], ...]


class LogSink:
    """Writes one session. Raises LogError as soon as the log cannot be written; what was committed stays."""

    def __init__(self, db_path: Path, header: SessionHeader) -> None:
        self._path = db_path
        self._id = header.id
        self._last_tick: int | None = None
        self._queue: SimpleQueue[_Written] = SimpleQueue()
        self._batch: list[_Written] = []  # taken from the queue, not committed yet
        self._wake = threading.Event()
        self._due = time.monotonic() + PROMPT_S  # when a tick will next set the thread to work
        self._stopping = False
        self._closed = False
        self._error: LogError | None = None
        with create_log(db_path) as db, clear_errors(db_path):
            _start(db, header)
        self._file = _identity(db_path)
        self._thread = threading.Thread(target=self._run, name="log writer", daemon=True)
        self._thread.start()

    def tick(self, record: TickRecord) -> None:
        """Note one tick. A second record of the same tick adds events to it. Raises LogError, ValueError."""
        self._raise_error()
        if self._stopping:
            raise ValueError(f"session {self._id} has ended; tick {record.tick} comes too late")
        if self._last_tick is not None and record.tick not in (self._last_tick, self._last_tick + 1):
            raise ValueError(f"tick {record.tick} does not follow tick {self._last_tick}")
        poses = record.poses.pack().astype("<f8", copy=False).tobytes() if record.tick != self._last_tick else None
        self._last_tick = record.tick
        rows = tuple((self._id, e.tick, e.seq, e.time_s, e.tool, e.kind, payload(e)) for e in record.events)
        self._queue.put(_Written(record.tick, poses, rows))
        now = time.monotonic()
        if now >= self._due or self._queue.qsize() >= BATCH_ROWS or any(e.kind in URGENT for e in record.events):
            self._due = now + PROMPT_S
            self._wake.set()

    @property
    def waiting(self) -> int:
        """How many ticks are not written yet."""
        return self._queue.qsize() + len(self._batch)

    def record(self, outcome: str, ticks: int, duration_s: float) -> SessionRecord:
        """The session as the log will hold it once it is finished so; no tick may follow. Raises LogError.

        Scores computed from it are those that anybody computes later from the log.
        """
        self._stop()
        with open_log(self._path) as db:
            stored = load(db, self._id)
        return replace(stored, status="ended", outcome=outcome, ticks=ticks, duration_s=duration_s)

    def finish(
        self,
        outcome: str,
        reason: str,
        ticks: int,
        duration_s: float,
        realtime: Mapping[str, Any] | None,
        device_summary: Mapping[str, Any] | None,
        metrics: Sequence[Metric],
    ) -> None:
        """Write how the session ended, and seal it. Raises LogError; ValueError for a metric that is not finite."""
        for metric in metrics:
            if metric.value is not None and not math.isfinite(metric.value):
                raise ValueError(f"metric '{metric.name}' is {metric.value}")
        self._closed = True
        self._stop()
        end = {
            "status": "ended",
            "outcome": outcome,
            "reason": reason,
            "ticks": ticks,
            "duration_s": duration_s,
            "realtime": _json(realtime),
            "device_summary": _json(device_summary),
        }
        with open_log(self._path) as db, clear_errors(self._path):
            db.conn.execute("pragma synchronous = full")  # the end of a session outlives a power cut
            _wait_for_others(db, PATIENCE_S)
            with db.atomic():
                self._claim(db, 0)
                table(db, "sessions").update(self._id, end)
                table(db, "metrics").insert_all({"session": self._id, **asdict(m)} for m in metrics)
                seal(db, self._id)

    def close(self) -> None:
        """Write what is left. A session that nobody finished is closed as aborted. Raises LogError."""
        if self._closed:
            return
        self._closed = True
        self._stop()
        with open_log(self._path) as db, clear_errors(self._path):
            _wait_for_others(db, PATIENCE_S)
            abort(db, self._id, INTERRUPTED)

    def _stop(self) -> None:
        self._stopping = True
        self._wake.set()
        self._thread.join()
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            self._closed = True  # who calls now knows; closing need not say it again
            raise self._error

    def _run(self) -> None:
        """The thread: wait, take what has come, commit it."""
        try:
            with open_log(self._path) as db, clear_errors(self._path):
                beat = time.monotonic()
                stopping = False
                while not stopping:
                    self._wake.wait(BATCH_S)
                    self._wake.clear()
                    stopping = self._stopping  # read before the queue: nothing is put after it is set
                    self._batch += self._taken()
                    if self._batch or time.monotonic() - beat > BEAT_S:
                        _wait_for_others(db, PATIENCE_S if stopping else BATCH_S)
                        try:
                            self._commit(db, self._batch)
                        except sqlite3.OperationalError as error:
                            if stopping or not _locked(error):
                                raise
                            continue  # with the same batch, and what has come meanwhile
                        self._batch = []
                        beat = time.monotonic()
        except LogError as error:
            self._error = error
        except Exception as error:  # whatever it is, the session must hear of it: here it would die unseen
            self._error = LogError(f"{self._path}: {type(error).__name__}: {error}")

    def _taken(self) -> list[_Written]:
        batch = []
        try:
            while True:
                batch.append(self._queue.get_nowait())
        except Empty:
            return batch

    def _commit(self, db: Database, batch: list[_Written]) -> None:
        if _identity(self._path) != self._file:
            raise LogError(f"{self._path}: the log was moved or replaced during the session")
        moved = [(w.tick, w.poses) for w in batch if w.poses is not None]
        with db.atomic():
            self._claim(db, len(moved))
            if moved:
                data = zlib.compress(b"".join(poses for _, poses in moved))
                block = {"session": self._id, "first_tick": moved[0][0], "ticks": len(moved), "data": data}
                table(db, "inputs").insert(block)
            db.conn.executemany(
                "insert into events (session, tick, seq, time_s, tool, kind, data) values (?, ?, ?, ?, ?, ?, ?)",
                [row for w in batch for row in w.events],
            )

    def _claim(self, db: Database, more_ticks: int) -> None:
        """Take the write lock, beat, and make sure that nobody has closed the session meanwhile."""
        claimed = db.conn.execute(
            "update sessions set heartbeat = ?, ticks = ticks + ?, duration_s = (ticks + ?) / tick_hz "
            "where id = ? and status = 'running'",
            [time.time(), more_ticks, more_ticks, self._id],
        ).rowcount
        if not claimed:
            raise LogError(f"{self._path}: session {self._id} was closed by another program while it ran")


def _start(db: Database, header: SessionHeader) -> None:
    row = asdict(header) | {
        "tools": _json(header.tools),
        "versions": _json(header.versions),
        "status": "running",
        "outcome": "",
        "reason": "",
        "ticks": 0,
        "duration_s": 0.0,
        "pid": os.getpid(),
        "heartbeat": time.time(),
    }
    with db.atomic():
        table(db, "trainees").insert({"name": header.trainee}, ignore=True)
        trainee = next(db.query("select id from trainees where name = ?", [header.trainee]))["id"]
        table(db, "sessions").insert(row | {"trainee": trainee})


def _wait_for_others(db: Database, seconds: float) -> None:
    """How long a statement waits for another program's lock."""
    db.conn.execute(f"pragma busy_timeout = {round(1e3 * min(seconds, PATIENCE_S))}")


def _locked(error: sqlite3.OperationalError) -> bool:
    """Whether a statement failed because another program has locked the log: it can succeed later."""
    return error.sqlite_errorname.startswith(("SQLITE_BUSY", "SQLITE_LOCKED"))


def _json(value: Mapping[str, Any] | Sequence[str] | None) -> str | None:
    return None if value is None else json.dumps(value, allow_nan=False)


def _identity(path: Path) -> tuple[int, int] | None:
    """Which file it is; None where it is gone. SQLite itself goes on writing into a deleted file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino
