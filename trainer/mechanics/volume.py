"""A volume of elements: tissue as a grid of labelled voxels with links between neighbours (Gibson et al. 1998, 3.1).

An element is a voxel of a segmented image. It has a label, through it a material (limits, elastic constants, colour),
up to six links to the elements that share a face with it, and a displacement. What a task names is free to move, the
rest is rigid; label 0 is no element at all. An image of one layer is a 2-D volume.

The layout decides the speed, since each method here reads memory faster than it computes:

* Displacements from the rest place are kept, not places. The difference of two neighbours' displacements is then all
  that limits and elasticity ask for, an element at rest is zero, and memory that nobody has touched is not even there.
* They are float32: 24 bytes are read and written per element and move, 48 would be half as fast. A displacement of
  100 mm is then kept to 4e-6 mm, a hundred-thousandth of a voxel.
* x, y and z lie in arrays of their own, so that one instruction moves 8 or 16 elements along z.
* One byte per element holds its six links and whether it is free and present: a scan reads no more than that.

Elements are numbered as they lie in memory: e = (i·ny + j)·nz + k. Places are in the volume's own frame: element
(i, j, k) rests at (i·hx, j·hy, k·hz) mm.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array

if TYPE_CHECKING:
    from trainer.mechanics.chainmail_corrected import Ring
    from trainer.mechanics.chainmail_mixed import Waiting
    from trainer.mechanics.elastic_relaxation import Sweeps

Bytes = NDArray[np.uint8]
Singles = NDArray[np.float32]
Indices = NDArray[np.int32]
Triple = tuple[float, float, float]

#: Bits of an element: a link in each direction +x, −x, +y, −y, +z, −z (the direction d's opposite is d ^ 1) …
LINKS = 0b00111111
#: … whether chain, relaxation and contact may move it (a rigid or tacked element is not free) …
FREE = 1 << 6
#: … and whether it is there: not void, not erased.
PRESENT = 1 << 7
#: Unit steps of the directions, and their names.
STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
#: An element is numbered by an int32.
MOST_ELEMENTS = 2**31 - 1


class VolumeError(ValueError):
    """Labels, spacing or materials of which no volume can be made; one line that says what is wrong."""


@dataclass(frozen=True)
class Material:
    """What elements with one label are made of. Triples are for links along x, y and z of the grid."""

    name: str
    stretch: Triple  # the greatest length of a link, in rest lengths: at least 1
    compression: Triple  # the least length of a link, in rest lengths: above 0, at most 1
    shear: Triple  # how far a link's ends may be offset sideways, in its rest lengths: at least 0
    young_kPa: float  # slope of stress against strain at rest
    shear_kPa: float  # the same for shear
    time_constant_s: float  # in which an element closes 1 − 1/e of its way to where its neighbours want it
    steepness: float = 0.0  # b of the J-curve E/b (exp(b ε) − 1); 0 is linear
    straight_from: float = math.inf  # the strain from which a J-curve goes on along its tangent
    yield_strain: float = 0.0  # strains and shears up to this stay for good; 0 is elastic
    colour: tuple[int, int, int] = (200, 180, 170)  # red, green, blue

    def __post_init__(self) -> None:
        for axis, least, most, aside in zip("xyz", self.compression, self.stretch, self.shear, strict=True):
            if not 0.0 < least <= 1.0 <= most < math.inf:
                raise VolumeError(
                    f"material {self.name!r}: along {axis} links may be {least:g} to {most:g} rest lengths long; "
                    "expected 0 < compression <= 1 <= stretch"
                )
            if not 0.0 <= aside < math.inf:
                raise VolumeError(f"material {self.name!r}: shear along {axis} is {aside:g}; expected at least 0")
        for name in ("young_kPa", "shear_kPa", "time_constant_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise VolumeError(f"material {self.name!r}: {name} is {getattr(self, name):g}; expected more than 0")
        for name in ("steepness", "yield_strain"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise VolumeError(f"material {self.name!r}: {name} is {getattr(self, name):g}; expected at least 0")
        if not self.straight_from > 0.0:
            raise VolumeError(f"material {self.name!r}: straight_from is {self.straight_from:g}; expected more than 0")


@dataclass(frozen=True)
class Volume:
    """Labels, grid and materials: what does not change. Made by :func:`build`."""

    labels: Bytes  # (nx, ny, nz) C order; 0 is void
    spacing_mm: Triple
    materials: tuple[Material, ...]  # of the free labels, in the labels' order
    material_of: NDArray[np.int8]  # (256,) index into materials by label; -1 for void and rigid labels
    joined: frozenset[tuple[int, int]] | None  # pairs of labels (smaller first) grown together; None is all that touch
    low: Singles  # (m, m, 6, 3) mm: least of neighbour's minus own displacement, by materials, direction, component
    high: Singles  # (m, m, 6, 3) mm: the greatest

    @property
    def shape(self) -> tuple[int, int, int]:
        nx, ny, nz = self.labels.shape
        return nx, ny, nz

    @property
    def strides(self) -> tuple[int, int, int]:
        """How far neighbours along x, y and z are apart in memory, in elements."""
        _, ny, nz = self.shape
        return ny * nz, nz, 1

    @property
    def element_mm3(self) -> float:
        """What an element takes up."""
        return math.prod(self.spacing_mm)

    def rest(self, elements: Indices) -> Array:
        """Where ``elements`` (k,) rest: (k, 3) mm."""
        index = np.stack(np.unravel_index(elements, self.shape), axis=1)
        return np.asarray(index * np.array(self.spacing_mm))


@dataclass
class VolumeState:
    """What changes: where the elements are, what links them, and what was disturbed."""

    u: Singles  # (3, n) mm, displacement from rest
    links: Bytes  # (n,) LINKS, FREE and PRESENT
    mark: Bytes  # (n,) what the last moves came to: see :func:`next_marks`
    queue: Indices  # (n,) room for lists of elements; what was never used takes no memory
    free_count: int  # elements that may move
    seams: Seams = field(default_factory=lambda: Seams.none())
    marks_used: int = 0
    awake: tuple[Indices, Indices] | None = None  # lowest and highest index (3,) of what was disturbed; None is nothing
    disturbed: tuple[Indices, Indices] | None = (
        None  # lowest and highest index of what was ever moved: elsewhere u is 0
    )
    owed_s: float = 0.0  # time for which relaxation has not yet swept
    waiting: Waiting | None = None  # room for ChainMail in several materials, largest violation first
    ring: Ring | None = None  # the same, corrected
    sweeps: Sweeps | None = None  # what is the same in all sweeps of relaxation
    edges: Singles | None = None  # room for planes of them


@dataclass(frozen=True)
class Seams:
    """Links that were made by joining, between elements that are no neighbours in the grid."""

    ends: Indices  # (s, 2)
    side: Bytes  # (s,) direction in which the second end lies from the first
    rest: Singles  # (s, 3) mm: second's minus first's displacement at which the link has its rest length
    low: Singles  # (s, 3) mm: least of second's minus first's displacement
    high: Singles  # (s, 3) mm: the greatest

    @classmethod
    def none(cls) -> Seams:
        empty = np.empty((0, 3), np.float32)
        return cls(np.empty((0, 2), np.int32), np.empty(0, np.uint8), empty, empty, empty)


def build(
    labels: Bytes,
    spacing_mm: Triple,
    free: Mapping[int, Material],
    joined: Collection[tuple[int, int]] | None = None,
) -> Volume:
    """A volume of ``labels`` (nx, ny, nz) uint8 in which the labels of ``free`` may move and all others are rigid.

    ``joined`` names the pairs of different labels that have grown together; with None all that share a face have.
    Raises VolumeError for labels of another form, a spacing that is no length, and labels that are not in the volume.
    """
    if labels.ndim != 3 or labels.dtype != np.uint8 or not labels.flags.c_contiguous:
        raise VolumeError(
            f"labels are {labels.ndim}-D {labels.dtype}{'' if labels.flags.c_contiguous else ', not in C order'}; "
            "expected 3-D uint8 in C order"
        )
    if not 0 < labels.size <= MOST_ELEMENTS:
        raise VolumeError(f"the volume has {labels.size} elements; expected 1 to {MOST_ELEMENTS}")
    if len(spacing_mm) != 3 or not all(0.0 < h < math.inf for h in spacing_mm):
        raise VolumeError(f"spacing is {tuple(spacing_mm)} mm; expected three lengths above 0")
    there = np.bincount(labels.ravel(), minlength=256) > 0
    missing = [label for label in sorted(free) if not (0 < label < 256 and there[label])]
    if missing:
        raise VolumeError(
            f"free labels {', '.join(map(str, missing))} are not in the volume, which has "
            f"{', '.join(str(label) for label in range(1, 256) if there[label]) or 'none'}"
        )
    material_of = np.full(256, -1, dtype=np.int8)
    for index, label in enumerate(sorted(free)):
        material_of[label] = index
    materials = tuple(free[label] for label in sorted(free))
    low, high = _limits(materials, spacing_mm)
    pairs = None if joined is None else frozenset((min(pair), max(pair)) for pair in joined)
    return Volume(labels, spacing_mm, materials, material_of, pairs, low, high)


def _limits(materials: tuple[Material, ...], spacing_mm: Triple) -> tuple[Singles, Singles]:
    """Limits of differences of displacements. A link between two materials is half of the one, half of the other."""
    m = len(materials)
    low, high = np.zeros((m, m, 6, 3)), np.zeros((m, m, 6, 3))
    for a, one in enumerate(materials):
        for b, other in enumerate(materials):
            for axis, h in enumerate(spacing_mm):
                least, most, aside = (
                    0.5 * h * (x[axis] + y[axis])
                    for x, y in (
                        (one.compression, other.compression),
                        (one.stretch, other.stretch),
                        (one.shear, other.shear),
                    )
                )
                low[a, b, 2 * axis], high[a, b, 2 * axis] = -aside, aside
                low[a, b, 2 * axis, axis], high[a, b, 2 * axis, axis] = least - h, most - h
                low[a, b, 2 * axis + 1], high[a, b, 2 * axis + 1] = -high[a, b, 2 * axis], -low[a, b, 2 * axis]
    return low.astype(np.float32), high.astype(np.float32)


def start(volume: Volume) -> VolumeState:
    """The volume at rest, whole."""
    n = volume.labels.size
    table = np.zeros((256, 256), dtype=np.bool_)
    table[1:, 1:] = volume.joined is None
    np.fill_diagonal(table[1:, 1:], True)
    for a, b in volume.joined or ():
        table[a, b] = table[b, a] = True
    links = np.zeros(n, dtype=np.uint8)
    free_count = _link(volume.labels, table, volume.material_of, links.reshape(volume.shape))
    return VolumeState(
        u=np.zeros((3, n), dtype=np.float32),
        links=links,
        mark=np.zeros(n, dtype=np.uint8),
        queue=np.empty(n, dtype=np.int32),
        free_count=int(free_count),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _link(labels, table, material_of, links):  # type: ignore[no-untyped-def]
    """Link each element to those neighbours that it has grown together with; returns how many elements are free."""
    nx, ny, nz = labels.shape
    free = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                label = labels[i, j, k]
                if label == 0:
                    continue
                bits = PRESENT
                if material_of[label] >= 0:
                    bits |= FREE
                    free += 1
                if i + 1 < nx and table[label, labels[i + 1, j, k]]:
                    bits |= 1
                if i > 0 and table[label, labels[i - 1, j, k]]:
                    bits |= 2
                if j + 1 < ny and table[label, labels[i, j + 1, k]]:
                    bits |= 4
                if j > 0 and table[label, labels[i, j - 1, k]]:
                    bits |= 8
                if k + 1 < nz and table[label, labels[i, j, k + 1]]:
                    bits |= 16
                if k > 0 and table[label, labels[i, j, k - 1]]:
                    bits |= 32
                links[i, j, k] = bits
    return free


def grid_strides(volume: Volume) -> np.ndarray:
    """(9,) int64: the way in memory to the neighbour in each of the six directions, then nx, ny, nz."""
    sx, sy, sz = volume.strides
    return np.array([sx, -sx, sy, -sy, sz, -sz, *volume.shape], dtype=np.int64)


def next_marks(state: VolumeState) -> tuple[np.uint8, np.uint8]:
    """The marks of the next move for elements that it moves and for those that it finds in no need of moving.

    No mark of an earlier move equals them, so that marks are wiped only once in 127 moves.
    """
    state.marks_used += 1
    if state.marks_used == 128:
        state.mark[:] = 0
        state.marks_used = 1
    return np.uint8(2 * state.marks_used), np.uint8(2 * state.marks_used + 1)


def wake(state: VolumeState, lowest: Indices, highest: Indices) -> None:
    """Add the elements between two indices (3,) to the region that is awake."""
    if state.awake is not None:
        lowest, highest = np.minimum(state.awake[0], lowest), np.maximum(state.awake[1], highest)
    state.awake = (np.asarray(lowest, dtype=np.int32), np.asarray(highest, dtype=np.int32))
    if state.disturbed is not None:
        lowest, highest = np.minimum(state.disturbed[0], lowest), np.maximum(state.disturbed[1], highest)
    state.disturbed = (np.asarray(lowest, dtype=np.int32), np.asarray(highest, dtype=np.int32))


def places(volume: Volume, state: VolumeState, elements: Indices) -> Array:
    """Where ``elements`` (k,) are now: (k, 3) mm in the volume's frame."""
    out = np.empty((len(elements), 3))
    _places(state.u, np.asarray(elements), grid_strides(volume), np.array(volume.spacing_mm), out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _places(u, elements, strides, h, out):  # type: ignore[no-untyped-def]
    plane, row = np.uint64(strides[0]), np.uint64(strides[2])
    for m in range(len(elements)):
        e = np.uint64(elements[m])
        i = e // plane
        j = (e - i * plane) // row
        k = e - i * plane - j * row
        out[m, 0], out[m, 1], out[m, 2] = i * h[0] + u[0, e], j * h[1] + u[1, e], k * h[2] + u[2, e]


def tack(state: VolumeState, elements: Indices) -> None:
    """Fix ``elements`` (k,) where they are (3.4): only an instrument that holds them moves them."""
    free = np.unique(elements[(state.links[elements] & FREE) != 0])
    state.links[free] &= np.uint8(0xFF ^ FREE)
    state.free_count -= len(free)


def untack(volume: Volume, state: VolumeState, elements: Indices) -> None:
    """Let tacked ``elements`` (k,) go; those that are rigid or erased stay so."""
    soft = volume.material_of[volume.labels.reshape(-1)[elements]] >= 0
    there = (state.links[elements] & (FREE | PRESENT)) == PRESENT
    loose = np.unique(elements[soft & there])
    state.links[loose] |= np.uint8(FREE)
    state.free_count += len(loose)


def bytes_per_element(volume: Volume, state: VolumeState) -> float:
    """Memory that is set aside: 12 for the displacement, 1 each for label, links and mark, 4 for the lists."""
    arrays = (volume.labels, state.u, state.links, state.mark, state.queue)
    return sum(a.nbytes for a in arrays) / volume.labels.size
