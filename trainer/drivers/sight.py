"""What a scripted hand reads off the scene: where needle, holes and walls are, and which ways lead where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.curriculum import Task, VesselSpec
from trainer.geometry import Array, Rigid, cross, unit
from trainer.view import HoleView, View

ASIDE_DEG = 40.0  # at most this far from the vessel's axis lies the needle's plane
CLEAR_PAST_MM = 0.06  # distance at which the needle passes the other end of the vessel
CLEAR_REAR_MM = 0.1  # … and at which its rear end has left a vessel
RISE = 0.4  # how steeply the thread is pulled away from the vessels


class Lost(Exception):
    """What the hand meant to do is no longer possible: it stops."""


@dataclass
class Sight:
    """The scene as the hand sees it at this tick."""

    task: Task
    view: View
    needle_length: float  # mm
    needle_radius: float  # mm, of its circle

    def holder(self) -> int:
        if not self.view.needle_holders:
            raise Lost("nobody holds the needle")
        return self.view.needle_holders[0]

    def needle(self) -> Rigid:
        if self.view.world_from_needle is None:
            raise Lost("there is no needle")
        return self.view.world_from_needle

    def needle_from_tool(self, tool: int) -> Rigid:
        return self.needle().inverse() @ self.view.poses.world_from_tool(tool)

    def hole(self, vessel: str, wall: str) -> HoleView | None:
        """The hole of this pass: the last one made there that the needle is in."""
        inside = [
            h for h in self.view.holes if h.vessel == vessel and h.wall == wall and h.arc_mm <= self.needle_length
        ]
        return inside[-1] if inside else None

    def arc_in(self, vessel: str, wall: str) -> float:
        hole = self.hole(vessel, wall)
        return hole.arc_mm if hole else -math.inf

    def needle_is_through(self) -> bool:
        return all(h.arc_mm > self.needle_length for h in self.view.holes)

    def rear_is_clear(self) -> bool:
        """Whether the needle's rear end is outside of every vessel, by a wire's thickness and more."""
        phi = self.needle_length / self.needle_radius
        rear = self.needle().apply(self.needle_radius * np.array([-math.sin(phi), 1.0 - math.cos(phi), 0.0]))
        for v in self.task.scene.vessel:
            origin, _ = self.vessel_origin(v.name)
            along = float((rear - origin) @ self.view.vessel_axis[v.name])
            aside = math.dist(rear - origin, along * self.view.vessel_axis[v.name])
            if -CLEAR_REAR_MM < along < v.length_mm and aside < 0.5 * v.outer_diameter_mm + CLEAR_REAR_MM:
                return False
        return True

    def task_vessel(self, name: str) -> VesselSpec:
        return next(v for v in self.task.scene.vessel if v.name == name)

    def aside(self, bite: float) -> float:
        """Angle (rad) between the needle's plane and the vessel's axis that takes the needle past the other end."""
        ends = self.task.scene.vessel
        if len(ends) < 2:
            return math.radians(ASIDE_DEG)
        gap = math.dist(ends[0].cut_edge_mm, ends[1].cut_edge_mm)
        radius = 0.5 * max(v.outer_diameter_mm for v in ends)
        return min(math.radians(ASIDE_DEG), math.atan2(radius + CLEAR_PAST_MM, bite + gap))

    def vessel_origin(self, vessel: str) -> tuple[Array, Array]:
        """The centre of the cut edge and a point of the wall at 12 o'clock, both as seen now."""
        top, _ = self.view.look(vessel, 0.0, 0.0, "outer")
        bottom, _ = self.view.look(vessel, 180.0, 0.0, "outer")
        return 0.5 * (top + bottom), top

    def outward(self, vessel: str, point: Array) -> Array:
        origin, _ = self.vessel_origin(vessel)
        axis = self.view.vessel_axis[vessel]
        out = point - origin
        return unit(out - (out @ axis) * axis)

    def away_from_vessels(self) -> Array:
        """From the axis of the vessels outwards, towards the needle."""
        vessel = self.task.scene.vessel[0].name
        return self.outward(vessel, self.needle().position)

    def across(self, vessel: str) -> Array:
        """From a vessel's hole across the cut to the other end, rising: pulled that way a thread closes the gap."""
        stitched = [h.point for h in self.view.holes if h.vessel == vessel and h.wall == "outer"]
        if not stitched:
            raise Lost("the thread is not in the wall")
        return unit(RISE * self.outward(vessel, stitched[-1]) - self.view.vessel_axis[vessel])

    def heading_in(self, vessel: str, normal: Array, steep: float, aside: float) -> tuple[Array, Array]:
        """Tangent and inward direction of a needle that dives at ``steep`` rad and turns towards the cut end."""
        level = self.level(vessel, normal, -1.0, aside)
        s, c = math.sin(steep), math.cos(steep)
        return c * level - s * normal, s * level + c * normal

    def heading_out(self, vessel: str, normal: Array, steep: float, aside: float) -> tuple[Array, Array]:
        """The same for a needle that comes in by the cut end and rises at ``steep`` rad through the wall."""
        level = self.level(vessel, normal, 1.0, aside)
        s, c = math.sin(steep), math.cos(steep)
        return c * level + s * normal, c * normal - s * level

    def level(self, vessel: str, normal: Array, sign: float, aside: float) -> Array:
        """A direction in the wall's tangent plane, ``aside`` rad from the vessel's axis."""
        axis = sign * self.view.vessel_axis[vessel]
        along = unit(axis - (axis @ normal) * normal)
        return math.cos(aside) * along + math.sin(aside) * cross(normal, along)


def steepest_from_lumen(bite: float, aside: float, radius: float, wall: float, needle: float) -> float:
    """The steepest angle in degrees at which a needle inside a lumen can meet the wall at ``bite`` mm from its end.

    The shaft must leave by the open end without touching the opposite wall: where the circle of radius ``needle``
    through the tip reaches the cut plane, it must lie within three quarters of the lumen's radius.
    """
    lumen = radius - wall
    for degrees in range(90, 20, -1):
        steep = math.radians(degrees)
        run = bite / math.cos(aside)
        sine = math.sin(steep) - run / needle
        if sine < -1.0:
            continue
        depth = wall + needle * (math.sqrt(1.0 - sine * sine) - math.cos(steep))
        if math.hypot(radius - depth, run * math.sin(aside)) <= 0.75 * lumen:
            return float(degrees)
    return 20.0
