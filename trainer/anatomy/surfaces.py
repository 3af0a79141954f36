"""Closed surfaces of labelled structures: marching cubes, then decimation.

Marching cubes (Lorensen and Cline 1987; scikit-image's after Lewiner et al. 2003) puts the surface half-way between
the centre of a voxel of the structure and that of one outside; decimation joins vertices where the surface loses
least by it (Garland and Heckbert 1997, quadrics; fast-simplification).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.anatomy.label_volume import LabelVolume
from trainer.geometry import Array

#: Of ten triangles of marching cubes one is kept: facts that a picture shows need no more. Assumed.
KEPT = 0.1
#: Structures with fewer triangles keep them all.
FEWEST_TRIANGLES = 2000


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
    """The surface of all voxels with a label, with about the fraction ``kept`` of its triangles.

    Raises ValueError when no voxel has the label.
    """
    from skimage.measure import marching_cubes

    mask, corner = _inside(volume.labels, label)
    points, triangles, _, _ = marching_cubes(mask, 0.5, gradient_direction="ascent", allow_degenerate=False)
    points = (np.asarray(points, dtype=np.float64) + corner) * volume.spacing_mm
    return _decimated(Surface(points, triangles.astype(np.int32)), kept)


def _inside(labels: np.ndarray, label: int) -> tuple[np.ndarray, Array]:
    """The label's box with a rim of one voxel of outside, float32, and the place (3,) of its first voxel."""
    from scipy.ndimage import find_objects

    boxes = find_objects(labels, max_label=label)
    if len(boxes) < label or boxes[label - 1] is None:
        raise ValueError(f"no voxel has the label {label}")
    box = boxes[label - 1]
    mask = np.pad((labels[box] == label).astype(np.float32), 1)
    return mask, np.array([s.start - 1.0 for s in box])


def _decimated(surface: Surface, kept: float) -> Surface:
    """Fewer triangles, or all where fewer would not leave the surface closed."""
    import fast_simplification

    wanted = max(round(kept * len(surface.triangles)), FEWEST_TRIANGLES)
    if wanted >= len(surface.triangles):
        return surface
    points, triangles = fast_simplification.simplify(
        surface.points, surface.triangles, target_count=wanted
    )
    fewer = Surface(np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int32))
    return fewer if is_closed(fewer.triangles) else surface


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each edge of ``triangles`` (f, 3) is run through as often one way as the other."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    n = int(triangles.max()) + 1
    return np.array_equal(np.sort(edges[:, 0] * n + edges[:, 1]), np.sort(edges[:, 1] * n + edges[:, 0]))
