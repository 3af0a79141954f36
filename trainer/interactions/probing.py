"""Probing: what the tip of a probe touches, and how hard.

What is rigid presses back by the density field (Gibson et al. 1998, section 4.2.3), whose smoothing makes the tip as
good as a ball of a voxel or two. What deforms is pushed aside by a ball about the tip, and pulls at the elements that
the ball displaces with all that their links hold (the paper's section 6 asks for such a force as the next step).
"""

from __future__ import annotations

import numpy as np

from trainer.events import Probe
from trainer.interactions import giving_way
from trainer.interactions.region import LOOSE, Region
from trainer.interactions.world import World
from trainer.mechanics.density_field import force_at
from trainer.mechanics.elastic_relaxation import force_on
from trainer.mechanics.volume import tack, untack
from trainer.mechanics.volume_drag import drag

#: A force above this is a touch, and one below half of it is none any more, mN. Assumed: what a hand feels.
TOUCH_MN = 50.0
#: How far along the force's line the touched structure is looked for, in voxels: the reach of the field.
REACH_VOXELS = 3.0


def push(world: World, region: Region, tool: int) -> None:
    """Move the elements that are within the tip's ball to its surface, and hold them there for this movement."""
    touch = region.touch[tool]
    radius, pose = world.task.scene.instrument[tool].reach_mm, world.jaws[tool].pose
    untack(region.volume, region.state, touch.elements[~region.tacked[touch.elements]])
    touch.elements = touch.elements[:0]
    for structure, elements in region.elements.items():
        near = elements[(region.state.links[elements] & LOOSE) == LOOSE]
        way = region.places(near) - pose.position
        away = np.linalg.norm(way, axis=1)
        inside = away < radius
        if not inside.any():
            continue
        pushed, away = near[inside], away[inside, None]
        # An element in the very middle goes ahead.
        out = np.where(away > 0.0, way[inside] / np.where(away > 0.0, away, 1.0), pose.matrix[:, 0])
        drag(region.volume, region.state, pushed, pose.position + radius * out - region.rest(pushed))
        tack(region.state, pushed)
        touch.elements = np.concatenate([touch.elements, pushed])
        touch.soft = structure


def feel(world: World, region: Region, tool: int, time_s: float) -> None:
    """The force on the tip now; tell once for each touch what it meets, and when it presses too hard."""
    touch = region.touch[tool]
    tip = world.jaws[tool].pose.position
    rigid = np.zeros(3)
    if region.hard is not None:
        density = force_at(region.hard.density, region.hard.constants, tip, rigid, touch.outwards)
        if density == 0.0:
            touch.outwards[:] = 0.0
    soft = force_on(region.volume, region.state, touch.elements) if len(touch.elements) else np.zeros(3)
    touch.force_mN = float(np.linalg.norm(rigid + soft))
    region.press_max_mN = max(region.press_max_mN, touch.force_mN)
    softer = float(np.linalg.norm(soft)) >= float(np.linalg.norm(rigid))
    body = touch.soft if softer else _touched(region, tip, touch.outwards)
    if touch.force_mN > TOUCH_MN and body:
        region.inside[tool] = body
        if body not in touch.met:
            touch.met.add(body)
            world.emit(
                Probe, time_s, world.tools[tool], body=body, point=world.place_in_world(tip), force_mN=touch.force_mN
            )
    elif touch.force_mN < 0.5 * TOUCH_MN:
        region.inside[tool] = ""
        touch.met.clear()
    world.tissue_force_mN = max(world.tissue_force_mN, touch.force_mN)
    giving_way.check_limit(world, "probe_force", touch.force_mN, world.tools[tool], region.inside[tool], time_s)


def _touched(region: Region, tip: np.ndarray, outwards: np.ndarray) -> str:
    """The rigid structure that a tip meets against the field's direction; "" where there is none."""
    step = 0.5 * min(region.volume.spacing_mm)
    for k in range(round(2.0 * REACH_VOXELS) + 1):
        found = region.structure_at(tip - k * step * outwards)
        if found and found not in region.elements:
            return found
    return ""
