"""The tables of the log, and how a connection to it is opened.

Who people are (``trainees``) is kept apart from what they did: everything else holds only a number for a
person, so that a name can be changed or erased without touching a session or its seal. All tables are
STRICT: SQLite refuses a text where a number belongs.
"""

from __future__ import annotations

import os
import secrets
import sqlite3
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import platformdirs
from sqlite_utils import Database, Migrations
from sqlite_utils.db import Table

#: A session whose writer has been silent for so long is taken for dead (the writer beats every second).
STALE_S = 30.0
LONGEST_NAME = 100

_DAMAGED = "damaged; restore a copy made by `trainer db backup`"

migrations = Migrations("trainer")


class LogError(ValueError):
    """The log cannot be read or written; one line with the path and the reason."""


@migrations()
def m001_first_tables(db: Database) -> None:
    table(db, "trainees").create({"id": int, "name": str}, pk="id", not_null={"name"}, strict=True)
    table(db, "trainees").create_index(["name"], unique=True)
    session = {
        "id": str, "trainee": int, "task": str, "task_toml": str, "task_sha256": str, "device": str,
        "device_toml": str, "device_sha256": str, "seed": int, "tick_hz": float, "tools": str, "started_at": str,
        "versions": str, "recording": str, "status": str, "outcome": str, "reason": str, "ticks": int,
        "duration_s": float, "pid": int, "heartbeat": float, "realtime": str, "device_summary": str,
        "previous": str, "previous_hash": str, "hash": str,
    }  # fmt: skip
    table(db, "sessions").create(
        session,
        pk="id",
        not_null=set(session) - {"recording", "realtime", "device_summary", "previous", "previous_hash", "hash"},
        foreign_keys=[("trainee", "trainees", "id"), ("previous", "sessions", "id")],
        strict=True,
    )
    table(db, "sessions").create_index(["trainee", "started_at"])
    event = {"session": str, "tick": int, "seq": int, "time_s": float, "tool": str, "kind": str, "data": str}
    table(db, "events").create(
        event,
        pk=("session", "tick", "seq"),
        not_null=set(event),
        foreign_keys=[("session", "sessions", "id")],
        strict=True,
    )
    # data: zlib of little-endian float64, one packed row of poses (trainer.poses) per tick
    inputs = {"session": str, "first_tick": int, "ticks": int, "data": bytes}
    table(db, "inputs").create(
        inputs,
        pk=("session", "first_tick"),
        not_null=set(inputs),
        foreign_keys=[("session", "sessions", "id")],
        strict=True,
    )
    metric = {
        "session": str, "name": str, "value": float, "unit": str, "target_low": float, "target_high": float,
        "source": str, "version": str,
    }  # fmt: skip
    table(db, "metrics").create(
        metric,
        pk=("session", "name"),
        not_null=set(metric) - {"value", "target_low", "target_high"},
        foreign_keys=[("session", "sessions", "id")],
        strict=True,
    )
    # where each trainee's chain of seals ends, so that a missing last session shows
    table(db, "chains").create(
        {"trainee": int, "last": str},
        pk="trainee",
        not_null={"last"},
        foreign_keys=[("trainee", "trainees", "id"), ("last", "sessions", "id")],
        strict=True,
    )


def table(db: Database, name: str) -> Table:
    """The table ``name``; in this schema no name belongs to a view."""
    return db.table(name)


def default_db_path() -> Path:
    """The log that is used where none is named: ``TRAINER_DB``, or a file in the user's data folder."""
    named = os.environ.get("TRAINER_DB")
    return Path(named) if named else Path(platformdirs.user_data_dir("trainer", appauthor=False)) / "sessions.db"


def new_session_id() -> str:
    """A name for a session: UTC to the second, so that names sort by time, and 16 random bits."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(2)}"


def create_log(path: Path) -> Database:
    """The log at ``path``, made (with its folder) where there is none. Raises LogError."""
    with clear_errors(path):
        if path.is_file() and not can_write(path):
            raise LogError(f"{path}: cannot be written; make the file and its folder writable, or name another log")
        if why := unwritable(path):
            raise LogError(f"{path}: {why}; name another log")
        return _connected(path, _make_tables)


def unwritable(path: Path) -> str:
    """Why no file can be made at ``path``, whose folder is made where there is none; "" where one can."""
    if path.is_dir():
        return "is a folder, not a file"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        blocked = next(folder for folder in path.parents if folder.exists())
        return f"{blocked} is a file, not a folder"
    except OSError as error:
        return f"its folder cannot be made: {error.strerror}"
    if not os.access(path.parent, os.W_OK | os.X_OK):
        return f"its folder {path.parent} may not be written to"
    return ""


def can_write(path: Path) -> bool:
    """Whether the log at ``path`` may be changed; SQLite also makes files beside it."""
    return os.access(path, os.W_OK) and os.access(path.absolute().parent, os.W_OK)


def open_log(path: Path) -> Database:
    """The existing log at ``path``, foreign keys enforced; works as a context manager.

    A log that may not be changed is opened for reading only.
    Raises LogError where there is none, the file is no log, or another version of its tables is needed.
    """
    if not path.is_file():
        raise LogError(f"{path}: no log here; `trainer practice` makes one, --db or TRAINER_DB names another")
    with clear_errors(path):
        return _connected(path, _check_version)


def migrate(path: Path) -> list[str]:
    """Bring the tables of the log at ``path`` up to date; the names of the steps taken. Raises LogError."""
    if not path.is_file():
        raise LogError(f"{path}: no log here, nothing to migrate")
    with clear_errors(path), _connected(path, _check_own) as db:
        steps = [m.name for m in migrations.pending(db)]
        migrations.apply(db)
    return steps


def trainee_name(given: str) -> str:
    """A name as it is stored, without blanks around it. Raises LogError for what is no name."""
    name = given.strip()
    if not name:
        raise LogError("a trainee's name must not be empty")
    if len(name) > LONGEST_NAME:
        raise LogError(f"a trainee's name has at most {LONGEST_NAME} characters, found {len(name)}")
    for character in name:
        if unicodedata.category(character) in {"Cc", "Cs", "Zl", "Zp"}:
            raise LogError(f"a trainee's name must be plain text in one line, found {character!a} in it")
    return name


@contextmanager
def clear_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and of the file system into a LogError that names the log."""
    try:
        yield
    except sqlite3.Error as error:
        raise LogError(f"{path}: {_reason(error)}") from error
    except UnicodeDecodeError as error:  # Python's driver, where a damaged file gave SQLite's message its words
        raise LogError(f"{path}: {_DAMAGED}") from error
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from error


def path_of(db: Database) -> Path:
    """The file behind a connection."""
    return Path(os.fsdecode(db.conn.execute("pragma database_list").fetchone()[2]))


def _reason(error: sqlite3.Error) -> str:
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith("SQLITE_FULL"):
        return "the disk is full"
    if name.startswith("SQLITE_IOERR"):
        return "the disk refuses to write or read (full, over quota or gone)"
    if name.startswith("SQLITE_CANTOPEN"):
        return "cannot be made or opened here; name another log"
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return "locked by another program; end that one, or what it does with the log"
    if name.startswith("SQLITE_NOTADB"):
        return "not a log: not an SQLite file"
    if name.startswith("SQLITE_CORRUPT"):
        return f"{_DAMAGED} ({error})"
    return str(error)


def _connected(path: Path, prepare: Callable[[Database], None]) -> Database:
    """A connection on which ``prepare`` has done its work; closed again where that fails."""
    if any(unicodedata.category(c) == "Cs" for c in str(path.absolute())):
        raise LogError(f"{str(path)!a}: a log's path must be plain text, which SQLite stores as UTF-8")
    db = Database(path if can_write(path) or not path.exists() else _read_only(path))
    try:
        db.conn.execute("pragma foreign_keys = on")
        db.conn.execute("pragma synchronous = normal")
        prepare(db)
    except BaseException:
        db.close()
        raise
    return db


def _read_only(path: Path) -> sqlite3.Connection:
    """A connection that writes nothing, nor a file beside the log; what was not yet merged into the log is read too.

    Without "immutable" SQLite makes the index of a write-ahead log, which it may not where the folder is read-only.
    """
    unmerged = path.with_name(f"{path.name}-wal")
    whole = not unmerged.exists() or unmerged.stat().st_size == 0
    return sqlite3.connect(f"{path.absolute().as_uri()}?{'immutable=1' if whole else 'mode=ro'}", uri=True)


def _make_tables(db: Database) -> None:
    if not db.table_names():
        _write_ahead(db)
        db.conn.execute("begin immediate")  # two programs may start at once, and either may be killed half-way
        with db.atomic():
            if not db.table_names():
                migrations.apply(db)
        db.conn.execute("commit")
    _check_version(db)


def _write_ahead(db: Database) -> None:
    """Switch to the write-ahead log; alone of all statements this one does not wait for another program's lock."""
    for pause_s in (0.01, 0.1, 0.5, 2.0, None):
        try:
            db.enable_wal()
        except sqlite3.OperationalError:
            if pause_s is None:
                raise
            time.sleep(pause_s)
        else:
            return


def _check_own(db: Database) -> None:
    """Raises LogError for somebody else's database and for tables that a newer program made."""
    known = {m.name for m in migrations._migrations}
    try:
        applied = {m.name for m in migrations.applied(db)}
    except KeyError as error:  # sqlite_utils, where a damaged file has lost a column's name
        raise LogError(f"{path_of(db)}: {_DAMAGED}") from error
    if not db.table_names():  # whoever was about to make them was interrupted
        raise LogError(f"{path_of(db)}: holds no sessions yet; `trainer practice` logs the first")
    if not applied:
        raise LogError(f"{path_of(db)}: not a log: an SQLite file of another program")
    if applied - known:
        raise LogError(f"{path_of(db)}: written by a newer version of this program; read it with that one")


def _check_version(db: Database) -> None:
    _check_own(db)
    if migrations.pending(db):
        raise LogError(
            f"{path_of(db)}: written by an older version; run `trainer db backup COPY`, then `trainer db migrate`"
        )
