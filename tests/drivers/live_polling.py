"""A session's loop without a scene, for drivers of devices that tell their poses."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from waiting import PATIENCE_S

from trainer.drivers.live import LivePoses
from trainer.poses import ToolPoses

TOOLS = ("left", "right")
HOME = ToolPoses(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), np.eye(4)[[0, 0]], np.ones(2), np.ones(2, dtype=bool))
TICK_HZ = 200.0  # ten times slower than simulated devices, so that a busy machine can follow; the newest pose wins


class Polling:
    """Polls tick after tick until something is seen; holds that a lost instrument stays where it was."""

    def __init__(self, driver: LivePoses) -> None:
        self.driver = driver
        self.ticks = 0
        self.last = HOME

    def until(
        self, seen: Callable[[ToolPoses], bool], told: Callable[[dict[str, Any]], bool] | None = None
    ) -> ToolPoses:
        """Until ``seen`` holds for the poses and ``told``, asked now and then, for the summary."""
        ends = time.monotonic() + PATIENCE_S
        while True:
            poses = self.driver.poll(self.ticks, None)
            assert poses is not None
            self.driver.tick(None)
            self.ticks += 1
            lost = ~poses.valid
            np.testing.assert_array_equal(poses.position[lost], self.last.position[lost])
            np.testing.assert_array_equal(poses.closure[lost], self.last.closure[lost])
            self.last = poses
            if seen(poses) and (told is None or (self.ticks % 20 == 0 and told(self.summary()))):
                return poses
            assert time.monotonic() < ends, f"{self.summary()}"

    def summary(self) -> dict[str, Any]:
        return self.driver.summary()

    def reasons(self) -> str:
        """Why instruments were lost so far."""
        return "; ".join(loss["reason"] for loss in self.summary()["lost"])


def all_seen(poses: ToolPoses) -> bool:
    return bool(poses.valid.all())


def none_seen(poses: ToolPoses) -> bool:
    return not poses.valid.any()
