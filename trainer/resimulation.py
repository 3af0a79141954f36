"""A stored session run again through the scene, and compared with what was recorded.

Same inputs, same machine, same versions: the same events bit for bit. Events that depend on the machine's
clock (``simulated = False``) are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import zip_longest

from trainer import curriculum, scene
from trainer.anatomy import library
from trainer.anatomy.imported import Anatomy
from trainer.config import ConfigError
from trainer.curriculum import Task
from trainer.events import Event, TaskDone, payload
from trainer.log.record import ANATOMY, ANATOMY_SHA256, TOLERANCE, SessionHeader, SessionRecord


def resimulate(record: SessionRecord, rows: Iterable[int] | None = None) -> list[Event]:
    """The events of the stored tool poses, stepped through a fresh scene of the stored task.

    The tissue is solved to the stored tolerance; sessions older than the choice of one have that of ``build``.
    ``rows`` are the indices of the stored ticks; a progress bar may wrap them. Raises ConfigError when the
    stored task no longer fits this version of the program, or its knee is not there or is another one now.
    """
    header = record.header
    chosen = {"tolerance_mN": float(header.versions[TOLERANCE])} if TOLERANCE in header.versions else {}
    task = curriculum.parse_task(header.task_toml, header.task)
    running = scene.build(task, **chosen, anatomy=_knee(header, task))
    found: list[Event] = []
    for i in range(record.ticks) if rows is None else rows:
        found += running.step(record.poses(i))
        if running.outcome:
            return found
    done = next((e for e in record.events if isinstance(e, TaskDone)), None)
    if done is not None:
        found += running.finish(done.outcome, done.reason)
    return found


def _knee(header: SessionHeader, task: Task) -> Anatomy | None:
    """The knee that the session was practised in; None where its task has none. Raises ConfigError."""
    reference, sha256 = header.versions.get(ANATOMY, ""), header.versions.get(ANATOMY_SHA256, "")
    try:
        found = library.of_task(task.scene.anatomy, reference)
    except ConfigError as error:
        raise ConfigError(
            f"session {header.id} was practised in the knee '{reference}' (SHA-256 {sha256[:16]}…): {error}"
        ) from None
    if found is not None and sha256 != library.fingerprint(found):
        raise ConfigError(f"the knee '{reference}' has changed since session {header.id} was practised in it")
    return found


def first_difference(recorded: Iterable[Event], again: Iterable[Event]) -> str | None:
    """Both sides of the first event that is not the same bit for bit; None where all are."""
    pairs = zip_longest(_simulated(recorded), _simulated(again), fillvalue="nothing")
    for number, (before, after) in enumerate(pairs, 1):
        if before != after:
            return f"event {number} differs\n  recorded: {before}\n  replayed: {after}"
    return None


def _simulated(events: Iterable[Event]) -> list[str]:
    """One line for each event; the text of a float holds all its bits."""
    return [
        f"tick {e.tick}, {e.seq}: {e.time_s!r} s {e.kind} {e.tool or '-'} {payload(e)}"
        for e in sorted(events, key=lambda e: (e.tick, e.seq))
        if e.simulated
    ]
