"""Sessions as four tidy CSV files: sessions, events, metrics and poses, with units in the columns' names.

One row is one thing (a session, an event, a score, a tool at a tick), so that R, pandas and a spreadsheet
read them as they are. Numbers are written so that they read back exactly; an empty cell is a missing value. A text
that a spreadsheet would run as a formula (it begins with = + - or @, as a trainee's name may) gets an apostrophe before
it, which R and pandas show.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from trainer.curriculum import parse_task
from trainer.events import payload
from trainer.exports.files import make_room, naming, new_file
from trainer.log.record import SessionRecord
from trainer.metrics import score

SESSIONS = (
    "session", "trainee", "task", "task_sha256", "anatomy", "anatomy_sha256", "device", "seed", "started_at",
    "status", "outcome", "ticks", "tick_hz", "duration_s", "trainer_version",
)  # fmt: skip
EVENTS = ("session", "tick", "seq", "time_s", "tool", "kind", "data_json")
METRICS = ("session", "metric", "value", "unit", "target_low", "target_high", "source", "version")
POSES = ("session", "tick", "time_s", "tool", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "closure", "valid")

#: What a formula begins with in a spreadsheet; numbers are no texts here.
FORMULA = ("=", "+", "-", "@")

Row = tuple[Any, ...]


def session_rows(record: SessionRecord) -> Iterator[Row]:
    """One row: who did what when, and how it ended."""
    h = record.header
    yield (
        h.id, h.trainee, h.task, h.task_sha256, h.anatomy, h.anatomy_sha256, h.device, h.seed, h.started_at,
        record.status, record.outcome, record.ticks, h.tick_hz, record.duration_s, h.versions.get("trainer", ""),
    )  # fmt: skip


def event_rows(record: SessionRecord) -> Iterator[Row]:
    """One row an event; the fields of its kind are a JSON object."""
    for e in record.events:
        yield record.header.id, e.tick, e.seq, e.time_s, e.tool, e.kind, payload(e)


def metric_rows(record: SessionRecord) -> Iterator[Row]:
    """One row a score, computed from the record. Raises ConfigError for a task that cannot be read."""
    for m in score(record, parse_task(record.header.task_toml, record.header.task)):
        yield record.header.id, m.name, m.value, m.unit, m.target_low, m.target_high, m.source, m.version


def pose_rows(record: SessionRecord) -> Iterator[Row]:
    """One row a tool and tick; ``valid`` is 0 where the device did not see the tool."""
    h = record.header
    position, quaternion = record.position.tolist(), record.quaternion.tolist()
    closure, valid = record.closure.tolist(), record.valid.tolist()
    for i in range(len(position)):
        tick = record.first_tick + i
        for k, tool in enumerate(h.tools):
            numbers = (*position[i][k], *quaternion[i][k], closure[i][k])
            yield h.id, tick, tick / h.tick_hz, tool, *numbers, int(valid[i][k])


def plain(row: Row) -> Row:
    """The row with an apostrophe before each text that a spreadsheet would run."""
    return tuple(f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA) else cell for cell in row)


FILES: dict[str, tuple[tuple[str, ...], Callable[[SessionRecord], Iterator[Row]]]] = {
    "sessions.csv": (SESSIONS, session_rows),
    "events.csv": (EVENTS, event_rows),
    "metrics.csv": (METRICS, metric_rows),
    "poses.csv": (POSES, pose_rows),
}


def write(records: Iterable[SessionRecord], folder: Path) -> dict[str, int]:
    """Write all files into a new or empty folder; returns the rows of each, without headings.

    Records are taken one at a time; where one cannot be read or written, no file stays. Raises ExportError where the
    folder holds something or is a file, OSError where it cannot be written.
    """
    make_room(folder)
    rows = dict.fromkeys(FILES, 0)
    with ExitStack() as stack:
        files = {name: stack.enter_context(new_file(folder / name)) for name in FILES}
        writers = {name: csv.writer(file, lineterminator="\n") for name, file in files.items()}
        for name, (columns, _) in FILES.items():
            writers[name].writerow(columns)
        for record in records:
            for name, (_, rows_of) in FILES.items():
                with naming(folder / name):
                    for row in rows_of(record):
                        writers[name].writerow(plain(row))
                        rows[name] += 1
        for name, file in files.items():  # the disk may be full for one when another is closed
            with naming(folder / name):
                file.flush()
    return rows
