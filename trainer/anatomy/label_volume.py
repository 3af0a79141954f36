"""A volume of labels in the patient: which structure is where.

A volume of ours has its axes sorted: the first runs most to the left of the patient, the second to the back, the third
up. Sorting exchanges and mirrors whole axes, labels and positions together, so nothing moves in the patient; after it
the axes are right-handed and lie in the patient by a rotation and a translation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainer.anatomy.volume_file import FileVolume
from trainer.geometry import Array, Rigid, quaternion_from_matrix


@dataclass(frozen=True)
class LabelVolume:
    """Labels on a grid; voxel (i, j, k) has its centre at (i, j, k) · spacing in the volume's frame."""

    labels: np.ndarray  # (nx, ny, nz) uint8, C order, 0 where nothing is labelled
    spacing_mm: tuple[float, float, float]
    lps_from_volume: Rigid  # mm

    @property
    def voxel_ml(self) -> float:
        """Volume of one voxel."""
        return float(np.prod(self.spacing_mm)) * 1e-3

    def volumes_ml(self) -> dict[int, float]:
        """Volume of each label that occurs, by label."""
        counts = np.bincount(self.labels.ravel(), minlength=256)
        return {label: float(n) * self.voxel_ml for label, n in enumerate(counts.tolist()) if label and n}

    def points_mm(self, label: int) -> Array:
        """Centres (n, 3) of the voxels with a label, LPS."""
        return self.lps_from_volume.apply(np.argwhere(self.labels == label) * self.spacing_mm)


def sorted_axes(file: FileVolume, renumber: np.ndarray) -> LabelVolume:
    """A file's labels, each replaced by ``renumber[label]`` (uint8), with the axes sorted to L, P, S.

    Axes that are not quite at right angles (see volume_file.SQUARE) are replaced by the nearest that are; the centre
    of the volume stays where it is.
    """
    axes = file.lps_from_index[:3, :3]
    order = _nearest_axes(axes)
    signs = np.sign(axes[np.arange(3), order])
    values = np.transpose(file.values, order)[tuple(slice(None, None, int(s)) for s in signs)]
    labels = np.ascontiguousarray(renumber[values])
    spacing = file.spacing_mm[order]
    u, _, vt = np.linalg.svd(axes[:, order] / spacing * signs)
    rotation = u @ vt
    middle_index = np.append(0.5 * (np.array(file.values.shape) - 1.0), 1.0)
    middle = file.lps_from_index[:3] @ middle_index
    corner = middle - rotation @ (0.5 * (np.array(labels.shape) - 1.0) * spacing)
    x, y, z = spacing.tolist()
    return LabelVolume(labels, (x, y, z), Rigid(corner, quaternion_from_matrix(rotation)))


def resample(volume: LabelVolume, spacing_mm: tuple[float, float, float]) -> LabelVolume:
    """The volume on another grid over the same box, each voxel with the label of the nearest old one."""
    indices = []
    for n, old, new in zip(volume.labels.shape, volume.spacing_mm, spacing_mm, strict=True):
        count = max(round(n * old / new), 1)
        nearest = np.floor((np.arange(count) + 0.5) * new / old).astype(np.int64)
        indices.append(np.clip(nearest, 0, n - 1))
    labels = np.ascontiguousarray(volume.labels[np.ix_(*indices)])
    # The first voxels' outer faces stay where they are.
    shift = 0.5 * (np.array(spacing_mm) - volume.spacing_mm)
    place = Rigid(volume.lps_from_volume.apply(shift), volume.lps_from_volume.quaternion)
    return LabelVolume(labels, spacing_mm, place)


def write_nrrd(volume: LabelVolume, path: Path) -> None:
    """Write a gzipped NRRD in LPS that other programs show in the same place."""
    import nrrd

    header = {
        "space": "left-posterior-superior",
        "space directions": (volume.lps_from_volume.matrix * volume.spacing_mm).T,
        "space origin": volume.lps_from_volume.position,
        "encoding": "gzip",
    }
    nrrd.write(str(path), volume.labels, header, compression_level=6)


def _nearest_axes(axes: Array) -> np.ndarray:
    """For each of L, P, S the axis (a column of ``axes``) that runs along it, each used once, the clearest first.

    With signs made positive they are right-handed: of an orthogonal matrix the largest entry is a >= 1/√3, what is left
    without its row and column has the determinant ±a and so an entry >= √(a/2), and a trace above 1 has no reflection.
    """
    size = np.abs(axes / np.linalg.norm(axes, axis=0))
    order = np.zeros(3, dtype=np.int64)
    for _ in range(3):
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        order[row] = column
        size[row], size[:, column] = -1.0, -1.0
    return order
