"""A seal on each session, so that a log that was changed later shows.

The seal is the SHA-256 of a session's rows in canonical bytes. It covers the seal of the same trainee's
previously sealed session, and the table ``chains`` holds the last one: a session that was taken away leaves
a gap. It is no signature: whoever can run this program can also seal again what they changed.
"""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager

from sqlite_utils import Database

from trainer.log.schema import LogError, clear_errors, path_of, table

#: The sealed columns and their order. A later column joins under a new name of the format, so that old seals hold.
SEALED = {
    "sessions": (
        "id", "trainee", "task", "task_toml", "task_sha256", "device", "device_toml", "device_sha256", "seed",
        "tick_hz", "tools", "started_at", "versions", "recording", "status", "outcome", "reason", "ticks",
        "duration_s", "pid", "heartbeat", "realtime", "device_summary", "previous", "previous_hash",
    ),
    "events": ("session", "tick", "seq", "time_s", "tool", "kind", "data"),
    "inputs": ("session", "first_tick", "ticks", "data"),
    "metrics": ("session", "name", "value", "unit", "target_low", "target_high", "source", "version"),
}  # fmt: skip
_ORDER = {"sessions": "id", "events": "tick, seq", "inputs": "first_tick", "metrics": "name"}


def seal(db: Database, session_id: str) -> str:
    """Chain a session to its trainee's last one and seal it; the seal, as hexadecimal text.

    Call it inside a transaction that has already written, so that no other program seals in between.
    """
    sessions = table(db, "sessions")
    trainee = sessions.get(session_id)["trainee"]
    last = next(iter(db.query("select last from chains where trainee = ?", [trainee])), None)
    previous = sessions.get(last["last"]) if last else {"id": None, "hash": None}
    sessions.update(session_id, {"previous": previous["id"], "previous_hash": previous["hash"]})
    value = digest(db.conn, session_id)
    sessions.update(session_id, {"hash": value})
    table(db, "chains").upsert({"trainee": trainee, "last": session_id}, pk="trainee")
    return value


def digest(connection: sqlite3.Connection, session_id: str | bytes) -> str:
    """SHA-256 over the sealed columns of all rows of a session, as hexadecimal text."""
    sha = hashlib.sha256(b"trainer session, format 1")
    with _stored_bytes(connection):
        for name, columns in SEALED.items():
            key = "id" if name == "sessions" else "session"
            query = f"select {', '.join(columns)} from {name} where {key} = cast(? as text) order by {_ORDER[name]}"
            for row in connection.execute(query, [session_id]):
                sha.update(b"row of " + name.encode())
                for value in row:
                    sha.update(_canonical(value))
    return sha.hexdigest()


def check(db: Database) -> list[str]:
    """What is wrong with a log: lines that name the sessions whose rows are not those that were sealed."""
    connection, path = db.conn, path_of(db)
    with _stored_bytes(connection):
        try:
            with clear_errors(path):
                problems = [f"{path}: {line}" for line in _damage(connection)]
                return [*problems, *_orphans(connection), *_changed(connection), *_broken_chains(connection)]
        except LogError as error:
            return [str(error)]


@contextmanager
def _stored_bytes(connection: sqlite3.Connection) -> Iterator[None]:
    """Read texts as the bytes that are stored: a byte that somebody changed may no longer be UTF-8."""
    before = connection.text_factory
    connection.text_factory = bytes
    try:
        yield
    finally:
        connection.text_factory = before


def _canonical(value: int | float | bytes | None) -> bytes:
    """A value with its type and length, so that no two rows share their bytes."""
    if value is None:
        return b"n"
    if isinstance(value, bytes):
        return b"b%d:" % len(value) + value
    if isinstance(value, float):
        return b"f" + struct.pack("<d", value)
    return b"i%d;" % value


def _damage(connection: sqlite3.Connection) -> list[str]:
    lines = [row[0].decode(errors="replace") for row in connection.execute("pragma integrity_check(10)")]
    return [] if lines == ["ok"] else [f"damaged: {line}" for line in lines]


def _orphans(connection: sqlite3.Connection) -> Iterator[str]:
    for name in ("events", "inputs", "metrics"):
        query = f"select distinct session from {name} where session not in (select id from sessions)"
        for (session,) in connection.execute(query):
            yield f"{_name(session)}: has {name} but its row in sessions is missing"


def _changed(connection: sqlite3.Connection) -> Iterator[str]:
    rows = connection.execute("select id, status, hash from sessions order by id").fetchall()
    for session, status, stored in rows:
        if stored is None:
            if status != b"running":
                yield f"{_name(session)}: has no seal"
            continue
        try:
            changed = digest(connection, session).encode() != stored
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            yield f"{_name(session)}: cannot be read ({error})"
            continue
        if changed:
            yield f"{_name(session)}: its rows are not those that were sealed"


def _broken_chains(connection: sqlite3.Connection) -> Iterator[str]:
    """Walk back from each trainee's last session; every sealed session must be met once."""
    rows = connection.execute("select id, trainee, previous, previous_hash, hash from sessions").fetchall()
    sealed = {row[0]: row[1:] for row in rows if row[4] is not None}
    met: set[bytes] = set()
    for trainee, last in connection.execute("select trainee, last from chains order by trainee").fetchall():
        session, after, expected = last, None, None
        while session is not None and session not in met:
            follower = f"the session before {_name(after)}" if after else f"the last session of trainee {trainee}"
            if session not in sealed:
                yield f"{_name(session)}: {follower} is missing or has lost its seal"
                break
            owner, previous, previous_hash, stored = sealed[session]
            if owner != trainee:
                yield f"{_name(session)}: {follower} now belongs to trainee {owner}"
            if after and stored != expected:
                yield f"{_name(session)}: its seal is not the one that {_name(after)} follows"
            met.add(session)
            session, after, expected = previous, session, previous_hash
    for session in sorted(set(sealed) - met):
        yield f"{_name(session)}: sealed, but not in the chain of its trainee"


def _name(session: bytes) -> str:
    return f"session {session.decode(errors='replace')}"
