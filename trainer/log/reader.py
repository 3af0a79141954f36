"""Stored sessions as plain data, for metrics, reports, exports and replays."""

from __future__ import annotations

import difflib
import json
import zlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from sqlite_utils import Database

from trainer import events
from trainer.geometry import Array
from trainer.log.record import Metric, SessionHeader, SessionRecord, anatomy_name
from trainer.log.schema import LogError, clear_errors, open_log, path_of, trainee_name
from trainer.poses import NUMBERS_PER_TOOL

__all__ = ["Summary", "header", "list_sessions", "load", "open_log", "resolve", "stored_metrics", "summary"]

_JOINED = "select sessions.*, trainees.name from sessions join trainees on trainees.id = sessions.trainee"


@dataclass(frozen=True)
class Summary:
    """A session in one line: who did what when, and how it ended."""

    id: str
    trainee: str
    task: str
    anatomy: str  # the knee that was practised in, "" where the task has none
    device: str
    seed: int
    started_at: str  # UTC, ISO 8601
    status: str  # running, ended or aborted
    outcome: str
    reason: str
    ticks: int
    duration_s: float
    recording: str | None
    realtime: dict[str, Any] | None
    device_summary: dict[str, Any] | None


def list_sessions(db: Database, trainee: str | None = None) -> list[Summary]:
    """All sessions, or those of one trainee, oldest first. Raises LogError for an unknown trainee."""
    name = None if trainee is None else trainee_name(trainee)
    where, values = ("", []) if name is None else (" where trainees.name = ?", [name])
    with clear_errors(path_of(db)):
        rows = list(db.query(f"{_JOINED}{where} order by sessions.started_at, sessions.id", values))
        if name is not None and not rows:
            known = [row["name"] for row in db.query("select name from trainees order by name")]
            raise LogError(f"no sessions of trainee {name!r}; known: {', '.join(known) or 'nobody yet'}")
    return [_summary(row) for row in rows]


def resolve(db: Database, reference: str) -> str:
    """The full id of a session given by its id, the unique beginning of it, or ``last``. Raises LogError."""
    with clear_errors(path_of(db)):
        known = [row["id"] for row in db.query("select id from sessions order by started_at, id")]
    if not known:
        raise LogError(f"{path_of(db)}: holds no session yet")
    if reference == "last":
        return str(known[-1])
    found = [i for i in known if i.startswith(reference)] if reference not in known else [reference]
    if len(found) == 1:
        return str(found[0])
    if found:
        raise LogError(f"{len(found)} sessions begin with {reference!r}, among them {found[0]} and {found[-1]}")
    near = difflib.get_close_matches(reference, known, n=1)
    hint = f"; did you mean {near[0]}?" if near else "; `trainer sessions list` shows them"
    raise LogError(f"no session {reference!r} among the {len(known)} of {path_of(db)}{hint}")


def summary(db: Database, reference: str) -> Summary:
    """One session in one line. Raises LogError."""
    return _summary(_row(db, resolve(db, reference)))


def header(db: Database, reference: str) -> SessionHeader:
    """What is needed to run a session again. Raises LogError."""
    return _header(_row(db, resolve(db, reference)))


def stored_metrics(db: Database, reference: str) -> tuple[Metric, ...]:
    """The scores that were stored when the session ended, in their order. Raises LogError."""
    columns = ", ".join(f.name for f in fields(Metric))
    session_id = resolve(db, reference)
    with clear_errors(path_of(db)):
        rows = db.query(f"select {columns} from metrics where session = ? order by rowid", [session_id])
        return tuple(Metric(**row) for row in rows)


def load(db: Database, reference: str) -> SessionRecord:
    """A session with its events and tool poses. Raises LogError."""
    row = _row(db, resolve(db, reference))
    first = _header(row)
    path = path_of(db)
    with clear_errors(path):
        query = "select tick, seq, time_s, tool, kind, data from events where session = ? order by tick, seq"
        stored = list(db.query(query, [first.id]))
        blocks = list(db.query("select * from inputs where session = ? order by first_tick", [first.id]))
    try:
        found = tuple(events.from_row(**e) for e in stored)
        poses = _poses(blocks, len(first.tools))
        if len(poses) < row["ticks"]:
            raise ValueError(f"has the tool poses of {len(poses)} ticks only, {row['ticks']} were simulated")
    except (ValueError, zlib.error) as error:
        raise LogError(f"{path}: session {first.id}: {error}; `trainer db check` tells more") from error
    return SessionRecord(
        header=first,
        status=row["status"],
        outcome=row["outcome"],
        ticks=row["ticks"],
        duration_s=row["duration_s"],
        events=found,
        first_tick=blocks[0]["first_tick"] if blocks else 0,
        position=poses[:, :, 0:3].copy(),
        quaternion=poses[:, :, 3:7].copy(),
        closure=poses[:, :, 7].copy(),
        valid=poses[:, :, 8] != 0.0,
    )


def _poses(blocks: list[dict[str, Any]], tools: int) -> Array:
    """Packed poses ``(n, tools, 9)`` of consecutive ticks. Raises ValueError for a gap, zlib.error for damage."""
    rows = [np.zeros((0, tools, NUMBERS_PER_TOOL))]
    expected = blocks[0]["first_tick"] if blocks else 0
    for block in blocks:
        if block["first_tick"] != expected:
            raise ValueError(f"the tool poses of ticks {expected} to {block['first_tick'] - 1} are missing")
        numbers = np.frombuffer(zlib.decompress(block["data"]), "<f8")
        rows.append(numbers.reshape(block["ticks"], tools, NUMBERS_PER_TOOL))
        expected += block["ticks"]
    return np.concatenate(rows).astype(np.float64)


def _row(db: Database, session_id: str) -> dict[str, Any]:
    with clear_errors(path_of(db)):
        return next(iter(db.query(f"{_JOINED} where sessions.id = ?", [session_id])))


def _header(row: dict[str, Any]) -> SessionHeader:
    values = {f.name: row[f.name] for f in fields(SessionHeader)}
    parsed = {"tools": tuple(json.loads(row["tools"])), "versions": json.loads(row["versions"])}
    return SessionHeader(**(values | parsed | {"trainee": row["name"]}))


def _summary(row: dict[str, Any]) -> Summary:
    values = {f.name: row[f.name] for f in fields(Summary) if f.name != "anatomy"}
    for name in ("realtime", "device_summary"):
        values[name] = json.loads(row[name]) if row[name] is not None else None
    versions = json.loads(row["versions"])
    return Summary(**(values | {"trainee": row["name"], "anatomy": anatomy_name(versions)}))
