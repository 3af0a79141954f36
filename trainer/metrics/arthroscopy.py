"""How a region of the anatomy was handled: what was touched, cut and torn, how hard it was pulled."""

from __future__ import annotations

import math

import numpy as np

from trainer.curriculum import Step, Task
from trainer.events import Cut, Event, Grasp, PortalEnter, Probe, StepDone, Tack, Tear
from trainer.geometry import Rigid, quaternion_from_euler_deg
from trainer.metrics.performance import Performance
from trainer.metrics.registry import metric


def handles(task: Task) -> bool:
    """Whether the task has a region of the anatomy."""
    return task.scene.anatomy is not None


def cuts(task: Task) -> bool:
    """Whether the task has a structure to be cut."""
    return any(s.kind == "cut" for s in task.step)


def grasps(task: Task) -> bool:
    """Whether the task has a structure to be grasped."""
    return any(s.kind == "grasp" for s in task.step)


def probes(task: Task) -> bool:
    """Whether the task has a structure to be touched with a probe."""
    return any(s.kind == "probe" for s in task.step)


def enters(task: Task) -> bool:
    """Whether an instrument of the task goes through a portal."""
    return any(i.portal_mm is not None for i in task.scene.instrument)


def _structure(event: Event) -> str:
    """The structure that an instrument touched; "" where it did not."""
    if isinstance(event, Cut | Tack | Probe) or (isinstance(event, Grasp) and event.target == "tissue"):
        return event.body
    return ""


@metric("grasp_error_mm", "mm", grasps, better="lower")
def grasp_error(performance: Performance, _: str) -> float | None:
    """Mean distance of the grasps that reached their step from their marks, in the tissue at rest."""
    return _mean_error(performance, "grasp", Grasp)


@metric("cut_error_mm", "mm", cuts, better="lower")
def cut_error(performance: Performance, _: str) -> float | None:
    """Mean distance of the cuts that reached their step from their marks, in the tissue at rest.

    A cut made in several strokes lies where all of them lie on the mean, each weighed by its volume.
    """
    return _mean_error(performance, "cut", Cut)


@metric("cut_volume_mm3", "mm3", cuts, better="lower")
def cut_volume(performance: Performance, _: str) -> float:
    """Volume of the elements that blades have laid open, in all structures and strokes."""
    return math.fsum(e.volume_mm3 for e in performance.events(Cut))


@metric("stroke_count", "count", cuts, better="lower")
def strokes(performance: Performance, _: str) -> float:
    """How often blades closed through tissue."""
    return float(len({(e.tick, e.tool) for e in performance.events(Cut)}))


@metric("tear_volume_mm3", "mm3", handles, better="lower")
def tear_volume(performance: Performance, _: str) -> float:
    """Volume of the elements that lost a link because they were pulled too far."""
    return math.fsum(e.volume_mm3 for e in performance.events(Tear))


@metric("iatrogenic_contact_count", "count", handles, better="lower")
def iatrogenic_contacts(performance: Performance, _: str) -> float:
    """How often an instrument touched a structure that no step of the task names."""
    asked = {s.structure for s in performance.task.step}
    return float(sum(_structure(e) not in {"", *asked} for e in performance.record.events))


@metric("structures_touched_count", "count", handles)
def structures_touched(performance: Performance, _: str) -> float:
    """How many structures the instruments touched, those of the task and others."""
    return float(len({_structure(e) for e in performance.record.events} - {""}))


@metric("pull_max_mN", "mN", handles, better="lower")
def pull_max(performance: Performance, _: str) -> float | None:
    """Largest pull of an instrument on tissue that it held; None where nothing was held."""
    held = any(isinstance(e, Grasp) and e.target == "tissue" for e in performance.record.events)
    return performance.end.pull_max_mN if held and performance.end is not None else None


@metric("probe_force_max_mN", "mN", probes, better="lower")
def probe_force(performance: Performance, _: str) -> float | None:
    """Largest force on the tip of a probe; None where it touched nothing."""
    touched = bool(performance.events(Probe))
    return performance.end.press_max_mN if touched and performance.end is not None else None


@metric("landmarks_touched_count", "count", probes)
def landmarks_touched(performance: Performance, _: str) -> float:
    """How many of the structures that the task wants touched were touched."""
    asked = {s.structure for s in performance.task.step if s.kind == "probe"}
    return float(len(asked & {e.body for e in performance.events(Probe)}))


@metric("portal_entry_count", "count", enters, better="lower")
def portal_entries(performance: Performance, _: str) -> float:
    """How often an instrument went in through its portal."""
    return float(len(performance.events(PortalEnter)))


@metric("retraction_mm", "mm", cuts)
def retraction(performance: Performance, _: str) -> float | None:
    """How far apart the cut ends were when the exercise ended; None where nothing was cut through."""
    done = any(s.kind == "cut" for s, _ in _reached(performance))
    return performance.end.gap_mm if done and performance.end is not None else None


def _reached(performance: Performance) -> list[tuple[Step, StepDone]]:
    steps = performance.task.step
    return [(steps[e.index], e) for e in performance.events(StepDone) if 0 <= e.index < len(steps)]


def _mean_error(performance: Performance, kind: str, event: type[Grasp] | type[Cut]) -> float | None:
    """Mean over the steps of a kind of the distance from their mark to where they were done since the step before."""
    scene = performance.task.scene
    world_from_scene = Rigid(np.array(scene.position_mm), quaternion_from_euler_deg(scene.rotation_deg))
    errors, since = [], (-1, 0)
    for step, done in _reached(performance):
        until = (done.tick, done.seq)
        if step.kind == kind:
            here = [
                e for e in performance.events(event) if e.body == step.structure and since < (e.tick, e.seq) < until
            ]
            if here:
                weights = [max(e.volume_mm3, 1e-9) if isinstance(e, Cut) else 1.0 for e in here]
                at = here[-1].point if kind == "grasp" else np.average([e.point for e in here], axis=0, weights=weights)
                errors.append(math.dist(at, world_from_scene.apply(np.array(step.place_mm))))
        since = until
    return sum(errors) / len(errors) if errors else None
