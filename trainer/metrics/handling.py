"""How gently and surely things were held: counts of events, largest forces, time unseen by the device."""

from __future__ import annotations

import numpy as np

from trainer.curriculum import Task
from trainer.events import Break, Contact, Cut, Drop, Event, Grasp, Overforce, Pierce, Probe, Slip, Tear
from trainer.metrics.performance import Performance
from trainer.metrics.registry import metric, pierces


def _needle(task: Task) -> bool:
    return task.scene.needle is not None


def _thread(task: Task) -> bool:
    return task.scene.thread is not None


def _vessel(task: Task) -> bool:
    return bool(task.scene.vessel)


def _count(performance: Performance, kind: type[Event]) -> float:
    return float(len(performance.events(kind)))


@metric("grasp_count", "count")
def grasps(performance: Performance, _: str) -> float:
    """How often the jaws took hold of needle, thread, wall or tissue."""
    return _count(performance, Grasp)


@metric("wall_grasp_count", "count", _vessel)
def wall_grasps(performance: Performance, _: str) -> float:
    """How often the jaws took hold of a vessel's wall."""
    return float(sum(e.target == "wall" for e in performance.events(Grasp)))


def _touched(event: Event) -> bool:
    if isinstance(event, Grasp):
        return event.target in ("wall", "tissue")
    return isinstance(event, Contact | Pierce | Overforce | Cut | Probe)


@metric("overforce_count", "count", better="lower", version="3")
def overforces(performance: Performance, _: str) -> float | None:
    """How often a force or pressure rose above the task's limits; once per excursion.

    None where neither needle, jaws nor tip touched anything: no touch is not a gentle one.
    """
    return _count(performance, Overforce) if any(map(_touched, performance.record.events)) else None


@metric("slip_count", "count", better="lower")
def slips(performance: Performance, _: str) -> float:
    """How often a held thing slid out of the jaws."""
    return _count(performance, Slip)


@metric("drop_count", "count", _needle, better="lower")
def drops(performance: Performance, _: str) -> float:
    """How often the needle was let go with nothing to hold it."""
    return _count(performance, Drop)


@metric("tear_count", "count", _vessel, better="lower")
def tears(performance: Performance, _: str) -> float:
    """How often a wall gave way: a hole that ripped out, or tissue torn by the jaws."""
    return _count(performance, Tear)


@metric("break_count", "count", _thread, better="lower")
def breaks(performance: Performance, _: str) -> float:
    """How often the thread broke."""
    return _count(performance, Break)


@metric("puncture_force_max_mN", "mN", pierces, version="2")
def puncture_force(performance: Performance, _: str) -> float | None:
    """Largest force of the needle's tip on a wall as the wall gave way: see the event ``pierce``.

    Along the needle, or the whole of it where the tip was pushed aside and made its hole so.
    """
    return max((p.force_mN for p in performance.crossings), default=None)


@metric("wall_grasp_force_max_mN", "mN", _vessel, better="lower")
def wall_grasp_force(performance: Performance, _: str) -> float | None:
    """Largest force of the jaws as they took hold of a vessel's wall."""
    return max((e.force_mN for e in performance.events(Grasp) if e.target == "wall"), default=None)


@metric("tracking_lost_s", "s", better="lower")
def tracking_lost(performance: Performance, _: str) -> float:
    """Time in which the device did not see at least one instrument."""
    unseen = ~np.all(performance.record.valid, axis=1)
    return float(np.count_nonzero(unseen)) / performance.record.header.tick_hz
