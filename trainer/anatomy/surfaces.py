"""Closed surfaces of labelled structures: marching cubes over the smoothed label, then decimation.

Marching cubes (Lorensen and Cline 1987; scikit-image's after Lewiner et al. 2003) over a label as it is gives stairs.
Smoothed a little the label has none, but loses volume where it is thin; so the level is chosen at which the surface
encloses what the voxels do. Decimation joins vertices where the surface loses least by it (Garland and Heckbert 1997,
quadrics; fast-simplification).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.anatomy.label_volume import LabelVolume
from trainer.geometry import Array

#: Of ten triangles of marching cubes one is kept: a smooth surface needs no more. Assumed.
KEPT = 0.1
#: Structures with fewer triangles keep them all.
FEWEST_TRIANGLES = 500
#: Width of the smoothing in voxels: where stairs are gone and decimated surfaces of a real knee all stay closed
#: (at 0.5 half of them do not).
SMOOTHING = 0.7
RIM = 4  # voxels of outside around a structure's box, beyond which the smoothing does not reach
#: How hard fast-simplification tries, from its usual to what only joins flat neighbours.
EFFORTS = (7.0, 5.0, 3.0)
#: Part of the volume by which smoothing or decimation may be off before it is done more gently; 1 % is promised.
VOLUME_TOLERANCE = 0.008


@dataclass(frozen=True)
class Surface:
    """A closed surface; triangles turn counterclockwise seen from outside."""

    points: Array  # (n, 3) mm, the volume's frame
    triangles: np.ndarray  # (f, 3) int32

    def volume_ml(self) -> float:
        """The volume inside, by the divergence theorem; negative where normals point inwards."""
        a, b, c = (self.points[self.triangles[:, k]] for k in range(3))
        return float(np.sum(np.cross(a, b) * c)) / 6e3


def surface_of(volume: LabelVolume, label: int, kept: float = KEPT) -> Surface:
    """The surface of all voxels with a label, with about the fraction ``kept`` of marching cubes' triangles.

    Raises ValueError when no voxel has the label.
    """
    from scipy.ndimage import find_objects, gaussian_filter

    boxes = find_objects(volume.labels, max_label=label)
    if len(boxes) < label or boxes[label - 1] is None:
        raise ValueError(f"no voxel has the label {label}")
    box = boxes[label - 1]
    inside = np.pad((volume.labels[box] == label).astype(np.float32), RIM)
    corner = np.array([s.start - RIM for s in box])
    wanted = float(inside.sum(dtype=np.float64)) * volume.voxel_ml
    smooth = _enclosing(gaussian_filter(inside, SMOOTHING), corner, volume.spacing_mm, wanted)
    surface = smooth or _contour(inside, 0.5, corner, volume.spacing_mm)
    assert surface is not None  # zeros around ones
    return _decimated(surface, kept)


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each edge of ``triangles`` (f, 3) is run through exactly once in each direction."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    n = int(triangles.max()) + 1
    there = np.sort(edges[:, 0] * n + edges[:, 1])
    back = np.sort(edges[:, 1] * n + edges[:, 0])
    return np.array_equal(there, back) and bool(np.all(np.diff(there) > 0))


def _enclosing(
    density: np.ndarray, corner: np.ndarray, spacing_mm: tuple[float, float, float], wanted_ml: float
) -> Surface | None:
    """The contour that encloses ``wanted_ml``, by a secant from two levels; None where none is found."""
    first, second = (_contour(density, level, corner, spacing_mm) for level in (0.5, 0.45))
    if first is None or second is None:
        return None
    step = (wanted_ml - first.volume_ml()) / (second.volume_ml() - first.volume_ml())
    found = _contour(density, 0.5 - 0.05 * step, corner, spacing_mm)
    off = np.inf if found is None else abs(found.volume_ml() / wanted_ml - 1.0)
    return found if off < VOLUME_TOLERANCE else None


def _contour(
    density: np.ndarray, level: float, corner: np.ndarray, spacing_mm: tuple[float, float, float]
) -> Surface | None:
    """Marching cubes; None where ``density`` does not pass through ``level``."""
    from skimage.measure import marching_cubes

    if not density.min() < level < density.max():
        return None
    points, triangles, _, _ = marching_cubes(density, level, gradient_direction="ascent", allow_degenerate=False)
    return Surface((np.asarray(points, dtype=np.float64) + corner) * spacing_mm, triangles.astype(np.int32))


def _decimated(surface: Surface, kept: float) -> Surface:
    """Fewer triangles, or all where fewer would not leave the surface closed and its volume as it was."""
    import fast_simplification

    wanted = max(round(kept * len(surface.triangles)), FEWEST_TRIANGLES)
    if wanted >= len(surface.triangles):
        return surface
    volume = surface.volume_ml()
    for effort in EFFORTS:
        points, triangles = fast_simplification.simplify(
            surface.points, surface.triangles, target_count=wanted, agg=effort
        )
        fewer = Surface(np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int32))
        if is_closed(fewer.triangles) and abs(fewer.volume_ml() / volume - 1.0) < VOLUME_TOLERANCE:
            return fewer
    return surface
