"""A knee from parameters, at any resolution, for those who have no scan: ``data/knees/*.toml``.

Each bone is a solid of few parts (rounded cylinders, cones of elliptic section, spheres), given by a function that is
negative inside and about the distance to the surface nearby; a union is the least of its parts, a hollow is cut out by
the greatest. Cartilage is what lies within its thickness of a bone where a joint is, menisci are wedges on the
plateaus, ligaments are swept between the bones as in a scan without them.

Functions take coordinates of the knee's frame (x to the front, y up, z to the outer side, mm) as arrays that broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from trainer import config
from trainer.anatomy.label_volume import LabelVolume
from trainer.anatomy.ligaments import swept_cruciates
from trainer.anatomy.structures import DATA, number_of
from trainer.config import LENGTH_MM, POSITION_MM, Bounds, ConfigError
from trainer.geometry import Array, Rigid, quaternion_from_matrix

Pair = tuple[float, float]
Triple = tuple[float, float, float]
Four = tuple[float, float, float, float]

#: Resolutions that make sense, mm: a finer one takes gigabytes, a coarser one has no cartilage.
FINEST_MM, COARSEST_MM = 0.15, 2.0
#: Of a usual scan's slices.
USUAL_MM = 0.7


@dataclass(frozen=True)
class FemurSpec:
    """Shaft, flare, two condyles, the trochlea with its groove, the notch."""

    source: str
    shaft_mm: Pair = field(metadata=POSITION_MM)
    shaft_semi_mm: Pair = field(metadata=LENGTH_MM)
    flare_mm: Pair = field(metadata=POSITION_MM)
    flare_semi_mm: Pair = field(metadata=LENGTH_MM)
    flare_level_mm: float = field(metadata=POSITION_MM)
    shaft_level_mm: float = field(metadata=POSITION_MM)
    medial_condyle_mm: Triple = field(metadata=POSITION_MM)
    lateral_condyle_mm: Triple = field(metadata=POSITION_MM)
    medial_radius_mm: float = field(metadata=LENGTH_MM)
    lateral_radius_mm: float = field(metadata=LENGTH_MM)
    condyle_width_mm: float = field(metadata=LENGTH_MM)
    rounding_mm: float = field(metadata=LENGTH_MM)
    trochlea_mm: Triple = field(metadata=POSITION_MM)
    trochlea_radius_mm: float = field(metadata=LENGTH_MM)
    trochlea_width_mm: float = field(metadata=LENGTH_MM)
    groove_radius_mm: float = field(metadata=LENGTH_MM)
    groove_depth_mm: float = field(metadata=LENGTH_MM)
    notch_mm: Pair = field(metadata=POSITION_MM)
    notch_radius_mm: float = field(metadata=LENGTH_MM)
    notch_slope_deg: float = field(metadata={"bounds": Bounds(0.0, 80.0)})


@dataclass(frozen=True)
class TibiaSpec:
    """Four elliptic sections from the plateau downwards, the eminence, the posterior facet."""

    source: str
    plateau_level_mm: float = field(metadata=POSITION_MM)
    levels_mm: Four = field(metadata=POSITION_MM)
    centre_x_mm: Four = field(metadata=POSITION_MM)
    centre_z_mm: Four = field(metadata=POSITION_MM)
    semi_x_mm: Four = field(metadata=LENGTH_MM)
    semi_z_mm: Four = field(metadata=LENGTH_MM)
    eminence_mm: Triple = field(metadata=POSITION_MM)
    eminence_radius_mm: float = field(metadata=LENGTH_MM)
    facet_mm: Triple = field(metadata=POSITION_MM)
    facet_radius_mm: float = field(metadata=LENGTH_MM)

    def __post_init__(self) -> None:
        if not all(a > b for a, b in zip(self.levels_mm, self.levels_mm[1:], strict=False)):
            raise ValueError("'levels_mm' must go down")


@dataclass(frozen=True)
class FibulaSpec:
    """A cone with round ends."""

    source: str
    head_mm: Triple = field(metadata=POSITION_MM)
    head_radius_mm: float = field(metadata=LENGTH_MM)
    shaft_mm: Triple = field(metadata=POSITION_MM)
    shaft_radius_mm: float = field(metadata=LENGTH_MM)


@dataclass(frozen=True)
class PatellaSpec:
    """An ellipsoid, hollowed by the femur that it faces."""

    source: str
    centre_mm: Triple = field(metadata=POSITION_MM)
    semi_mm: Triple = field(metadata=LENGTH_MM)
    gap_mm: float = field(metadata=LENGTH_MM)


@dataclass(frozen=True)
class CartilageSpec:
    """Thicknesses, and how far the tibia's reach."""

    source: str
    femur_mm: float = field(metadata=LENGTH_MM)
    medial_tibia_mm: float = field(metadata=LENGTH_MM)
    lateral_tibia_mm: float = field(metadata=LENGTH_MM)
    patella_mm: float = field(metadata=LENGTH_MM)
    tibia_semi_mm: Pair = field(metadata=LENGTH_MM)


@dataclass(frozen=True)
class MeniscusSpec:
    """Two open rings of wedge-shaped section on the plateaus."""

    source: str
    medial_centre_mm: Pair = field(metadata=POSITION_MM)
    lateral_centre_mm: Pair = field(metadata=POSITION_MM)
    medial_semi_mm: Pair = field(metadata=LENGTH_MM)
    lateral_semi_mm: Pair = field(metadata=LENGTH_MM)
    inner: float = field(metadata={"bounds": Bounds(0.1, 0.95)})
    rim_height_mm: float = field(metadata=LENGTH_MM)
    inner_height_mm: float = field(metadata=LENGTH_MM)
    open_deg: float = field(metadata={"bounds": Bounds(0.0, 180.0)})


@dataclass(frozen=True)
class KneeSpec:
    """All of a knee; the box is what a volume of it covers."""

    side: Literal["left", "right"]
    box_low_mm: Triple = field(metadata=POSITION_MM)
    box_high_mm: Triple = field(metadata=POSITION_MM)
    femur: FemurSpec
    tibia: TibiaSpec
    fibula: FibulaSpec
    patella: PatellaSpec
    cartilage: CartilageSpec
    meniscus: MeniscusSpec

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.box_low_mm, self.box_high_mm, strict=True)):
            raise ValueError("'box_high_mm' must be greater than 'box_low_mm' along each axis")


def load(name: str) -> KneeSpec:
    """The built-in knee of that name, or of a path that ends in .toml. Raises ConfigError."""
    path = Path(name) if name.endswith(".toml") else DATA / "knees" / f"{name}.toml"
    if not path.is_file():
        raise ConfigError(f"no built-in knee '{name}'; there is {', '.join(names())}")
    return config.build(KneeSpec, config.read_toml(path), str(path))


def names() -> list[str]:
    """The built-in knees."""
    return sorted(path.stem for path in (DATA / "knees").glob("*.toml"))


def build(spec: KneeSpec, voxel_mm: float = USUAL_MM) -> LabelVolume:
    """The knee as labels in cubes of ``voxel_mm``; the knee's origin is the patient's. Raises ConfigError."""
    if not FINEST_MM <= voxel_mm <= COARSEST_MM:
        raise ConfigError(f"a knee is made of voxels of {FINEST_MM} to {COARSEST_MM} mm, found {voxel_mm:g}")
    # The volume's axes run to the left, to the back and up.
    outer = 1.0 if spec.side == "left" else -1.0
    low, high = np.array(spec.box_low_mm), np.array(spec.box_high_mm)
    left = sorted((outer * low[2], outer * high[2]))
    corner = np.array([left[0], -high[0], low[1]])
    size = np.ceil((np.array([left[1], -low[0], high[1]]) - corner) / voxel_mm).astype(int)
    labels = np.zeros(tuple(size), dtype=np.uint8)
    axes = [corner[k] + voxel_mm * (np.arange(size[k]) + 0.5) for k in range(3)]
    x, y = -axes[1][:, None], axes[2][None, :]
    for i, along in enumerate(axes[0]):
        labels[i] = _slice(spec, x, y, outer * float(along))
    _keep_largest_parts(labels)
    place = Rigid(corner + 0.5 * voxel_mm, quaternion_from_matrix(np.eye(3)))
    return swept_cruciates(LabelVolume(labels, (voxel_mm, voxel_mm, voxel_mm), place), spec.side)[0]


def _keep_largest_parts(labels: np.ndarray) -> None:
    """Erase what a coarse grid has torn off a structure."""
    from scipy.ndimage import label

    for number in np.unique(labels[labels > 0]).tolist():
        parts, count = label(labels == number)
        if count > 1:
            labels[(parts > 0) & (parts != 1 + np.argmax(np.bincount(parts.ravel())[1:]))] = 0


def _slice(spec: KneeSpec, x: Array, y: Array, z: float) -> np.ndarray:
    """Labels at (x, y) for one z; what comes first stays."""
    c, m = spec.cartilage, spec.meniscus
    femur, joint = _femur(spec.femur, x, y, z)
    tibia = _tibia(spec.tibia, x, y, z)
    patella = np.maximum(
        _ellipsoid(spec.patella.centre_mm, spec.patella.semi_mm, x, y, z),
        c.femur_mm + spec.patella.gap_mm + c.patella_mm - femur,
    )
    labels = np.zeros(femur.shape, dtype=np.uint8)

    def put(name: str, inside: np.ndarray) -> None:
        labels[inside & (labels == 0)] = number_of(name)

    put("femur", femur <= 0.0)
    put("tibia", tibia <= 0.0)
    put("fibula", _cone(spec.fibula, x, y, z) <= 0.0)
    put("patella", patella <= 0.0)
    put("femoral cartilage", joint & (femur <= c.femur_mm))
    facing = _ellipsoid(spec.patella.centre_mm, spec.patella.semi_mm, x, y, z) <= 0.0
    put("patellar cartilage", facing & (patella <= c.patella_mm))
    for side, thickness, centre, semi in (
        ("medial", c.medial_tibia_mm, m.medial_centre_mm, m.medial_semi_mm),
        ("lateral", c.lateral_tibia_mm, m.lateral_centre_mm, m.lateral_semi_mm),
    ):
        on_plateau = _ring(centre, c.tibia_semi_mm, x, z) <= 1.0
        above = y > spec.tibia.plateau_level_mm - thickness
        put(f"{side} tibial cartilage", on_plateau & above & (tibia <= thickness))
        put(f"{side} meniscus", _meniscus(m, centre, semi, spec.tibia.plateau_level_mm + thickness, x, y, z))
    return labels


def _femur(s: FemurSpec, x: Array, y: Array, z: float) -> tuple[Array, np.ndarray]:
    """About the distance to the femur, and where it is covered by cartilage."""
    rounded = s.rounding_mm
    width = s.condyle_width_mm
    medial = _cylinder(s.medial_condyle_mm, s.medial_radius_mm, width, rounded, x, y, z)
    lateral = _cylinder(s.lateral_condyle_mm, s.lateral_radius_mm, width, rounded, x, y, z)
    front = _cylinder(s.trochlea_mm, s.trochlea_radius_mm, s.trochlea_width_mm, rounded, x, y, z)
    # The groove runs around the trochlea: a ring whose section is a circle about z = 0.
    around = np.hypot(x - s.trochlea_mm[0], y - s.trochlea_mm[1])
    edge = s.trochlea_radius_mm - s.groove_depth_mm + s.groove_radius_mm
    groove = s.groove_radius_mm - np.hypot(around - edge, z - s.trochlea_mm[2])
    front = np.maximum(front, groove)
    up = np.clip((y - s.flare_level_mm) / (s.shaft_level_mm - s.flare_level_mm), 0.0, 1.0)
    centre = [a + up * (b - a) for a, b in zip(s.flare_mm, s.shaft_mm, strict=True)]
    semi = [a + up * (b - a) for a, b in zip(s.flare_semi_mm, s.shaft_semi_mm, strict=True)]
    shaft = np.maximum(_ellipse(centre, semi, x, z), s.flare_level_mm - y)
    slope = np.radians(s.notch_slope_deg)
    roof = (x - s.notch_mm[0]) * np.sin(slope) + (y - s.notch_mm[1]) * np.cos(slope)
    notch = s.notch_radius_mm - np.hypot(np.maximum(roof, 0.0), z)
    solid = np.minimum(np.minimum(medial, lateral), np.minimum(front, shaft))
    bearing = np.minimum(np.minimum(medial, lateral), np.where(x > s.trochlea_mm[0] - s.rounding_mm, front, np.inf))
    # Covered is what bears: not the outer faces, at the back not above the condyles, in front to the groove's end.
    outer = 0.5 * width - 0.5 * rounded
    within = s.medial_condyle_mm[2] - outer < z < s.lateral_condyle_mm[2] + outer
    ends = [s.medial_condyle_mm[1] + 0.5 * s.medial_radius_mm, s.trochlea_mm[1] + 0.7 * s.trochlea_radius_mm]
    upper = np.interp(x, [s.medial_condyle_mm[0], s.trochlea_mm[0]], ends)
    joint = (bearing <= shaft) & (notch < -0.5 * rounded) & within & (y < upper)
    return np.maximum(solid, notch), joint


def _tibia(s: TibiaSpec, x: Array, y: Array, z: float) -> Array:
    """About the distance to the tibia."""
    down = -y
    levels = -np.array(s.levels_mm)
    centre = [np.interp(down, levels, values) for values in (s.centre_x_mm, s.centre_z_mm)]
    semi = [np.interp(down, levels, values) for values in (s.semi_x_mm, s.semi_z_mm)]
    body = np.maximum(_ellipse(centre, semi, x, z), y - s.plateau_level_mm)
    top = s.eminence_mm[1] - s.eminence_radius_mm
    eminence = (
        np.sqrt(((x - s.eminence_mm[0]) / 2.0) ** 2 + np.maximum(y - top, 0.0) ** 2 + (z - s.eminence_mm[2]) ** 2)
        - s.eminence_radius_mm
    )
    eminence = np.maximum(eminence, s.plateau_level_mm - 5.0 - y)
    facet = s.facet_radius_mm - _distance(s.facet_mm, x, y, z)
    return np.asarray(np.maximum(np.minimum(body, eminence), facet))


def _meniscus(s: MeniscusSpec, centre: Pair, semi: Pair, floor_mm: float, x: Array, y: Array, z: float) -> np.ndarray:
    """Whether points lie in a ring's wedge above ``floor_mm``, its horns turned to z = 0."""
    part = (_ring(centre, semi, x, z) - s.inner) / (1.0 - s.inner)
    height = s.inner_height_mm + part * (s.rim_height_mm - s.inner_height_mm)
    inwards = -np.sign(centre[1]) * (z - centre[1])
    angle = np.degrees(np.arctan2(np.abs(x - centre[0]) / semi[0], inwards / semi[1]))
    on = (part >= 0.0) & (part <= 1.0) & (angle > 0.5 * s.open_deg)
    return np.asarray(on & (y >= floor_mm - 1.0) & (y <= floor_mm + height))


def _ring(centre: Pair, semi: Pair, x: Array, z: float) -> Array:
    """1 on the ellipse about ``centre`` (x, z), less inside."""
    return np.hypot((x - centre[0]) / semi[0], (z - centre[1]) / semi[1])


def _ellipse(centre: list[Array], semi: list[Array], x: Array, z: float) -> Array:
    """About the distance to an elliptic section; exact on it and where it is a circle."""
    radius = np.hypot((x - centre[0]) / semi[0], (z - centre[1]) / semi[1])
    return np.asarray((radius - 1.0) * np.minimum(semi[0], semi[1]))


def _ellipsoid(centre: Triple, semi: Triple, x: Array, y: Array, z: float) -> Array:
    """About the distance to an ellipsoid."""
    u, v, w = (x - centre[0]) / semi[0], (y - centre[1]) / semi[1], (z - centre[2]) / semi[2]
    return np.asarray((np.sqrt(u**2 + v**2 + w**2) - 1.0) * min(semi))


def _distance(centre: Triple, x: Array, y: Array, z: float) -> Array:
    return np.asarray(np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2))


def _cylinder(centre: Triple, radius: float, width: float, rounded: float, x: Array, y: Array, z: float) -> Array:
    """Distance to a cylinder along z with rounded edges."""
    across = np.hypot(x - centre[0], y - centre[1]) - (radius - rounded)
    along = abs(z - centre[2]) - (0.5 * width - rounded)
    outside = np.hypot(np.maximum(across, 0.0), max(along, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(across, along), 0.0) - rounded)


def _cone(s: FibulaSpec, x: Array, y: Array, z: float) -> Array:
    """About the distance to a cone with round ends."""
    a, b = np.array(s.head_mm), np.array(s.shaft_mm)
    line = b - a
    t = np.clip(((x - a[0]) * line[0] + (y - a[1]) * line[1] + (z - a[2]) * line[2]) / (line @ line), 0.0, 1.0)
    off = np.sqrt((x - a[0] - t * line[0]) ** 2 + (y - a[1] - t * line[1]) ** 2 + (z - a[2] - t * line[2]) ** 2)
    return np.asarray(off - (s.head_radius_mm + t * (s.shaft_radius_mm - s.head_radius_mm)))
