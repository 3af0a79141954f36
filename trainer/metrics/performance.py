"""One performance of one task, and the facts that many metrics need: crossings, passes, holes, the stitch.

Everything is derived from the log's events and poses and from the task's text, never from the simulation.
A vessel that the task does not know is ignored, so that a log can be scored against an edited task.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from trainer.curriculum import Step, Task, VesselSpec
from trainer.events import Event, Pierce, PullThrough, StepDone, TaskDone, Tear, Withdraw
from trainer.log.record import SessionRecord
from trainer.metrics.track import Track, track

E = TypeVar("E", bound=Event)


def wrap_deg(angle: float) -> float:
    """An angle in degrees brought into -180..180."""
    return (angle + 180.0) % 360.0 - 180.0


@dataclass(frozen=True)
class WallPass:
    """What one pass of the needle did to one vessel."""

    number: int
    vessel: VesselSpec
    crossings: tuple[Pierce, ...]  # in order of time, at least one
    reached_mm: float | None  # farthest advance beyond a wall; None where none was logged
    over: bool  # needle and wall are apart again: drawn out, pulled through or torn out

    @property
    def full_thickness(self) -> bool:
        """Whether the tip went through both walls."""
        return {c.wall for c in self.crossings} >= {"outer", "inner"}

    @property
    def depth_fraction(self) -> float | None:
        """Share of the wall's thickness that the tip reached, 0..1; None for a pass that is not over or tore out."""
        if self.full_thickness:
            return 1.0
        if self.reached_mm is None:
            return None
        return min(max(self.reached_mm / self.vessel.wall_mm, 0.0), 1.0)


@dataclass(frozen=True)
class Stitch:
    """Thread or needle that enters one vessel from outside and leaves another to the outside."""

    entry: Pierce  # outer wall, direction in
    exit: Pierce  # outer wall of another vessel, direction out


@dataclass(frozen=True)
class Performance:
    """A session's record together with the task that it performed."""

    record: SessionRecord
    task: Task

    @cached_property
    def vessels(self) -> dict[str, VesselSpec]:
        return {v.name: v for v in self.task.scene.vessel}

    def events(self, kind: type[E]) -> tuple[E, ...]:
        """All events of one kind, in the order of the log."""
        return tuple(e for e in self.record.events if isinstance(e, kind))

    @cached_property
    def tracks(self) -> dict[str, Track]:
        """The filtered path of each of the task's instruments that was seen."""
        found = {i.tool: track(self.record, i.tool) for i in self.task.scene.instrument}
        return {tool: t for tool, t in found.items() if t is not None}

    @cached_property
    def crossings(self) -> tuple[Pierce, ...]:
        """Every wall that the tip went through, in order."""
        return tuple(p for p in self.events(Pierce) if p.body in self.vessels)

    @cached_property
    def entries(self) -> tuple[Pierce, ...]:
        """The first crossing of each pass that came from outside: of the outer wall, inwards.

        A pass that begins in a lumen has no entry but an exit.
        """
        first: dict[int, Pierce] = {}
        for p in self.crossings:
            first.setdefault(p.pass_number, p)
        return tuple(p for p in first.values() if (p.wall, p.direction) == ("outer", "in"))

    @cached_property
    def wall_passes(self) -> tuple[WallPass, ...]:
        """Each pass apart for each vessel that it touched, in order of their first crossing."""
        crossed: dict[tuple[int, str], list[Pierce]] = {}
        for p in self.crossings:
            crossed.setdefault((p.pass_number, p.body), []).append(p)
        reached: dict[tuple[int, str], float] = {}
        for e in self.record.events:
            if isinstance(e, Withdraw | PullThrough):
                key = (e.pass_number, e.body)
                reached[key] = max(reached.get(key, 0.0), e.reached_mm)
        torn = {(e.body, e.wall, e.hole) for e in self.events(Tear)}
        return tuple(
            WallPass(
                number=key[0],
                vessel=self.vessels[key[1]],
                crossings=tuple(ps),
                reached_mm=reached.get(key),
                over=key in reached or any((p.body, p.wall, p.hole) in torn for p in ps),
            )
            for key, ps in crossed.items()
        )

    @cached_property
    def emptied(self) -> frozenset[tuple[str, str, int]]:
        """Holes (body, wall, number) with nothing in them at the end.

        Needle or thread was drawn out again, the wall tore, or a needle without thread went all the way through.
        """
        bare = self.task.scene.thread is None
        kinds = (Withdraw, Tear, PullThrough) if bare else (Withdraw, Tear)
        return frozenset((e.body, e.wall, e.hole) for e in self.record.events if isinstance(e, kinds))

    def is_kept(self, p: Pierce) -> bool:
        """Whether the hole of this crossing still holds needle or thread at the end of the session."""
        return (p.body, p.wall, p.hole) not in self.emptied

    @cached_property
    def outer_crossings(self) -> tuple[Pierce, ...]:
        return tuple(p for p in self.crossings if p.wall == "outer")

    @cached_property
    def stitches(self) -> tuple[Stitch, ...]:
        """Each kept way out of a vessel with the last kept way into another vessel before it."""
        found = []
        entry: Pierce | None = None
        for p in self.outer_crossings:
            if not self.is_kept(p):
                continue
            if p.direction == "in":
                entry = p
            elif entry is not None and entry.body != p.body:
                found.append(Stitch(entry, p))
                entry = None
        return tuple(found)

    @property
    def stitch(self) -> Stitch | None:
        """The last stitch."""
        return self.stitches[-1] if self.stitches else None

    def bites(self, vessel: str) -> tuple[Pierce, ...]:
        """The outer crossings that bound a bite of a vessel.

        Those of the last stitch where it has one there; otherwise the first outer crossing of each pass (a
        second one is the back wall's).
        """
        if self.stitch is not None:
            ends = tuple(p for p in (self.stitch.entry, self.stitch.exit) if p.body == vessel)
            if ends:
                return ends
        first: dict[int, Pierce] = {}
        for p in self.outer_crossings:
            if p.body == vessel:
                first.setdefault(p.pass_number, p)
        return tuple(first.values())

    def driven(self) -> Iterator[tuple[Step, Pierce]]:
        """Each ``drive`` step that was done with the outer crossing that did it: the last one before."""
        for done in self.events(StepDone):
            if not 0 <= done.index < len(self.task.step):
                continue
            step = self.task.step[done.index]
            if step.kind != "drive":
                continue
            before = [
                p
                for p in self.outer_crossings
                if p.body == step.vessel and p.direction == step.direction and (p.tick, p.seq) < (done.tick, done.seq)
            ]
            if before:
                yield step, before[-1]

    @property
    def end(self) -> TaskDone | None:
        """Where everything was when the exercise ended."""
        ends = self.events(TaskDone)
        return ends[-1] if ends else None
