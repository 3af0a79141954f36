"""What a report of a trainee's progress shows, as plain data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from trainer.curriculum import Task, parse_task
from trainer.log.record import SessionRecord
from trainer.metrics import Definition, definition_of, score
from trainer.metrics.learning import Trend, recent, trend
from trainer.metrics.performance import Performance
from trainer.reporting.session import (
    Histogram,
    MetricRow,
    StitchMap,
    TissueRow,
    histogram,
    metric_row,
    stitch_map,
    tissue_rows,
)

#: Metrics that have a learning curve.
CURVES = ("time_s", "entry_angle_error_deg")
#: How many of the last sessions the stitch map shows.
MAP_SESSIONS = 5
#: How many attempts a strip shows beside the last.
STRIP_ATTEMPTS = 5


@dataclass(frozen=True)
class Attempt:
    """One session of a task."""

    number: int  # from 1, among all sessions of the task
    session: str
    started_at: str
    outcome: str
    values: dict[str, float | None]

    @property
    def completed(self) -> bool:
        return self.outcome == "completed"


@dataclass(frozen=True)
class Curve:
    """A value over the completed attempts, and what can be said about it."""

    name: str
    title: str
    unit: str
    attempts: tuple[int, ...]
    values: tuple[float, ...]
    recent: float | None  # median of the last three
    trend: Trend | None


@dataclass(frozen=True)
class ProgressRow:
    """Last and best value of a metric against its target."""

    last: MetricRow
    best: float | None
    best_attempt: int | None
    earlier: tuple[float, ...]  # up to five values before the last, oldest first


@dataclass(frozen=True)
class TaskProgress:
    """All attempts of one trainee at one task."""

    task: str
    title: str
    attempts: tuple[Attempt, ...]
    curves: tuple[Curve, ...]
    rows: tuple[ProgressRow, ...]
    stitch_map: StitchMap  # of the last sessions
    map_sessions: int
    histogram: Histogram  # of all sessions
    tissue: tuple[TissueRow, ...]  # of the last session

    @property
    def completed(self) -> int:
        return sum(a.completed for a in self.attempts)


@dataclass(frozen=True)
class ProgressReport:
    """A trainee's progress in every task that was tried."""

    trainee: str
    first_at: str
    last_at: str
    tasks: tuple[TaskProgress, ...]


def progress_report(records: Iterable[SessionRecord]) -> ProgressReport:
    """The progress that one trainee's sessions show. Raises ValueError for none, ConfigError for a bad task.

    A session that still runs is left out. A task is judged by the text of its last session.
    """
    by_task: dict[str, list[SessionRecord]] = {}
    for record in sorted(records, key=lambda r: (r.header.started_at, r.header.id)):
        if record.status != "running":
            by_task.setdefault(record.header.task, []).append(record)
    if not by_task:
        raise ValueError("no session has ended yet")
    times = sorted(r.header.started_at for rs in by_task.values() for r in rs)
    some = next(iter(by_task.values()))[0]
    return ProgressReport(
        trainee=some.header.trainee,
        first_at=times[0],
        last_at=times[-1],
        tasks=tuple(_task_progress(name, rs) for name, rs in by_task.items()),
    )


def _task_progress(name: str, records: list[SessionRecord]) -> TaskProgress:
    last = records[-1].header
    task = parse_task(last.task_toml, last.task)
    scored = [score(r, task) for r in records]
    attempts = tuple(
        Attempt(i, r.header.id, r.header.started_at, r.outcome or r.status, {m.name: m.value for m in metrics})
        for i, (r, metrics) in enumerate(zip(records, scored, strict=True), 1)
    )
    performances = [Performance(r, task) for r in records]
    names = [m.name for m in scored[-1]]
    wanted = [m for m in scored[-1] if m.name in {t.name for t in task.metric}]
    return TaskProgress(
        task=name,
        title=task.title,
        attempts=attempts,
        curves=tuple(_curve(n, attempts, task) for n in CURVES if n in names),
        rows=tuple(_row(metric_row(m, task), definition_of(m.name, task), attempts) for m in wanted),
        stitch_map=_merged([stitch_map(p) for p in performances[-MAP_SESSIONS:]]),
        map_sessions=min(len(records), MAP_SESSIONS),
        histogram=histogram(performances, task),
        tissue=tissue_rows(performances[-1]),
    )


def _points(name: str, attempts: tuple[Attempt, ...]) -> list[tuple[int, float]]:
    """Attempt number and value, of the attempts that were completed: others stopped at another place."""
    return [(a.number, v) for a in attempts if a.completed and (v := a.values.get(name)) is not None]


def _curve(name: str, attempts: tuple[Attempt, ...], task: Task) -> Curve:
    definition = definition_of(name, task)
    points = _points(name, attempts)
    numbers, values = tuple(n for n, _ in points), tuple(v for _, v in points)
    title = "Time" if name == "time_s" else "Entry angle error"
    return Curve(name, title, definition.unit, numbers, values, recent(values), trend(numbers, values))


def _row(last: MetricRow, definition: Definition, attempts: tuple[Attempt, ...]) -> ProgressRow:
    points = _points(last.name, attempts)
    best = min(points, key=lambda p: (*_distance(p[1], last, definition), -p[0]), default=None)
    before = [v for a in attempts[:-1] if (v := a.values.get(last.name)) is not None]
    return ProgressRow(
        last=last,
        best=None if best is None else best[1],
        best_attempt=None if best is None else best[0],
        earlier=tuple(before[-STRIP_ATTEMPTS:]),
    )


def _distance(value: float, row: MetricRow, definition: Definition) -> tuple[float, float]:
    """How far a value is from its target, then how far it could improve the way that the metric improves."""
    below = 0.0 if row.target_low is None else max(row.target_low - value, 0.0)
    above = 0.0 if row.target_high is None else max(value - row.target_high, 0.0)
    inside = {"lower": value, "higher": -value, "": 0.0}[definition.better]
    return below + above, inside


def _merged(maps: list[StitchMap]) -> StitchMap:
    """Several maps of one task as one; bites keep their order, marks are the same in all."""
    return StitchMap(
        vessels=maps[-1].vessels,
        bites=tuple(b for m in maps for b in m.bites),
        marks=maps[-1].marks,
        stitches=tuple(s for m in maps for s in m.stitches),
    )
