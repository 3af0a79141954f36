"""What all scripted hands share: they look at the scene as a person does and move two instruments through a task.

The hands know nothing that a trainee could not see. How well they do what they intend (tremor, aim, pauses, detours)
comes from the profile alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from trainer.curriculum import Task
from trainer.drivers.hand_motion import Tremor, between, ease, turn_angle
from trainer.drivers.sight import Lost
from trainer.geometry import Array, Rigid
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.view import View

Movement = Iterator[None]  # yields once per tick

JAW_S = 0.15  # time to open or close the jaws
TURN = 2.0  # fastest turn of an instrument, rad/s (assumed)


class Hands(ABC):
    """A driver whose poses come from a plan; see :class:`trainer.profile.Hand` for its settings."""

    def __init__(self, hand: Hand, task: Task, home: ToolPoses, seed: int) -> None:
        self._hand = hand
        self._task = task
        self._dt = 1.0 / task.tick_hz
        self._rng = np.random.default_rng([hand.seed, seed])
        count = len(home.closure)
        self._tremor = [Tremor(1e-3 * hand.tremor_rms_um, hand.tremor_hz, self._dt, self._rng) for _ in range(count)]
        self._pose = [home.world_from_tool(i) for i in range(count)]  # intended, without tremor
        self._closure = home.closure.copy()
        self._plan: Movement | None = None
        self._stopped = ""

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        assert isinstance(view, View)
        if self._plan is None:
            self._begin(view)
            self._plan = self._perform()
        self._look(view)
        try:
            next(self._plan)
        except StopIteration:
            return None
        except Lost as reason:
            self._stopped = str(reason)
            return None
        return ToolPoses(
            position=np.array([p.position + t.next() for p, t in zip(self._pose, self._tremor, strict=True)]),
            quaternion=np.array([p.quaternion for p in self._pose]),
            closure=self._closure.copy(),
            valid=np.ones(len(self._pose), dtype=bool),
        )

    def summary(self) -> dict[str, object]:
        return {"driver": "scripted", "stopped": self._stopped}

    def close(self) -> None:
        self._plan = None

    @abstractmethod
    def _begin(self, view: View) -> None:
        """Take in the scene for the first time."""

    @abstractmethod
    def _look(self, view: View) -> None:
        """Take in the scene as it is at this tick."""

    @abstractmethod
    def _perform(self) -> Movement:
        """The whole task, one tick after the other. Raises Lost where it cannot go on."""

    def _glide(self, tool: int, target: Rigid, pace: float = 1.0) -> Movement:
        """An instrument that carries nothing moves straight to ``target``."""
        start = self._pose[tool]
        bump = self._detour()
        for u in self._paced(start, target, pace, 2.0 * float(np.linalg.norm(bump))):
            pose = between(start, target, u)
            self._pose[tool] = Rigid(pose.position + math.sin(math.pi * u) ** 2 * bump, pose.quaternion)
            yield

    def _paced(self, start: Rigid, target: Rigid, pace: float, detour_mm: float) -> Iterator[float]:
        way = float(np.linalg.norm(target.position - start.position)) + detour_mm
        seconds = max(
            way / (pace * self._hand.speed_mm_s),
            turn_angle(start, target) / TURN,
        )
        ticks = max(1, math.ceil(seconds / self._dt))
        for k in range(1, ticks + 1):
            yield ease(k / ticks)

    def _jaws(self, tool: int, closure: float) -> Movement:
        start = float(self._closure[tool])
        ticks = max(1, round(JAW_S / self._dt))
        for k in range(1, ticks + 1):
            self._closure[tool] = start + (closure - start) * k / ticks
            yield
        yield

    def _wait(self, seconds: float) -> Movement:
        for _ in range(math.ceil(seconds / self._dt)):
            yield

    def _hesitate(self) -> Movement:
        if self._hand.hesitation_s > 0.0:
            yield from self._wait(self._rng.exponential(self._hand.hesitation_s))

    def _detour(self) -> Array:
        return self._rng.normal(0.0, 1.0, 3) * self._hand.wander_mm
