"""Whether what is in a scene lies where an exercise is possible; what needs no scene is told when the task is read.

Only what is certainly a slip is refused: a tissue inside of another, an instrument that waits or comes in through bone,
a place so far away that nothing of the task is there.
"""

from __future__ import annotations

import itertools

import numpy as np

from trainer.anatomy.structures import structures
from trainer.config import ConfigError
from trainer.curriculum import Step
from trainer.geometry import Array, Rigid
from trainer.interactions.region import Region
from trainer.interactions.world import World

#: The steps whose ``place_mm`` is a mark on their structure, or where it is pulled to.
MARKED = ("grasp", "pull", "cut")
#: Kinds of structures that no instrument lies in.
HARD = ("bone", "cartilage")
#: A mark is at most so far from its structure, and a portal from the elements of the task. Assumed: half of what a knee
#: is wide; what lies beyond is a slip of the pen or of the unit.
FAR_MM = 50.0
#: A vessel's end may be in touch with another's; only what is deeper inside of it is refused. Assumed.
TOUCH_MM = 1e-6


def check(world: World) -> None:
    """Raises ConfigError for a scene in which the task cannot be practised; ``world`` is at rest."""
    _vessels_apart(world)
    region = world.region
    if region is None:
        return
    for i, spec in enumerate(world.task.scene.instrument):
        key = f"'scene.instrument[{i}]"
        _outside_of_bone(region, np.array(spec.home_mm), f"{key}.home_mm'")
        if spec.portal_mm is not None:
            portal = np.array(spec.portal_mm)
            _outside_of_bone(region, portal, f"{key}.portal_mm'")
            away = _from_block(region, portal)
            if away > FAR_MM:
                raise ConfigError(f"{key}.portal_mm' is {away:.0f} mm from the anatomy; expected at most {FAR_MM:g}")
    for i, step in enumerate(world.task.step):
        if step.kind in MARKED:
            _near_its_structure(region, step, f"'step[{i}].place_mm'")


def _vessels_apart(world: World) -> None:
    """No wall of one vessel lies within the outer wall of another."""
    if world.tissue is None:
        return
    for a, b in itertools.permutations(world.tissue.vessels, 2):
        away = a.mesh.rest - np.array(b.spec.cut_edge_mm)
        along = away @ b.axis
        across = np.linalg.norm(away - along[:, None] * b.axis, axis=1)
        inside = (along > TOUCH_MM) & (along < b.spec.length_mm - TOUCH_MM)
        if (inside & (across < b.outer_radius_mm - TOUCH_MM)).any():
            raise ConfigError(
                f"vessel '{a.spec.name}' lies in vessel '{b.spec.name}': change 'cut_edge_mm' or 'axis' of one of them"
            )


def _outside_of_bone(region: Region, place: Array, key: str) -> None:
    structure = region.structure_at(_in_layer(region, place))
    if structure and structure not in region.tissue and structures()[structure].kind in HARD:
        raise ConfigError(f"{key} lies in the {structure}; expected a place outside of bone and cartilage")


def _from_block(region: Region, place: Array) -> float:
    """How far (mm) a place (3,) is from the box of all elements of the task; 0 within."""
    spacing = np.array(region.volume.spacing_mm)
    low = region.corner - 0.5 * spacing
    high = low + np.array(region.labels.shape) * spacing
    return float(np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0.0)))


def _near_its_structure(region: Region, step: Step, key: str) -> None:
    at = _in_layer(region, np.array(step.place_mm))
    away = float(np.linalg.norm(region.rest(region.elements[step.structure]) - at, axis=1).min())
    if away > FAR_MM:
        raise ConfigError(
            f"{key} is {away:.0f} mm from the {step.structure}; expected at most {FAR_MM:g}, step '{step.name}'"
        )


def _in_layer(region: Region, place: Array) -> Array:
    """A place (3,) as the region meets it."""
    return region.in_layer(Rigid(place, Rigid.identity().quaternion)).position
