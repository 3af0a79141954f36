"""Performing a task in memory: a scripted hand, a scene, and all that happened."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trainer import scene
from trainer.anatomy.imported import Anatomy
from trainer.curriculum import Task, load_task
from trainer.drivers import scripted_hands
from trainer.events import Event, Pierce, TaskDone
from trainer.interactions.holding import TOLERANCE_MN
from trainer.interactions.region import Region
from trainer.log.record import SessionHeader, SessionRecord
from trainer.mechanics.volume import PRESENT
from trainer.poses import ToolPoses
from trainer.profile import Hand, load_profile


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


def region_of(s: scene.Scene) -> Region:
    assert s.world.region is not None
    return s.world.region


def perform(
    task: Task,
    hand: Hand | str,
    seed: int = 0,
    tolerance_mN: float = TOLERANCE_MN,
    anatomy: Anatomy | None = None,
) -> Performance:
    """Let a scripted hand, or that of a device's profile, go through a task; every state on the way must be finite, and
    no element may be lost."""
    if isinstance(hand, str):
        profiled = load_profile(hand).profile.hand
        assert profiled is not None
        hand = profiled
    s = scene.build(task, tolerance_mN, anatomy)
    hands = scripted_hands(hand, task, s.home, seed)
    region = s.world.region
    elements = 0 if region is None else np.count_nonzero(region.state.links & PRESENT)
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
        if region is not None:
            assert np.isfinite(region.state.u).all()
            assert np.count_nonzero(region.state.links & PRESENT) == elements
    return Performance(s, tuple(events), tuple(poses))


def one_drive() -> Task:
    """The first drive of ``needle-drive`` alone: through both walls once."""
    task = load_task("anastomosis/needle-drive").task
    return replace(task, step=task.step[:1])


def record_of(done: Performance, task: Task, device: str = "scripted") -> SessionRecord:
    """What the log would hold of a performance."""
    header = SessionHeader(
        id="in-memory", trainee="nobody", task=task.name, task_toml="", task_sha256="", device=device, device_toml="",
        device_sha256="", seed=0, tick_hz=task.tick_hz, tools=done.scene.tools, started_at="2026-01-01T00:00:00Z",
        versions={}, recording=None,
    )  # fmt: skip
    return SessionRecord(
        header=header,
        status="ended",
        outcome=done.done.outcome,
        ticks=done.scene.tick,
        duration_s=done.scene.tick / task.tick_hz,
        events=done.events,
        first_tick=0,
        position=np.array([p.position for p in done.poses]),
        quaternion=np.array([p.quaternion for p in done.poses]),
        closure=np.array([p.closure for p in done.poses]),
        valid=np.array([p.valid for p in done.poses]),
    )
