"""What a report of one session shows, as plain data; how it looks is decided elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

from trainer.curriculum import Task
from trainer.events import Cut, Event, Grasp, Pierce, Probe, Tack, Tear, TickOverrun, TrackingBack, TrackingLost
from trainer.log.record import Metric, SessionRecord
from trainer.metrics import FAMILIES, definition_of, score
from trainer.metrics.performance import Performance
from trainer.metrics.piercing import crossing_angle_deg
from trainer.metrics.registry import NO_TARGET
from trainer.reporting import wording

#: Width of a bin of the angle histogram, degrees.
BIN_DEG = 5


@dataclass(frozen=True)
class MetricRow:
    """One measured value for a reader."""

    name: str
    title: str
    family: str  # heading under which it stands
    meaning: str
    value: float | None
    unit: str
    target_low: float | None
    target_high: float | None
    source: str
    version: str

    @property
    def has_target(self) -> bool:
        return self.target_low is not None or self.target_high is not None

    @property
    def assumed(self) -> bool:
        """Whether nobody measured the target."""
        return self.has_target and self.source.startswith("assumed")

    @property
    def met(self) -> bool | None:
        """Whether the value lies in the target band; None without value or target."""
        if self.value is None or not self.has_target:
            return None
        return (self.target_low is None or self.value >= self.target_low) and (
            self.target_high is None or self.value <= self.target_high
        )


@dataclass(frozen=True)
class Bite:
    """One hole in an outer wall, as a dot on a clock face."""

    vessel: str
    clock_deg: float
    bite_mm: float
    angle_error_deg: float | None  # 90 - angle to the wall
    pass_number: int
    kept: bool  # still holds needle or thread


@dataclass(frozen=True)
class Mark:
    """Where a step asks for a hole."""

    vessel: str
    clock_deg: float
    bite_mm: float


@dataclass(frozen=True)
class StitchMap:
    """The holes of a session (or several) around each vessel's cut edge."""

    vessels: tuple[str, ...]
    bites: tuple[Bite, ...]
    marks: tuple[Mark, ...]
    stitches: tuple[tuple[Bite, Bite], ...]


@dataclass(frozen=True)
class Histogram:
    """Entry angles in bins of 5 degrees from 0 to 90; the last bin includes 90."""

    counts: tuple[int, ...]
    target_low: float | None
    target_high: float | None


@dataclass(frozen=True)
class TissueRow:
    """What was done to one structure of a region."""

    structure: str
    asked: bool  # whether a step of the task names it
    grasps: int
    contacts: int  # of an instrument's tip with what is rigid
    tacked_mm3: float
    cut_mm3: float
    torn_mm3: float


@dataclass(frozen=True)
class EventLine:
    """An event, several alike in a row, or a hand's losses of sight between two things that it did."""

    time_s: float
    tool: str
    kind: str
    text: str
    count: int


@dataclass(frozen=True)
class SessionReport:
    """All that the report of one session shows."""

    session: str
    trainee: str
    task: str
    task_title: str
    anatomy: str  # the knee that was practised in; empty where the task has none
    started_at: str
    device: str
    status: str
    outcome: str
    duration_s: float
    versions: dict[str, str]
    steps_done: int
    steps: int
    targets: tuple[MetricRow, ...]  # metrics with a target, in the task's order
    others: tuple[MetricRow, ...]
    stitch_map: StitchMap
    histogram: Histogram
    tissue: tuple[TissueRow, ...]  # empty where the task has no region of the anatomy
    events: tuple[EventLine, ...]
    overruns: int  # ticks that took longer than their slot
    out_of_sight: str  # which hands the device did not see, how long and why; empty where it saw all

    @property
    def missed(self) -> tuple[MetricRow, ...]:
        return tuple(row for row in self.targets if row.met is False)


def session_report(record: SessionRecord, task: Task) -> SessionReport:
    """The report of a session; scores are computed anew from its record. Raises ConfigError."""
    performance = Performance(record, task)
    rows = [metric_row(m, task) for m in score(record, task)]
    header = record.header
    return SessionReport(
        session=header.id,
        trainee=header.trainee,
        task=header.task,
        task_title=task.title,
        anatomy=header.anatomy,
        started_at=header.started_at,
        device=header.device,
        status=record.status,
        outcome=record.outcome or record.status,
        duration_s=record.duration_s,
        versions=header.versions,
        steps_done=sum(e.kind == "step_done" for e in record.events),
        steps=len(task.step),
        targets=tuple(r for r in rows if r.has_target),
        others=tuple(r for r in rows if not r.has_target),
        stitch_map=stitch_map(performance),
        histogram=histogram([performance], task),
        tissue=tissue_rows(performance),
        events=event_lines(record.events),
        overruns=sum(isinstance(e, TickOverrun) and e.work_ms > e.slot_ms for e in record.events),
        out_of_sight=wording.out_of_sight(record.events),
    )


def metric_row(metric: Metric, task: Task) -> MetricRow:
    """A metric with what its definition says. Raises ConfigError for an unknown one."""
    definition = definition_of(metric.name, task)
    family = next(title for module, title in FAMILIES.items() if module.__name__ == definition.measure.__module__)
    return MetricRow(
        name=metric.name,
        title=wording.title(metric.name),
        family=family,
        meaning=definition.meaning,
        value=metric.value,
        unit=metric.unit,
        target_low=metric.target_low,
        target_high=metric.target_high,
        source=metric.source if metric.source != NO_TARGET else "",
        version=metric.version,
    )


def stitch_map(performance: Performance) -> StitchMap:
    """Where the outer walls were pierced, where they should have been, and which holes make a stitch."""

    def bite(p: Pierce) -> Bite:
        angle = crossing_angle_deg(p)
        error = None if angle is None else 90.0 - angle
        return Bite(p.body, p.clock_deg % 360.0, p.axial_mm, error, p.pass_number, performance.is_kept(p))

    marks = {Mark(s.vessel, s.clock_deg, s.bite_mm): None for s in performance.task.step if s.kind == "drive"}
    return StitchMap(
        vessels=tuple(performance.vessels),
        bites=tuple(bite(p) for p in performance.outer_crossings),
        marks=tuple(marks),
        stitches=tuple((bite(s.entry), bite(s.exit)) for s in performance.stitches),
    )


def histogram(performances: list[Performance], task: Task) -> Histogram:
    """The entry angles of all passes of some performances of one task."""
    counts = [0] * (90 // BIN_DEG)
    for performance in performances:
        for p in performance.entries:
            angle = crossing_angle_deg(p)
            if angle is not None:
                counts[min(int(angle // BIN_DEG), len(counts) - 1)] += 1
    target = next((t for t in task.metric if t.name == "entry_angle_deg"), None)
    return Histogram(tuple(counts), target.low if target else None, target.high if target else None)


def tissue_rows(performance: Performance) -> tuple[TissueRow, ...]:
    """What was done to each structure of the task's region: the movable ones, and others that were touched."""
    anatomy = performance.task.scene.anatomy
    if anatomy is None:
        return ()
    done = [e for e in performance.record.events if isinstance(e, Grasp | Probe | Tack | Cut | Tear) and e.body]
    names = dict.fromkeys([*(t.structure for t in anatomy.tissue), *(e.body for e in done)])

    def volume(kind: type[Tack] | type[Cut] | type[Tear], name: str) -> float:
        return sum((e.volume_mm3 for e in performance.events(kind) if e.body == name), 0.0)

    return tuple(
        TissueRow(
            structure=name,
            asked=any(s.structure == name for s in performance.task.step),
            grasps=sum(isinstance(e, Grasp) and e.body == name for e in done),
            contacts=sum(isinstance(e, Probe) and e.body == name for e in done),
            tacked_mm3=volume(Tack, name),
            cut_mm3=volume(Cut, name),
            torn_mm3=volume(Tear, name),
        )
        for name in names
    )


def event_lines(events: tuple[Event, ...]) -> tuple[EventLine, ...]:
    """The events in words, late ticks left out; those alike that follow each other are one line.

    So are the losses of sight of one hand and its returns until that hand does something else, at the time of
    the first, whatever the other hand does meanwhile: a tracker may lose a hand thousands of times a session.
    """
    groups: list[list[Event]] = []
    unseen: dict[str, list[Event]] = {}  # of each hand, while it does nothing else
    for e in events:
        if isinstance(e, TickOverrun):
            continue
        if isinstance(e, TrackingLost | TrackingBack):
            if e.tool not in unseen:
                unseen[e.tool] = []
                groups.append(unseen[e.tool])
            unseen[e.tool].append(e)
            continue
        unseen.pop(e.tool, None)
        if groups and _said(groups[-1][-1]) == _said(e):
            groups[-1].append(e)
        else:
            groups.append([e])
    return tuple(map(_line, groups))


def _said(event: Event) -> tuple[str, str, str]:
    return event.tool, event.kind, wording.describe(event)


def _line(group: list[Event]) -> EventLine:
    first, count = group[0], len(group)
    tool, kind, text = _said(first)
    sight = [e for e in group if isinstance(e, TrackingLost | TrackingBack)]
    if sight:
        lost = sum(isinstance(e, TrackingLost) for e in sight)
        kind = TrackingLost.kind if lost else kind
        text, count = wording.unseen(sight), max(lost, count - lost)
    return EventLine(first.time_s, tool, kind, text, count)
