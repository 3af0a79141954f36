"""Cruciate ligaments for a knee whose scan shows none: bundles swept between their footprints on the bones.

Footprints come from measured knees (``data/ligaments.toml``) and are carried over by what both knees have: the
line between the femur's epicondyles, the tibia's eminence and its posterior edge. Bones differ, so all of a ligament's
footprints on a bone are then moved together, by as little as lets every bundle run through free space, and each is set
down on the nearest surface of its bone. Where no such place is found within reach, the ligament is not made, and that
is said.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from trainer import config
from trainer.anatomy.label_volume import LabelVolume
from trainer.anatomy.structures import DATA, number_of
from trainer.config import LENGTH_MM, POSITION_MM
from trainer.geometry import Array, unit

CRUCIATES = ("anterior cruciate ligament", "posterior cruciate ligament")
#: Part of the femur's voxels that make an epicondyle, and of the tibia's that make the eminence; assumed.
EXTREME = 1e-3
#: How far footprints may be moved along the bone to find a free way, in steps, mm: assumed, half a condyle's radius.
REACH_MM, STEP_MM = 10.0, 1.0
#: A bundle may begin and end in bone, this deep at most, mm; assumed, a radius.
EMBEDDED_MM = 3.0
#: Distance of two places on a bundle at which it is looked whether they are free, mm; half a usual voxel.
SAMPLE_MM = 0.4


@dataclass(frozen=True)
class Bundle:
    """Fibres that run side by side, right knee (the file's frame)."""

    name: str
    ligament: str
    femur_mm: tuple[float, float, float] = field(metadata=POSITION_MM)
    tibia_mm: tuple[float, float, float] = field(metadata=POSITION_MM)
    radius_mm: float = field(metadata=LENGTH_MM)
    stiffness_N_per_strain: float
    slack_length_mm: float = field(metadata=LENGTH_MM)


@dataclass(frozen=True)
class Ligaments:
    """``data/ligaments.toml``."""

    source: str
    epicondyles_middle_mm: tuple[float, float, float] = field(metadata=POSITION_MM)
    epicondyles_apart_mm: float = field(metadata=LENGTH_MM)
    bundle: tuple[Bundle, ...]

    def of(self, ligament: str) -> tuple[Bundle, ...]:
        return tuple(b for b in self.bundle if b.ligament == ligament)


@dataclass(frozen=True)
class _Knee:
    """What carries the file's frame over into a volume's."""

    axes: Array  # (3, 3), columns: to the front, up, to the outer side; left-handed for a left knee
    scale: float
    middle: Array  # (3,) mm between the epicondyles
    eminence: Array  # (3,) mm, top of the tibia between its plateaus


@cache
def ligaments() -> Ligaments:
    """The shipped bundles. Raises ConfigError."""
    path = DATA / "ligaments.toml"
    return config.build(Ligaments, config.read_toml(path), str(path))


def swept_cruciates(volume: LabelVolume, side: str) -> tuple[LabelVolume, dict[str, Any], dict[str, str]]:
    """The volume with the cruciates that it lacks; what each swept one is like; why others could not be made."""
    swept: dict[str, Any] = {}
    failed: dict[str, str] = {}
    present = volume.volumes_ml()
    missing = [name for name in CRUCIATES if number_of(name) not in present]
    needed = [name for name in ("femur", "tibia") if number_of(name) not in present]
    if missing and (needed or not side):
        why = f"no {' and no '.join(needed)}" if needed else "left or right is not known"
        return volume, swept, dict.fromkeys(missing, why)
    if not missing:
        return volume, swept, failed
    labels = volume.labels.copy()
    knee = _register(volume, side)
    for name in missing:
        ends = _footprints(volume, knee, name)
        if ends is None:
            failed[name] = f"no free way between the bones within {REACH_MM:g} mm of its footprints"
            continue
        inside = _tubes(labels, volume.spacing_mm, *ends, [b.radius_mm * knee.scale for b in ligaments().of(name)])
        labels[inside] = number_of(name)
        swept[name] = {
            "source": ligaments().source,
            "volume_ml": len(inside[0]) * volume.voxel_ml,
            "length_mm": float(np.mean(np.linalg.norm(ends[0] - ends[1], axis=1))),
            "femur_mm": ends[0].tolist(),
            "tibia_mm": ends[1].tolist(),
        }
    return LabelVolume(labels, volume.spacing_mm, volume.lps_from_volume), swept, failed


def _register(volume: LabelVolume, side: str) -> _Knee:
    """Landmarks of the bones, in the volume's frame."""
    spacing = np.array(volume.spacing_mm)
    rotation = volume.lps_from_volume.matrix
    left, up = rotation[0], rotation[2]  # the patient's axes in the volume's frame
    outer = left if side == "left" else -left
    femur = np.argwhere(volume.labels == number_of("femur")) * spacing
    tibia = np.argwhere(volume.labels == number_of("tibia")) * spacing
    medial, lateral = _extreme(femur, -outer), _extreme(femur, outer)
    z = unit(lateral - medial)
    y = unit(up - (up @ z) * z)
    x = np.cross(y, z) * (1.0 if side == "right" else -1.0)
    scale = float(np.linalg.norm(lateral - medial)) / ligaments().epicondyles_apart_mm
    return _Knee(np.stack([x, y, z], axis=1), scale, 0.5 * (medial + lateral), _extreme(tibia, y))


def _extreme(points: Array, direction: Array) -> Array:
    """Mean (3,) of the points that lie furthest along a direction."""
    along = points @ direction
    return np.asarray(points[along >= np.quantile(along, 1.0 - EXTREME)].mean(axis=0))


def _footprints(volume: LabelVolume, knee: _Knee, ligament: str) -> tuple[Array, Array] | None:
    """Ends of a ligament's bundles, (n, 3) on the femur and on the tibia; None where there is no free way."""
    file = ligaments()
    bundles = file.of(ligament)
    femur, tibia = (np.array([getattr(b, end) for b in bundles]) for end in ("femur_mm", "tibia_mm"))
    # The tibia's own frame: the eminence stands at z = 0, level with the anterior cruciate's footprint, and mid-way
    # between the footprints of both cruciates.
    whole = np.mean([np.mean([b.tibia_mm for b in file.of(name)], axis=0) for name in CRUCIATES], axis=0)
    level = np.mean([b.tibia_mm[1] for b in file.of(CRUCIATES[0])])
    on_femur = knee.middle + knee.scale * (femur - file.epicondyles_middle_mm) @ knee.axes.T
    on_tibia = knee.eminence + knee.scale * (tibia - [whole[0], level, 0.0]) @ knee.axes.T
    bones = _Surroundings.around(volume, np.concatenate([on_femur, on_tibia]))
    steps = np.arange(-REACH_MM, REACH_MM + 0.5 * STEP_MM, STEP_MM)
    x, y = knee.axes[:, 0], knee.axes[:, 1]
    upper = {(f, u): bones.on_surface("femur", on_femur + f * x + u * y) for f, u in product(steps, steps)}
    lower = {f: bones.on_surface("tibia", on_tibia + f * x) for f in steps}
    for front, up, tibia_front in sorted(product(steps, steps, steps), key=lambda m: float(np.dot(m, m))):
        a, b = upper[front, up], lower[tibia_front]
        if bones.free(a, b):
            return a, b
    return None


@dataclass(frozen=True)
class _Surroundings:
    """The part of a volume that bundles can reach."""

    corner: np.ndarray  # (3,) first voxel
    spacing: Array
    labels: np.ndarray
    nearest: dict[str, np.ndarray]  # for each bone (3, nx, ny, nz): the voxel of its surface that is nearest

    @staticmethod
    def around(volume: LabelVolume, points: Array) -> _Surroundings:
        from scipy.ndimage import binary_erosion, distance_transform_edt

        spacing = np.array(volume.spacing_mm)
        margin = 1.5 * REACH_MM
        low = np.maximum(np.floor((points.min(axis=0) - margin) / spacing).astype(int), 0)
        high = np.minimum(np.ceil((points.max(axis=0) + margin) / spacing).astype(int) + 1, volume.labels.shape)
        high = np.maximum(high, low + 1)
        labels = volume.labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        nearest = {}
        for bone in ("femur", "tibia"):
            inside = labels == number_of(bone)
            surface = inside & ~binary_erosion(inside, border_value=1)
            nearest[bone] = distance_transform_edt(
                ~surface, sampling=volume.spacing_mm, return_distances=False, return_indices=True
            )
        return _Surroundings(low, spacing, labels, nearest)

    def voxel(self, points: Array) -> np.ndarray:
        """Indices (..., 3) of the voxels at ``points`` (..., 3), or of the nearest ones in reach."""
        index = np.round(points / self.spacing).astype(int) - self.corner
        return np.asarray(np.clip(index, 0, np.array(self.labels.shape) - 1))

    def on_surface(self, bone: str, points: Array) -> Array:
        i, j, k = self.voxel(points).T
        return np.asarray((self.nearest[bone][:, i, j, k].T + self.corner) * self.spacing)

    def free(self, a: Array, b: Array) -> bool:
        """Whether lines from ``a`` to ``b`` (n, 3) meet nothing labelled but for the bones at their ends."""
        for start, end in zip(a, b, strict=True):
            length = float(np.linalg.norm(end - start))
            along = np.arange(EMBEDDED_MM, length - EMBEDDED_MM, SAMPLE_MM) / max(length, EMBEDDED_MM)
            i, j, k = self.voxel(start + along[:, None] * (end - start)).T
            if len(along) == 0 or self.labels[i, j, k].any():
                return False
        return True


def _tubes(
    labels: np.ndarray, spacing_mm: tuple[float, float, float], a: Array, b: Array, radii: list[float]
) -> tuple[np.ndarray, ...]:
    """Indices of the free voxels within a bundle's radius of its line, or between neighbouring bundles."""
    spacing = np.array(spacing_mm)
    reach = max(radii) + float(spacing.max())
    ends = np.concatenate([a, b])
    low = np.maximum(np.floor((ends.min(axis=0) - reach) / spacing).astype(int), 0)
    high = np.minimum(np.ceil((ends.max(axis=0) + reach) / spacing).astype(int) + 1, labels.shape)
    i, j, k = np.meshgrid(*(np.arange(p, q) for p, q in zip(low, high, strict=True)), indexing="ij")
    points = np.stack([i, j, k], axis=-1) * spacing
    inside = np.zeros(points.shape[:3], dtype=bool)
    between = np.linspace(0.0, 1.0, 7)
    for start, end, radius in zip(
        np.concatenate([a[0] + between[:, None] * (p - a[0]) for p in a]),
        np.concatenate([b[0] + between[:, None] * (p - b[0]) for p in b]),
        np.concatenate([radii[0] + between * (r - radii[0]) for r in radii]),
        strict=True,
    ):
        line = end - start
        t = np.clip((points - start) @ line / (line @ line), 0.0, 1.0)
        inside |= np.linalg.norm(points - start - t[..., None] * line, axis=-1) <= radius
    inside &= labels[i, j, k] == 0
    return i[inside], j[inside], k[inside]
