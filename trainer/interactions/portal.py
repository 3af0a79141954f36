"""A portal: the small hole in the skin that an instrument's shaft goes through and turns about."""

from __future__ import annotations

import math

import numpy as np

from trainer.events import PortalEnter, PortalExit
from trainer.geometry import Array, Rigid, cross, quaternion_multiply, unit
from trainer.interactions.world import World

#: A tip is in when it is deeper than the portal, and out again when it is so far outside of it, mm: a trembling tip
#: goes through once. Assumed.
OUT_MM = 1.0
#: Nearer to the portal than this, mm, the shaft keeps the device's direction: from there none follows. Assumed.
NEAR_MM = 1.0


def pivot(world: World, tool: int, time_s: float) -> None:
    """Turn an instrument whose tip is in such that its shaft goes through the portal; tell when it goes in and out.

    The tip is where the device has it, and so is the turn about the shaft. Depth counts from the portal towards the
    scene's origin.
    """
    spec, jaw = world.task.scene.instrument[tool], world.jaws[tool]
    if spec.portal_mm is None:
        return
    portal = np.array(spec.portal_mm)
    way = jaw.pose.position - portal
    deep = float(way @ unit(-portal))
    if deep > 0.0 and not jaw.inside:
        jaw.inside = True
        world.emit(PortalEnter, time_s, world.tools[tool], point=world.place_in_world(jaw.pose.position))
    elif deep < -OUT_MM and jaw.inside:
        jaw.inside = False
        world.emit(PortalExit, time_s, world.tools[tool], point=world.place_in_world(jaw.pose.position))
    if jaw.inside and math.hypot(*way.tolist()) > NEAR_MM:
        jaw.pose = Rigid(
            jaw.pose.position, quaternion_multiply(_turn(jaw.pose.matrix[:, 0], unit(way)), jaw.pose.quaternion)
        )


def _turn(a: Array, b: Array) -> Array:
    """The shortest rotation (4,) that takes the unit vector ``a`` to ``b``."""
    real = 1.0 + float(a @ b)
    if real < 1e-9:  # opposite: half a turn about anything across
        across = unit(cross(a, np.eye(3)[int(np.argmin(np.abs(a)))]))
        return np.concatenate([[0.0], across])
    q = np.concatenate([[real], cross(a, b)])
    return np.asarray(q / np.linalg.norm(q))
