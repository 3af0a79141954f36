"""A probe: a shaft that ends in a short tip, for touching.

In the instrument's frame the origin is the middle of the tip's round end and +x points out of it. All measures are
assumed, as those of :mod:`trainer.instruments.arthroscopic`.
"""

from __future__ import annotations

import numpy as np

from trainer.geometry import Array, Rigid
from trainer.instruments.arthroscopic import cylinder
from trainer.instruments.forceps import Blade

#: Radius and length of the tip, and of the part of the shaft that is shown, mm.
TIP_RADIUS_MM, TIP_MM = 0.8, 6.0
SHAFT_RADIUS_MM, SHAFT_MM = 1.5, 80.0


def parts() -> tuple[Blade, ...]:
    """Tip and shaft, in the order of :func:`part_poses`."""
    return (
        cylinder("tip", TIP_RADIUS_MM, -TIP_MM, TIP_RADIUS_MM),
        cylinder("shaft", SHAFT_RADIUS_MM, -SHAFT_MM, -TIP_MM),
    )


def part_poses(world_from_tool: Rigid, closure: float) -> tuple[Array, Array]:
    """Where tip and shaft are: positions (2, 3) mm and quaternions (2, 4) wxyz. There is nothing to close."""
    return np.tile(world_from_tool.position, (2, 1)), np.tile(world_from_tool.quaternion, (2, 1))
