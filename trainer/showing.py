"""How a recording shows a region of the anatomy: closed surfaces of what is rigid, the elements of what moves, and the
three pictures of Gibson et al. 1998, section 4.2.4: surface, section and volume."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from trainer.anatomy.label_volume import LabelVolume
from trainer.anatomy.structures import shown, structures
from trainer.anatomy.surfaces import surface_of
from trainer.geometry import Array, Rigid
from trainer.interactions.region import Region
from trainer.pictures.camera import Camera
from trainer.pictures.pictures import Plane, section, see_through, surface
from trainer.pictures.solid import look_of, solid_of
from trainer.sinks.surface import Cloud, Frame, Surface

#: Opacity (0 … 255) of bone, which is in the way, and of what lies on it; assumed.
BONE, SOFT = 110, 200
#: Pixels along a picture's sides, and the angle that it shows; assumed.
SIDE, ANGLE_DEG = 200, 40.0


def clouds(region: Region, world_from_scene: Rigid) -> tuple[Cloud, ...]:
    """The movable structures, an element a ball; of a drawn section the rigid ones too."""
    radius = 0.5 * min(region.volume.spacing_mm)
    found = []
    for name, structure in structures().items():
        places = region.corner + np.argwhere(region.labels == structure.number) * np.array(region.volume.spacing_mm)
        if len(places) and (name in region.elements or region.flat >= 0):
            fixed = None if name in region.elements else world_from_scene.apply(places)
            found.append(Cloud(f"tissue/{name.replace(' ', '_')}", radius, (*structure.colour, 255), fixed))
    return tuple(found)


def surfaces(region: Region, world_from_scene: Rigid) -> tuple[Surface, ...]:
    """The rigid structures of a block, closed where its sides cut them; bone is see-through."""
    if region.flat >= 0:
        return ()
    place = Rigid(region.corner, np.array([1.0, 0.0, 0.0, 0.0]))
    volume = LabelVolume(region.labels, region.volume.spacing_mm, place)
    present = np.bincount(region.labels.reshape(-1), minlength=256) > 0
    found = []
    for name, structure in structures().items():
        if present[structure.number] and name not in region.elements:
            made = surface_of(volume, structure.number)
            rgba = (*structure.colour, BONE if structure.kind == "bone" else SOFT)
            points = world_from_scene.apply(region.corner + made.points)
            found.append(Surface(f"anatomy/{name.replace(' ', '_')}", made.triangles, rgba, points))
    return tuple(found)


def moving(region: Region) -> tuple[Array, ...]:
    """Where the elements of each movable structure are, (n, 3) mm of the scene, in the order of :func:`clouds`."""
    return tuple(region.places(region.elements[name]) for name in structures() if name in region.elements)


def eye(region: Region, towards: Array) -> tuple[Array, Array]:
    """From where a recording looks, and at what, (3,) mm of the scene: so far ``towards`` (3,) that all shows."""
    size = np.array(region.labels.shape) * region.volume.spacing_mm
    middle = region.corner + 0.5 * size
    return middle + 1.1 * float(size.max()) * towards, middle


def pictures(region: Region, scene_from_world: Rigid, towards: Array) -> partial[Mapping[str, np.ndarray]] | None:
    """What draws a frame's pictures, in any process: it has a copy of the labels. None for a drawn section."""
    if region.flat >= 0:
        return None
    rigid = region.labels.copy()
    numbers = [structures()[name].number for name in structures() if name in region.elements]
    rigid[np.isin(rigid, numbers)] = 0
    return partial(_draw, rigid, region.volume.spacing_mm, region.corner, tuple(numbers), scene_from_world, towards)


def _draw(
    rigid: np.ndarray,
    spacing_mm: tuple[float, float, float],
    corner: Array,
    numbers: tuple[int, ...],
    scene_from_world: Rigid,
    towards: Array,
    frame: Frame,
) -> Mapping[str, np.ndarray]:
    """Surface, section and volume, (height, width, 3) uint8 each, with what moves entered where it is now."""
    labels, h = rigid.copy(), np.array(spacing_mm)
    for number, places in zip(numbers, frame.clouds, strict=True):
        index = np.floor((scene_from_world.apply(places) - corner) / h + 0.5).astype(int)
        i, j, k = index[np.all((index >= 0) & (index < labels.shape), axis=1)].T
        free = labels[i, j, k] == 0
        labels[i[free], j[free], k[free]] = number
    solid = solid_of(labels, spacing_mm, look_of(shown()))
    # The scene's origin is the middle of what the task is about.
    target, up = -corner, np.array([0.0, 1.0, 0.0])
    far = float((np.array(labels.shape) * h).max())
    camera = Camera(target + far * towards, target, up, ANGLE_DEG, SIDE, SIDE)
    plane = Plane(target, np.array([1.0, 0.0, 0.0]), -up, far / SIDE, SIDE, SIDE)
    return {
        "surface": surface(solid, camera)[0],
        "section": section(solid, plane),
        "volume": see_through(solid, camera),
    }
