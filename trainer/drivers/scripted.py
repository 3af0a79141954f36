"""Scripted hands that sew: they see where needle, walls, holes and thread are at this tick, and stitch.

What they intend (angle, bite, clock) comes from the profile, or from the task's marks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np

from trainer.curriculum import Step, Task
from trainer.drivers.hand_motion import along_arc, between, ease, needle_pose, round_vessel
from trainer.drivers.hands import TURN, Hands, Movement
from trainer.drivers.sight import Lost, Sight, steepest_from_lumen
from trainer.geometry import Array, Rigid, quaternion_from_axes, slerp, unit
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.view import View

PRESS = 0.25  # speed while the needle goes through a wall, as a share of the hand's speed
AIMED_MM = 0.03  # this near to the place aimed at the tip goes straight on
RUN_UP_MM = 0.4  # the tip's distance from the wall at which pressing begins
STEER_DEG = 50.0  # inside a lumen the needle is steered to this angle, to leave by the cut end
STAND_OFF_MM = 1.5  # an instrument's distance before it reaches for something
CLEAR_MM = 2.5  # distance from a vessel's axis while moving round it
BITE_DEPTH_MM = 2.0  # arc beyond a hole at which the other hand takes over
MOST_REAR_MM = 2.0  # so much further the needle is drawn at most until its rear end is out of the vessel
TAKE_AT_MM = 0.6  # distance from the tip at which the other hand takes the needle
TRIES = 5  # at catching needle or thread


class ScriptedHands(Hands):
    """The hands of a surgeon with needle and thread."""

    def __init__(self, hand: Hand, task: Task, home: ToolPoses, seed: int) -> None:
        super().__init__(hand, task, home, seed)
        self._see: Sight
        needle = task.scene.needle
        self._needle_length = needle.length_mm if needle else 0.0
        self._radius = needle.length_mm / math.radians(needle.arc_deg) if needle else 1.0

    def _begin(self, view: View) -> None:
        # One sight for the whole plan, which asks it at later ticks.
        self._see = Sight(self._task, view, self._needle_length, self._radius)

    def _look(self, view: View) -> None:
        self._see.view = view

    # --- the plan ------------------------------------------------------------------------------------------------

    def _perform(self) -> Movement:
        steps = self._task.step
        for index, step in enumerate(steps):
            yield from self._hesitate()
            if step.kind == "drive":
                following = steps[index + 1].kind if index + 1 < len(steps) else ""
                yield from self._drive(step, through=following != "withdraw")
            elif step.kind == "withdraw":
                yield from self._back_out()
            elif step.kind == "tail":
                yield from self._pull_tail(step)
            else:
                yield from self._approximate(step)
        yield from self._wait(0.5)

    def _drive(self, step: Step, through: bool) -> Movement:
        hand = self._hand
        driving = self._see.holder()
        if not self._see.needle_is_through():
            raise Lost("the needle is still in a hole")
        vessel = self._see.task_vessel(step.vessel)
        radius = 0.5 * vessel.outer_diameter_mm
        bite = (hand.bite_mm or step.bite_mm) + self._rng.normal(0.0, hand.aim_error_mm)
        bite = min(max(bite, 0.05), 0.6 * vessel.length_mm)
        clock = step.clock_deg if hand.clock_deg is None else hand.clock_deg
        clock += math.degrees(self._rng.normal(0.0, hand.aim_error_mm) / radius)
        angle = 90.0 if hand.entry_angle_deg is None else hand.entry_angle_deg
        angle = 90.0 - abs(90.0 - angle - self._rng.normal(0.0, hand.entry_angle_error_deg))
        aside = self._see.aside(bite)
        if step.direction == "out":
            angle = min(angle, steepest_from_lumen(bite, aside, radius, vessel.wall_mm, self._radius))
        if driving != 1 and through:
            yield from self._hand_over(driving)
            driving = self._see.holder()
        if step.direction == "in":
            rest, _ = self._see.view.look(step.vessel, clock, bite, "outer")
            yield from self._enter_from_outside(driving, step.vessel, clock, bite, math.radians(angle), aside)
            if through:
                yield from self._steer_out(step.vessel, driving, rest, aside)
        else:
            yield from self._enter_from_lumen(driving, step.vessel, clock, bite, math.radians(angle), aside)
        if through:
            yield from self._take_through(driving)

    def _enter_from_outside(
        self, tool: int, vessel: str, clock: float, bite: float, angle: float, aside: float
    ) -> Movement:
        point, normal = self._see.view.look(vessel, clock, bite, "outer")
        tangent, inward = self._see.heading_in(vessel, normal, angle, aside)
        offset = self._see.needle_from_tool(tool)
        start = needle_pose(point - RUN_UP_MM * tangent, tangent, inward, 0.0, self._radius)
        yield from self._carry_round(tool, start, offset, vessel)
        tip = self._see.needle().position
        travelled = 0.0
        while not self._see.hole(vessel, "outer"):
            _, normal = self._see.view.look(vessel, clock, bite, "outer")
            tangent, inward = self._see.heading_in(vessel, normal, angle, aside)
            tip = tip + self._press_step() * tangent
            travelled += self._press_step()
            if travelled > RUN_UP_MM + 1.5:
                raise Lost("the wall does not give way")
            self._pose[tool] = needle_pose(tip, tangent, inward, 0.0, self._radius) @ offset
            yield
        yield from self._follow_arc(tool, offset, lambda: bool(self._see.hole(vessel, "inner")), 1.0, PRESS)

    def _enter_from_lumen(
        self, tool: int, vessel: str, clock: float, bite: float, angle: float, aside: float
    ) -> Movement:
        target, normal = self._see.view.look(vessel, clock, bite, "outer")
        wall = self._see.task_vessel(vessel).wall_mm
        tangent, inward = self._see.heading_out(vessel, normal, angle, aside)
        offset = self._see.needle_from_tool(tool)
        contact = needle_pose(target - tangent * wall / math.sin(angle), tangent, inward, 0.0, self._radius)
        # The shaft of a needle at the wall leaves the lumen by the cut end, so the tip comes in along that same arc.
        back = (2.0 * angle + 0.9) * self._radius
        yield from self._carry_round(tool, along_arc(contact, -back, self._radius), offset, vessel)
        run = 0.5 * RUN_UP_MM
        yield from self._slide_along_arc(tool, contact, offset, -back, -run)
        here = self._see.needle()
        tip, turned = here.position, here.quaternion
        travelled = 0.0
        while not self._see.hole(vessel, "outer"):
            target, normal = self._see.view.look(vessel, clock, bite, "outer")
            tangent, inward = self._see.heading_out(vessel, normal, angle, aside)
            way = target - self._see.needle().position
            aim = unit(way) if way @ tangent > AIMED_MM else tangent
            tip = tip + self._press_step() * aim
            travelled += self._press_step()
            if travelled > run + wall / math.sin(angle) + 1.5:
                raise Lost("the wall does not give way")
            pose = needle_pose(tip, tangent, inward, 0.0, self._radius)
            # The wall may have moved since the way was planned: the needle turns to it on the run, and does not leap.
            pose = Rigid(tip, slerp(turned, pose.quaternion, min(1.0, travelled / run)))
            self._pose[tool] = pose @ offset
            yield
        yield from self._follow_arc(
            tool, offset, lambda: self._see.arc_in(vessel, "outer") >= BITE_DEPTH_MM, BITE_DEPTH_MM + 1.0, 1.0
        )

    def _steer_out(self, vessel: str, tool: int, rest: Array, aside: float) -> Movement:
        """Let the dent go back to where the wall was at ``rest``, pivot there towards the cut end, and advance."""
        hole = self._see.hole(vessel, "outer")
        if hole is None:
            raise Lost("the needle has left its hole")
        offset = self._see.needle_from_tool(tool)
        point, s0 = hole.point.copy(), hole.arc_mm
        normal = self._see.outward(vessel, rest)
        needle = self._see.needle().matrix
        phi = s0 / self._radius
        tangent = math.cos(phi) * needle[:, 0] - math.sin(phi) * needle[:, 1]
        steep0 = math.asin(min(1.0, max(-1.0, float(-tangent @ normal))))
        steep1 = min(steep0, math.radians(STEER_DEG))
        t, c = self._see.heading_in(vessel, normal, steep0, aside)
        # How the needle lies as it is now, off the way planned: no hand leaps.
        off = needle_pose(point, t, c, s0, self._radius).inverse() @ self._see.needle()
        seconds = max(2.0 * abs(steep1 - steep0) / TURN, (BITE_DEPTH_MM - s0) / (PRESS * self._hand.speed_mm_s))
        ticks = max(1, math.ceil(seconds / self._dt))
        for k in range(1, ticks + 1):
            u = ease(k / ticks)
            pivoted = min(1.0, 3.0 * u)
            t, c = self._see.heading_in(vessel, normal, steep0 + pivoted * (steep1 - steep0), aside)
            at = point + pivoted * (rest - point)
            way = needle_pose(at, t, c, s0 + u * (BITE_DEPTH_MM - s0), self._radius)
            self._pose[tool] = way @ between(off, Rigid.identity(), pivoted) @ offset
            yield

    def _take_through(self, driving: int) -> Movement:
        """The other hand takes the needle near its tip and draws it through, with the thread after it."""
        yield from self._hand_over(driving, TAKE_AT_MM)
        taking = 1 - driving
        offset = self._see.needle_from_tool(taking)
        yield from self._follow_arc(taking, offset, self._see.needle_is_through, 1.5 * self._needle_length, 0.5)
        # The rear end leaves the lumen by the cut end, as the needle did: lifted before, it would go through the wall.
        yield from self._follow_arc(taking, offset, self._see.rear_is_clear, MOST_REAR_MM, 0.5, at_end=None)
        clear = Rigid(self._see.needle().position + 3.0 * self._see.away_from_vessels(), self._see.needle().quaternion)
        yield from self._carry(taking, clear, offset)

    def _back_out(self) -> Movement:
        tool = self._see.holder()
        offset = self._see.needle_from_tool(tool)
        start = self._see.needle()
        moved = 0.0
        while self._see.view.holes:
            moved -= PRESS * self._hand.speed_mm_s * self._dt
            if moved < -self._needle_length - 1.0:
                raise Lost("the needle does not come out")
            self._pose[tool] = along_arc(start, moved, self._radius) @ offset
            yield
        away = self._see.away_from_vessels()
        here = self._see.needle()
        yield from self._carry(tool, Rigid(here.position + 1.0 * away, here.quaternion), offset)

    def _pull_tail(self, step: Step) -> Movement:
        tool = self._see.holder()
        last = [s.vessel for s in self._task.step if s.kind == "drive"][-1]
        away = self._see.across(last)
        aim = 0.75 * step.at_most_mm
        while self._see.view.tail_mm > aim:
            self._pose[tool] = Rigid(
                self._pose[tool].position + self._hand.speed_mm_s * self._dt * away, self._pose[tool].quaternion
            )
            yield

    def _approximate(self, step: Step) -> Movement:
        thread = self._see.view.thread
        if thread is None or self._see.view.tail_mm <= 0.0:
            raise Lost("there is no tail to take")
        tool = 1 - self._see.holder()
        link = self._task.scene.thread.link_mm if self._task.scene.thread else 1.0
        node = len(thread) - 1 - max(1, round(0.3 * self._see.view.tail_mm / link))
        turned = self._pose[tool].quaternion

        def place() -> Rigid:
            nodes = self._see.view.thread
            assert nodes is not None
            return Rigid(nodes[node], turned)

        yield from self._catch(tool, place, lambda: tool in self._see.view.thread_holders)
        first = next(s.vessel for s in self._task.step if s.kind == "drive")
        direction = self._see.across(first)
        pulled = 0.0
        done = self._see.view.steps_done
        while self._see.view.steps_done == done:
            stride = PRESS * self._hand.speed_mm_s * self._dt
            pulled += stride
            if pulled > 8.0 or tool not in self._see.view.thread_holders:
                raise Lost("the ends do not come together")
            self._pose[tool] = Rigid(self._pose[tool].position + stride * direction, self._pose[tool].quaternion)
            yield

    # --- movements -----------------------------------------------------------------------------------------------

    def _hand_over(self, giving: int, at_mm: float | None = None) -> Movement:
        """The other instrument takes the needle at ``at_mm`` from its tip (where a task holds it by default)."""
        taking = 1 - giving
        needle_spec = self._task.scene.needle
        assert needle_spec is not None
        arc = needle_spec.held_at * self._needle_length if at_mm is None else at_mm

        def place() -> Rigid:
            return self._grip(self._see.needle(), arc)

        yield from self._catch(taking, place, lambda: taking in self._see.view.needle_holders)
        yield from self._jaws(giving, 0.0)
        here = self._pose[giving]
        yield from self._glide(giving, Rigid(here.position - 2.0 * here.matrix[:, 0], here.quaternion))

    def _catch(self, tool: int, place: Callable[[], Rigid], caught: Callable[[], bool]) -> Movement:
        """Open, reach for ``place`` and close; look, and try again."""
        for _ in range(TRIES):
            yield from self._jaws(tool, 0.0)
            seen = place()
            yield from self._glide(tool, Rigid(seen.position - STAND_OFF_MM * seen.matrix[:, 0], seen.quaternion))
            yield from self._glide(tool, place(), 0.5)
            yield from self._jaws(tool, 1.0)
            if caught():
                return
        raise Lost("the jaws do not catch it")

    def _grip(self, needle: Rigid, arc: float) -> Rigid:
        """Where an instrument holds the needle at ``arc``: jaws pointing at the circle's centre, across the wire."""
        phi = arc / self._radius
        s, c = math.sin(phi), math.cos(phi)
        matrix = needle.matrix
        point = needle.apply(np.array([-self._radius * s, self._radius * (1.0 - c), 0.0]))
        inward = s * matrix[:, 0] + c * matrix[:, 1]
        return Rigid(point, quaternion_from_axes(inward, matrix[:, 2]))

    def _carry(self, tool: int, target: Rigid, offset: Rigid) -> Movement:
        """The needle, held by ``tool``, moves straight to ``target``."""
        yield from self._glide(tool, target @ offset)

    def _carry_round(self, tool: int, target: Rigid, offset: Rigid, vessel: str) -> Movement:
        """The needle moves to ``target`` with its tip well clear of the vessels."""
        yield from self._hesitate()
        axis = self._see.view.vessel_axis[vessel]
        origin, _ = self._see.vessel_origin(vessel)
        start = self._see.needle()
        way = round_vessel(start.position, target.position, origin, axis, CLEAR_MM)
        lengths = [float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(way)]
        total = sum(lengths) or 1.0
        done = 0.0
        for point, length in zip(way[1:], lengths, strict=True):
            done += length
            turned = between(start, target, done / total)
            pose = target if point is way[-1] else Rigid(point, turned.quaternion)
            yield from self._carry(tool, pose, offset)

    def _follow_arc(
        self,
        tool: int,
        offset: Rigid,
        until: Callable[[], bool],
        at_most: float,
        pace: float,
        at_end: str | None = "the needle does not go through",
    ) -> Movement:
        """Move the needle along its own circle ``until`` something is seen; past ``at_most`` mm give up."""
        start = self._see.needle()
        moved = 0.0
        while not until():
            moved += pace * self._hand.speed_mm_s * self._dt
            if moved > at_most:
                if at_end is None:
                    return
                raise Lost(at_end)
            self._pose[tool] = along_arc(start, moved, self._radius) @ offset
            yield

    def _slide_along_arc(self, tool: int, pose: Rigid, offset: Rigid, first: float, last: float) -> Movement:
        """The needle goes from ``first`` to ``last`` mm along the circle through ``pose``, easing in and out."""
        ticks = max(1, math.ceil(abs(last - first) / self._hand.speed_mm_s / self._dt))
        for k in range(1, ticks + 1):
            distance = first + ease(k / ticks) * (last - first)
            self._pose[tool] = along_arc(pose, distance, self._radius) @ offset
            yield

    def _press_step(self) -> float:
        return PRESS * self._hand.speed_mm_s * self._dt
