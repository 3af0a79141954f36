"""A needle led by its tip, at the wall of a vessel."""

from __future__ import annotations

import numpy as np
from performing import one_drive

from trainer import scene
from trainer.curriculum import Task
from trainer.drivers.hand_motion import needle_pose
from trainer.events import Event
from trainer.geometry import Array, Rigid
from trainer.poses import ToolPoses

LEFT, RIGHT = 0, 1
TASK = one_drive()
VESSEL = TASK.scene.vessel[0]


class Needle:
    """A scene whose needle is led by its tip: where it is to be, and how it lies."""

    def __init__(self, task: Task = TASK) -> None:
        self.scene = scene.build(task)
        view = self.scene.view()
        self.point, self.normal = view.look("A", 0.0, 0.6, "outer")
        self.axis = view.vessel_axis["A"]
        self._tool_from_needle = self.scene.world.needle_pose.inverse() @ view.poses.world_from_tool(RIGHT)

    def lying(self, tip: Array, steep_deg: float) -> Rigid:
        """The needle with its tip at ``tip``, which points along the vessel and down into it at this angle."""
        steep = np.radians(steep_deg)
        heading = np.cos(steep) * self.axis - np.sin(steep) * self.normal
        upright = np.cos(steep) * self.normal + np.sin(steep) * self.axis
        assert self.scene.world.needle is not None
        return needle_pose(tip, heading, upright, 0.0, self.scene.world.needle.radius)

    def to(self, pose: Rigid, seen: bool = True) -> tuple[Event, ...]:
        """One tick."""
        tool, home = pose @ self._tool_from_needle, self.scene.home
        position, quaternion = home.position.copy(), home.quaternion.copy()
        position[RIGHT], quaternion[RIGHT] = tool.position, tool.quaternion
        return self.scene.step(ToolPoses(position, quaternion, home.closure, np.array([True, seen])))

    def touch(self, steep_deg: float) -> Rigid:
        """Bring the tip along itself to the wall, 3 µm a tick, until it touches."""
        pose = self.lying(self.point, steep_deg)
        heading = pose.rotate(np.array([1.0, 0.0, 0.0]))
        for k in range(200):
            self.to(Rigid(self.point + (0.003 * k - 0.3) * heading, pose.quaternion))
            if self.scene.world.contact is not None:
                return self.scene.world.needle_pose
        raise AssertionError("the tip does not come to the wall")
