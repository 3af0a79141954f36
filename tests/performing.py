"""Performing a task in memory: a scripted hand, a scene, and all that happened."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trainer import scene
from trainer.curriculum import Task, load_task
from trainer.drivers.scripted import ScriptedHands
from trainer.events import Event, Pierce, TaskDone
from trainer.poses import ToolPoses
from trainer.profile import Hand


@dataclass(frozen=True)
class Performance:
    scene: scene.Scene
    events: tuple[Event, ...]
    poses: tuple[ToolPoses, ...]

    @property
    def done(self) -> TaskDone:
        end = self.events[-1]
        assert isinstance(end, TaskDone)
        return end

    def pierces(self, vessel: str, wall: str) -> list[Pierce]:
        return [e for e in self.events if isinstance(e, Pierce) and (e.body, e.wall) == (vessel, wall)]


def perform(task: Task, hand: Hand, seed: int = 0) -> Performance:
    """Let a scripted hand go through a task; every state on the way must be finite."""
    s = scene.build(task)
    hands = ScriptedHands(hand, task, s.home, seed)
    events: list[Event] = []
    poses: list[ToolPoses] = []
    while not s.outcome:
        seen = hands.poll(s.tick, s.view())
        if seen is None:
            events += s.finish("failed", str(hands.summary()["stopped"]))
        else:
            poses.append(seen)
            events += s.step(seen)
        assert np.isfinite(s.world.nodes).all()
        assert s.world.solver is None or np.isfinite(s.world.solver.x).all()
    return Performance(s, tuple(events), tuple(poses))


def one_drive() -> Task:
    """The first drive of ``needle-drive`` alone: through both walls once."""
    task = load_task("anastomosis/needle-drive").task
    return replace(task, step=task.step[:1])
