"""Scripted hands of an arthroscopy: they grasp a structure at its mark, pull, tack and cut it, or touch it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from trainer.curriculum import Step, Task
from trainer.drivers.hands import Hands, Movement
from trainer.drivers.sight import Lost
from trainer.geometry import Array, Rigid, unit
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.view import View

#: A profile tells how a hand moves under the microscope. In a joint its speed, aim and detours are larger by this
#: (assumed: a ligament is ten times as wide as a vessel), its tremor is not.
LARGER = 5.0
STAND_OFF_MM = 12.0  # an instrument's distance before it reaches for something
FIRM = 0.9  # closure that holds
PULL_PACE = 0.15  # speed of a pull, as a share of the hand's
PULL_BEYOND = 1.15  # a pull goes so much further than the step asks: tissue gives way in the jaws
SNIP_MM = 4.0  # how far scissors go on after each snip
ROW_MM = 2.0  # to either side, what one row of snips cuts
OVERLAP_MM = 1.5  # a row goes so far beyond the nearest edge of what is left
EDGE_MM = 1.0  # and so much further ahead
SHIFTS_MM = (0.0, 1.0, -1.0, 2.0, -2.0)  # a row that meets bone is moved so far aside: open blades reach as far
MOST_ROWS = 12
TRIES = 5  # at catching tissue
INSIDE = 0.2  # detours in the joint, which is narrow, as a share of those outside
NEAR_MM = 6.0  # from here on a probe feels its way
FEEL_MM, FEEL_PACE = 0.2, 0.1  # in steps of this, at this share of the hand's speed
LATE = 1.5  # how much further it presses after a touch, in errors of its aim
WATCH_S = 2.0  # how long the hand looks whether cut ends draw apart


class ArthroscopicHands(Hands):
    """The hands of a surgeon with grasper and scissors."""

    def __init__(self, hand: Hand, task: Task, home: ToolPoses, seed: int) -> None:
        larger = replace(
            hand,
            speed_mm_s=LARGER * hand.speed_mm_s,
            aim_error_mm=LARGER * hand.aim_error_mm,
            wander_mm=LARGER * hand.wander_mm,
        )
        super().__init__(larger, task, home, seed)
        self._view: View
        self._home = [home.world_from_tool(i) for i in range(len(home.closure))]
        kinds = [i.kind for i in task.scene.instrument]
        self._grasper, self._scissors, self._probe = (
            kinds.index(kind) if kind in kinds else -1 for kind in ("grasper", "scissors", "probe")
        )

    def _begin(self, view: View) -> None:
        self._view = view

    def _look(self, view: View) -> None:
        self._view = view

    def _perform(self) -> Movement:
        for step in self._task.step:
            yield from self._hesitate()
            if step.kind == "grasp":
                yield from self._take(step)
            elif step.kind == "pull":
                yield from self._pull(step)
            elif step.kind == "tack":
                yield from self._tack()
            elif step.kind == "cut":
                yield from self._cut(step)
            elif step.kind == "probe":
                yield from self._feel(step)
            else:
                yield from self._wait(WATCH_S)
        yield from self._wait(0.5)

    def _take(self, step: Step) -> Movement:
        for _ in range(TRIES):
            yield from self._jaws(self._grasper, 0.0)
            place = self._view.tissue(step.structure, np.array(step.place_mm)) + self._miss()
            yield from self._reach(self._grasper, place)
            yield from self._jaws(self._grasper, FIRM)
            if self._grasper in self._view.tissue_holders:
                return
        raise Lost("the jaws do not catch the tissue")

    def _pull(self, step: Step) -> Movement:
        here = self._pose[self._grasper]
        way = self._view.place(np.array(step.place_mm)) - here.position
        size = float(np.linalg.norm(way))
        far = max(size, PULL_BEYOND * step.at_least_mm)
        target = Rigid(here.position + way / size * far + self._miss(), here.quaternion)
        yield from self._glide(self._grasper, target, PULL_PACE)
        if self._grasper not in self._view.tissue_holders:
            raise Lost("the tissue slid out of the jaws")

    def _tack(self) -> Movement:
        yield from self._jaws(self._grasper, 1.0)
        yield from self._jaws(self._grasper, 0.0)
        yield from self._back(self._grasper)

    def _cut(self, step: Step) -> Movement:
        """Snip across the structure at its mark, a row beside the other, until it is severed."""
        tool, done, place = self._scissors, self._view.steps_done, np.array(step.place_mm)
        mark = self._view.tissue(step.structure, place) + self._miss()
        ahead, aside, across = self._home[tool].matrix.T
        before = math.inf
        for _ in range(MOST_ROWS):
            left = self._view.uncut(step.structure, place) - mark
            if not len(left):
                break
            nearest = min((left @ aside).tolist(), key=abs)  # what still holds
            row = nearest + math.copysign(OVERLAP_MM, nearest)
            here = left[np.abs(left @ aside - row) < ROW_MM]
            level = 0.0
            if len(left) >= before:  # in vain: cut it where it is, beside the mark's level, and then go on as before
                level = min((here @ across).tolist(), key=abs)
            before = math.inf if level else len(left)
            depth = here @ ahead
            start = mark + row * aside + level * across
            yield from self._snip_through(start, float(depth.min()), float(depth.max()) + EDGE_MM)
            if self._view.steps_done > done:
                return
        raise Lost("the tissue is not cut through")

    def _snip_through(self, place: Array, nearest: float, farthest: float) -> Movement:
        """One row of snips, a little further each time, from ``nearest`` to ``farthest`` mm ahead of ``place``.

        Where something rigid is in the way the row is moved a little aside, for the blades are open as far, and ends
        before it.
        """
        tool, done = self._scissors, self._view.steps_done
        ahead, aside = self._home[tool].matrix[:, 0], self._home[tool].matrix[:, 1]
        behind = nearest + SNIP_MM - STAND_OFF_MM
        starts = [place + shift * aside + behind * ahead for shift in SHIFTS_MM]
        free = [behind + self._view.free_mm(start, ahead, farthest - behind) for start in starts]
        best = int(np.argmax(free))
        if free[best] <= nearest:
            raise Lost("something rigid is in the way of the scissors")
        place, farthest = place + SHIFTS_MM[best] * aside, free[best]
        deep = min(nearest + SNIP_MM, farthest)
        yield from self._reach(tool, place + deep * ahead)
        while True:
            yield from self._jaws(tool, 1.0)
            yield from self._jaws(tool, 0.0)
            if self._view.steps_done > done or deep >= farthest:
                break
            deep = min(deep + SNIP_MM, farthest)
            yield from self._glide(tool, Rigid(place + deep * ahead, self._pose[tool].quaternion), 0.5)
        yield from self._back(tool)

    def _feel(self, step: Step) -> Movement:
        """Come in through the portal, go straight to a structure until it is felt, and back to the portal."""
        tool, done = self._probe, self._view.steps_done
        spec = self._task.scene.instrument[tool]
        portal = self._view.place(np.array(spec.portal_mm or spec.home_mm))
        for _ in range(TRIES):
            place = self._view.in_sight(step.structure, portal)
            if place is None:
                raise Lost(f"no straight way leads to the {step.structure}")
            place = place + self._miss()
            yield from self._go(tool, portal)
            wander = self._hand.wander_mm
            self._hand = replace(self._hand, wander_mm=INSIDE * wander)
            yield from self._go(tool, place - NEAR_MM * unit(place - portal), 0.5)
            self._hand = replace(self._hand, wander_mm=0.0)
            yield from self._press(tool, unit(place - portal))
            self._hand = replace(self._hand, wander_mm=INSIDE * wander)
            yield from self._go(tool, portal, 0.5)
            self._hand = replace(self._hand, wander_mm=wander)
            if self._view.steps_done > done:
                return
        raise Lost(f"the {step.structure} is not found")

    def _press(self, tool: int, way: Array) -> Movement:
        """Feel for something along ``way``; who aims badly stops late, too."""
        for _ in range(math.ceil(2.0 * NEAR_MM / FEEL_MM)):
            here = self._pose[tool].position
            if self._view.touched(tool):
                yield from self._go(tool, here + LATE * self._hand.aim_error_mm * way, FEEL_PACE)
                return
            yield from self._go(tool, here + FEEL_MM * way, FEEL_PACE)

    def _go(self, tool: int, place: Array, pace: float = 1.0) -> Movement:
        """Come to ``place`` as it is turned now."""
        yield from self._glide(tool, Rigid(place, self._pose[tool].quaternion), pace)

    def _reach(self, tool: int, place: Array) -> Movement:
        """Come to ``place`` the way the instrument points at home."""
        turned = self._home[tool].quaternion
        ahead = self._home[tool].matrix[:, 0]
        yield from self._glide(tool, Rigid(place - STAND_OFF_MM * ahead, turned))
        here = self._pose[tool]
        wander, self._hand = self._hand, replace(self._hand, wander_mm=0.0)
        yield from self._glide(tool, Rigid(place, here.quaternion), 0.5)
        self._hand = wander

    def _back(self, tool: int) -> Movement:
        here = self._pose[tool]
        yield from self._glide(tool, Rigid(here.position - STAND_OFF_MM * here.matrix[:, 0], here.quaternion))

    def _miss(self) -> Array:
        return self._rng.normal(0.0, 1.0, 3) * self._hand.aim_error_mm
