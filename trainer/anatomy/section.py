"""A drawn section of a knee, one layer of elements, for two-dimensional teaching scenes: ``data/sections/*.toml``.

Its frame is the drawing's: x to the front, y up, the layer in the middle of z = 0, mm.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from trainer import config
from trainer.anatomy.structures import DATA, number_of, structures
from trainer.config import LENGTH_MM, POSITION_MM, Bounds, ConfigError
from trainer.geometry import Array

Pair = tuple[float, float]

#: Elements of a section; a task that asks for more has mixed up a unit.
MOST_ELEMENTS = 10**6


@dataclass(frozen=True)
class Shape:
    """A polygon; or, with a width, all that is at most half of it away from the line through the points."""

    structure: str
    points_mm: tuple[Pair, ...] = field(metadata=POSITION_MM)
    width_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 1000.0)})

    def __post_init__(self) -> None:
        if self.structure not in structures():
            raise ValueError(f"unknown structure '{self.structure}'; known: {', '.join(structures())}")
        if not self.points_mm or (self.width_mm == 0.0 and len(self.points_mm) < 3):
            raise ValueError(f"a shape of '{self.structure}' needs three points, or one and a 'width_mm'")


@dataclass(frozen=True)
class SectionSpec:
    """What a section shows, and how finely."""

    source: str
    spacing_mm: float = field(metadata=LENGTH_MM)
    thickness_mm: float = field(metadata=LENGTH_MM)  # of the layer
    low_mm: Pair = field(metadata=POSITION_MM)
    high_mm: Pair = field(metadata=POSITION_MM)
    shape: tuple[Shape, ...]

    def __post_init__(self) -> None:
        size = [b - a for a, b in zip(self.low_mm, self.high_mm, strict=True)]
        if min(size) < self.spacing_mm:
            raise ValueError("'high_mm' must be greater than 'low_mm' by at least 'spacing_mm'")
        if size[0] * size[1] > MOST_ELEMENTS * self.spacing_mm**2:
            raise ValueError(f"a section has at most {MOST_ELEMENTS} elements: 'spacing_mm' is too small")


def names() -> list[str]:
    """The built-in sections."""
    return sorted(path.stem for path in (DATA / "sections").glob("*.toml"))


def load(name: str) -> SectionSpec:
    """The built-in section of that name. Raises ConfigError."""
    if name not in names():
        raise ConfigError(f"no built-in section '{name}'; there is {', '.join(names())}")
    path = DATA / "sections" / f"{name}.toml"
    return config.build(SectionSpec, config.read_toml(path), str(path))


def build(spec: SectionSpec) -> tuple[np.ndarray, tuple[float, float, float], Array]:
    """Labels (nx, ny, 1) uint8, their spacing in mm, and where the first element's centre (3,) lies in the drawing."""
    h = spec.spacing_mm
    low = np.array(spec.low_mm)
    nx, ny = np.floor((np.array(spec.high_mm) - low) / h).astype(int)
    corner = low + 0.5 * h
    x, y = (corner[0] + h * np.arange(nx))[:, None], (corner[1] + h * np.arange(ny))[None, :]
    labels = np.zeros((nx, ny, 1), dtype=np.uint8)
    for shape in spec.shape:
        points = np.array(shape.points_mm)
        inside = _inside(points, x, y) if shape.width_mm == 0.0 else _distance(points, x, y) <= 0.5 * shape.width_mm
        labels[inside & (labels[..., 0] == 0), 0] = number_of(shape.structure)
    return labels, (h, h, spec.thickness_mm), np.array([*corner, 0.0])


def _inside(points: Array, x: Array, y: Array) -> np.ndarray:
    """Whether places are in a polygon (n, 2): a ray to the right crosses its sides an odd number of times."""
    odd = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    for (ax, ay), (bx, by) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if ay != by:
            odd ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return odd


def _distance(points: Array, x: Array, y: Array) -> Array:
    """Distance to the line through points (n, 2); to the point where there is one."""
    least = np.hypot(x - points[0, 0], y - points[0, 1])
    for a, b in itertools.pairwise(points):
        way = b - a
        t = np.clip(((x - a[0]) * way[0] + (y - a[1]) * way[1]) / (way @ way), 0.0, 1.0)
        least = np.minimum(least, np.hypot(x - a[0] - t * way[0], y - a[1] - t * way[1]))
    return np.asarray(least)
