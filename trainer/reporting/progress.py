"""What a report of a trainee's progress shows, as plain data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from trainer.curriculum import Task, parse_task
from trainer.log.record import SessionRecord
from trainer.metrics import Definition, definition_of, score
from trainer.metrics.learning import Trend, recent, trend
from trainer.metrics.performance import Performance
from trainer.reporting import wording
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
CURVES = ("time_s", "entry_angle_error_deg", "iatrogenic_contact_count")
#: How many of the last sessions the stitch map shows.
MAP_SESSIONS = 5
#: How many attempts a strip shows beside the last.
STRIP_ATTEMPTS = 5


@dataclass(frozen=True)
class Attempt:
    """One session of a task."""

    number: int  # from 1, among all sessions of the task in its knee
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
    """All attempts of one trainee at one task, in one knee where it has such."""

    task: str
    title: str
    anatomy: str  # the knee; empty where the task has none
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
    tasks: tuple[TaskProgress, ...]  # one for each knee that a task was practised in, beside each other

    @property
    def several_knees(self) -> bool:
        """Whether a task was practised in more than one."""
        return len({t.task for t in self.tasks}) < len(self.tasks)


def progress_report(records: Iterable[SessionRecord]) -> ProgressReport:
    """The progress that one trainee's sessions show. Raises ValueError for none, ConfigError for a bad task.

    A session that still runs is left out. A task is judged by the text of its last session.
    """
    ended = sorted((r for r in records if r.status != "running"), key=lambda r: (r.header.started_at, r.header.id))
    if not ended:
        raise ValueError("no session has ended yet")
    by_task: dict[str, dict[str, list[SessionRecord]]] = {}
    for record in ended:
        by_task.setdefault(record.header.task, {}).setdefault(record.header.anatomy_sha256, []).append(record)
    return ProgressReport(
        trainee=ended[0].header.trainee,
        first_at=ended[0].header.started_at,
        last_at=ended[-1].header.started_at,
        tasks=tuple(
            _task_progress(name, records, knee) for name, knees in by_task.items() for knee, records in _named(knees)
        ),
    )


def _named(knees: dict[str, list[SessionRecord]]) -> list[tuple[str, list[SessionRecord]]]:
    """The sessions in each knee after its name, as it was called last; knees of one name tell their fingerprints."""
    names = [records[-1].header.anatomy for records in knees.values()]
    return [
        (f"{name}, {knee[:8]}" if names.count(name) > 1 else name, records)
        for name, (knee, records) in zip(names, knees.items(), strict=True)
    ]


def _task_progress(name: str, records: list[SessionRecord], knee: str) -> TaskProgress:
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
        anatomy=knee,
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
    return Curve(name, wording.title(name), definition.unit, numbers, values, recent(values), trend(numbers, values))


def _row(last: MetricRow, definition: Definition, attempts: tuple[Attempt, ...]) -> ProgressRow:
    judged = last.has_target or definition.better
    points = _points(last.name, attempts) if judged else []  # else no value is better than another
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
