"""What the instruments do in one tick: the only thing that passes from a device to a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array, Rigid

#: Numbers per tool in a packed sample: x y z, qw qx qy qz, closure, valid.
NUMBERS_PER_TOOL = 9


@dataclass(frozen=True)
class ToolPoses:
    """The state of k instruments at one tick, in the order of the task's instruments.

    An instrument's frame has its origin between the tips of its jaws, +x out of the tips (distal),
    +y the direction in which the jaws open.
    """

    position: Array  # (k, 3) mm, world frame
    quaternion: Array  # (k, 4) wxyz, world_from_tool
    closure: Array  # (k,) 0 open … 1 closed
    valid: np.ndarray  # (k,) bool; False where the device did not see the tool at this tick
    #: (k,) why not, "" where it did; () from a device that gives no reasons. A packed row does not hold it: the event
    #: ``tracking_lost`` does, and a replay takes it from there.
    reason: tuple[str, ...] = ()

    def world_from_tool(self, tool: int) -> Rigid:
        return Rigid(self.position[tool], self.quaternion[tool])

    def why_lost(self, tool: int) -> str:
        return self.reason[tool] if self.reason else ""

    def pack(self) -> Array:
        """One row of ``9 k`` float64, as the log stores it."""
        valid = np.asarray(self.valid, dtype=np.float64)
        return np.concatenate([self.position, self.quaternion, self.closure[:, None], valid[:, None]], axis=1).ravel()

    @staticmethod
    def unpack(row: Array) -> ToolPoses:
        """The inverse of :meth:`pack`, without reasons. Raises ValueError when the length is no multiple of 9."""
        a = np.asarray(row, dtype=np.float64).reshape(-1, NUMBERS_PER_TOOL)
        return ToolPoses(a[:, 0:3].copy(), a[:, 3:7].copy(), a[:, 7].copy(), a[:, 8] != 0.0)
