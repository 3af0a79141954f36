"""What a volume file holds: its axes, its labels as structures, which knee it is, and what is missing or wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainer.anatomy import label_map, landmarks
from trainer.anatomy.label_map import IGNORED, LabelMap
from trainer.anatomy.structures import structures
from trainer.anatomy.volume_file import FileVolume
from trainer.config import ConfigError
from trainer.geometry import Array

#: A scan of a knee is at least and at most so long along each axis: a part of the joint, and a leg. Assumed; what lies
#: beyond has mixed up mm with µm or m.
LEAST_MM, MOST_MM = 20.0, 1000.0


@dataclass(frozen=True)
class Region:
    """All voxels with one label."""

    voxels: int
    volume_ml: float
    centre_mm: Array  # (3,) LPS


def regions(file: FileVolume) -> dict[int, Region]:
    """The labels that occur in a file, 0 apart."""
    from scipy.ndimage import find_objects

    voxel_ml = float(np.prod(file.spacing_mm)) * 1e-3
    found = {}
    for label, box in enumerate(find_objects(file.values), 1):
        if box is not None:
            at = np.argwhere(file.values[box] == label)
            index = at.mean(axis=0) + [s.start for s in box]
            centre = file.lps_from_index[:3, :3] @ index + file.lps_from_index[:3, 3]
            found[label] = Region(len(at), len(at) * voxel_ml, centre)
    return found


def check(file: FileVolume, found: Mapping[int, Region], given: LabelMap) -> None:
    """Raises ConfigError when no knee is of the file's size, the map does not fit its labels, or its structures lie as
    in no knee."""
    check_size(file)
    if not found:
        raise ConfigError(f"{file.path}: holds no label: all elements are 0")
    label_map.check_against(given, set(found), file.path)
    landmarks.check(_by_name(found, given), given.side, file.path)


def check_size(file: FileVolume) -> None:
    """Raises ConfigError for a volume that is smaller or larger than a scan of a knee along one of its axes."""
    size = np.array(file.values.shape) * file.spacing_mm
    if size.min() < LEAST_MM or size.max() > MOST_MM:
        sides = " × ".join(f"{mm:.4g}" for mm in size)
        raise ConfigError(
            f"{file.path}: {sides} mm is not the size of a knee's scan, {LEAST_MM:g} to {MOST_MM:g} mm along each "
            "axis: is its spacing in mm?"
        )


def recognised(file: FileVolume, found: Mapping[int, Region]) -> LabelMap | None:
    """The shipped label map that names all of a file's labels and makes a knee of them; None where not exactly one."""
    fitting = []
    for given in label_map.shipped():
        if found and set(found) <= set(given.labels):
            present = {label: name for label, name in given.labels.items() if label in found}
            try:
                landmarks.check(_by_name(found, given), given.side, file.path)
            except ConfigError:
                continue
            fitting.append(LabelMap(given.path, present, given.side))
    return fitting[0] if len(fitting) == 1 else None


def side(found: Mapping[int, Region], given: LabelMap) -> landmarks.Side | None:
    """Which knee it is, as the bones tell."""
    return landmarks.side(_by_name(found, given))


def describe(file: FileVolume, given: LabelMap | None) -> dict[str, Any]:
    """All of it, ready for JSON; without a map the one that is recognised is taken."""
    found = regions(file)
    problems = []
    recognised_map = given is None
    if given is None:
        given = recognised(file, found)
        try:
            check_size(file)
        except ConfigError as error:
            problems.append(str(error))
        if given is None:
            problems.append(f"{file.path}: no shipped label map fits; say with --labels which label is which structure")
    else:
        try:
            check(file, found, given)
        except ConfigError as error:
            problems.append(str(error))
    names = given.labels if given else {}
    return {
        "path": file.path,
        "sha256": file.sha256,
        "shape": list(file.values.shape),
        "spacing_mm": file.spacing_mm.tolist(),
        "orientation": file.orientation,
        "lps_from_index": file.lps_from_index.tolist(),
        "label_map": given.path if given else None,
        "label_map_recognised": recognised_map and given is not None,
        "side": side(found, given) if given else None,
        "labels": [
            {
                "label": label,
                "structure": names.get(label),
                "voxels": region.voxels,
                "volume_ml": region.volume_ml,
                "centre_lps_mm": region.centre_mm.tolist(),
            }
            for label, region in found.items()
        ],
        "missing": [name for name in structures() if name not in {names.get(label) for label in found}],
        "problems": problems,
    }


def _by_name(found: Mapping[int, Region], given: LabelMap) -> dict[str, landmarks.Body]:
    return {
        name: landmarks.Body(found[label].centre_mm, found[label].volume_ml)
        for label, name in given.labels.items()
        if label in found and name != IGNORED
    }
