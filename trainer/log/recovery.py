"""Sessions that were interrupted: closed and sealed when the log is next opened."""

from __future__ import annotations

import os
import sqlite3
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from sqlite_utils import Database

from trainer.log.repair import repair_command
from trainer.log.schema import STALE_S, can_write, clear_errors, path_of
from trainer.log.seal import seal

#: The process that writes a recording finishes it within this time after its session was killed, s (assumed; a tenth
#: is usual).
FINISHING_S = 3.0

INTERRUPTED = "the program stopped before the exercise ended"


@dataclass(frozen=True)
class Interrupted:
    """A session that was found without its end."""

    session: str
    ticks: int
    duration_s: float
    recording: str | None

    def __str__(self) -> str:
        kept = f"session {self.session} was interrupted: its first {self.duration_s:.2f} s are kept, listed as aborted"
        if self.recording is None or not Path(self.recording).exists():
            return kept
        if repair := repair_command(Path(self.recording)):
            return f"{kept}; its recording lacks its end, repair it with: {repair}"
        return f"{kept}; its recording ends there"


def recover(db: Database) -> list[Interrupted]:
    """Close and seal the sessions that say they are running while nobody writes them. Raises LogError.

    A log that may not be changed, or cannot be as the disk is full, is left as it is: it can be read all the same.
    """
    if not can_write(path_of(db)):
        return []
    found = []
    with clear_errors(path_of(db)):
        query = "select id, pid, heartbeat, recording from sessions where status = 'running' order by id"
        for row in list(db.query(query)):
            if _alive(row["pid"]) and time.time() - row["heartbeat"] < STALE_S:
                continue
            try:
                closed = abort(db, row["id"], INTERRUPTED, heartbeat=row["heartbeat"])
            except sqlite3.OperationalError as error:
                if not error.sqlite_errorname.startswith("SQLITE_FULL"):
                    raise
                break
            if closed:
                kept = next(db.query("select ticks, duration_s from sessions where id = ?", [row["id"]]))
                _let_finish(row["recording"], row["heartbeat"] + FINISHING_S)
                found.append(Interrupted(row["id"], kept["ticks"], kept["duration_s"], row["recording"]))
    return found


def abort(db: Database, session_id: str, reason: str, heartbeat: float | None = None) -> bool:
    """Close a running session as aborted and seal it; False where it has gone on or was closed meanwhile."""
    with db.atomic():
        closed = db.conn.execute(
            "update sessions set status = 'aborted', outcome = 'aborted', reason = ? "
            "where id = ? and status = 'running' and heartbeat = coalesce(?, heartbeat)",
            [reason, session_id, heartbeat],
        ).rowcount
        if closed:
            seal(db, session_id)
    return bool(closed)


def _let_finish(recording: str | None, until_s: float) -> None:
    """Wait for a recording to be whole, as it may be until that time."""
    while recording is not None and time.time() < until_s and repair_command(Path(recording)):
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    """Whether a process exists. On Windows the question itself would end it, so there the heartbeat decides."""
    if sys.platform == "win32":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
