"""A region of the anatomy as a component of the scene: a volume of elements, what holds it, and what was done to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trainer.anatomy import block, library, section
from trainer.anatomy.imported import Anatomy
from trainer.anatomy.structures import number_of, structures
from trainer.config import ConfigError
from trainer.curriculum import SEVERING_STEPS, TISSUE_STEPS, AnatomySpec, Task, TissueSpec
from trainer.geometry import Array, Rigid, lengthwise
from trainer.mechanics import volume as volumes
from trainer.mechanics.density_field import DensityField, density_field
from trainer.mechanics.incision import Change
from trainer.mechanics.islands import islands
from trainer.mechanics.volume import (
    FREE,
    PRESENT,
    STEPS,
    Indices,
    Material,
    Triple,
    Volume,
    VolumeError,
    VolumeState,
    grid_strides,
)

#: Bits of an element that may be moved by whoever holds it.
LOOSE = FREE | PRESENT
#: A ligament grows into bone over this part of its length at each end; in between it lies against it. Assumed.
INSERTION = 0.25


@dataclass
class Hold:
    """What one instrument's jaws hold of a structure."""

    structure: str
    elements: Indices  # (k,)
    points: Array  # (k, 3) mm, where they are in the tool's frame
    tacked: bool = False  # since it was taken
    pull_mN: float = 0.0  # of the tissue on it, after the last movement


@dataclass
class Blades:
    """How far the blades of one instrument have closed, or opened, and what this stroke of them has cut."""

    closing: bool = False
    closure: float = 0.0  # the greatest since they began to close; while they open, the least
    cut: dict[str, list[Indices]] = field(default_factory=dict)  # by structure, in this stroke


@dataclass
class Touch:
    """What the tip of one probe presses on."""

    elements: Indices = field(default_factory=lambda: np.empty(0, np.int32))  # (k,) that it pushes aside
    soft: str = ""  # the structure of the last of them
    outwards: Array = field(default_factory=lambda: np.zeros(3))  # (3,) out of what is rigid; zeros away from it
    met: set[str] = field(default_factory=set)  # structures, since it began to touch
    force_mN: float = 0.0  # on the tip, after the last movement


@dataclass
class Region:
    """A volume in the scene. Element (0, 0, 0) rests at ``origin``; the axes are the scene's.

    The volume is no larger than what moves and what that is grown to; ``labels`` reach as far as the task does.
    """

    volume: Volume
    state: VolumeState
    origin: Array  # (3,) mm
    labels: np.ndarray  # (lx, ly, lz) uint8 of everything at rest, on the volume's grid
    corner: Array  # (3,) mm, where the first of them is
    flat: int  # the axis along which there is one layer only, or -1: depth along it does not count
    tissue: dict[str, TissueSpec]  # by structure
    names: dict[int, str]  # of the labels
    elements: dict[str, Indices]  # of each movable structure
    held: list[Hold | None]  # by instrument
    blades: list[Blades]  # by instrument
    inside: list[str]  # by instrument: the structure that its tip is in or a probe's touches, or ""
    touch: list[Touch]  # by instrument
    hard: DensityField | None  # the field of what is rigid, for probes
    tacked: np.ndarray  # (n,) bool, fixed by a tack
    opened: dict[str, Indices] = field(default_factory=dict)  # elements of a structure that lost a link
    bridges: frozenset[str] = frozenset()  # structures that lead from one of what they are grown to to another at rest
    severed: set[str] = field(default_factory=set)  # those of them that do so no more
    torn_through: str = ""  # the first structure that was severed by a pull
    pull_max_mN: float = 0.0
    press_max_mN: float = 0.0  # the greatest force on the tip of a probe

    def places(self, elements: Indices) -> Array:
        """Where ``elements`` (k,) are now: (k, 3) mm, scene."""
        return self.origin + volumes.places(self.volume, self.state, elements)

    def rest(self, elements: Indices) -> Array:
        """Where ``elements`` (k,) rest: (k, 3) mm, scene."""
        return self.origin + self.volume.rest(elements)

    def displaced_mm(self, elements: Indices) -> float:
        """How far ``elements`` (k,) are from where they rest, on the mean."""
        return float(np.mean(np.linalg.norm(self.state.u[:, elements], axis=0)))

    def in_layer(self, pose: Rigid) -> Rigid:
        """A pose as the region meets it: in one layer, as if the instrument's origin were in it."""
        if self.flat < 0:
            return pose
        place = pose.position.copy()
        place[self.flat] = self.origin[self.flat]
        return Rigid(place, pose.quaternion)

    def structure_at(self, place: Array) -> str:
        """The structure that has its rest at ``place`` (3,) mm of the scene, or ""."""
        index = np.floor((place - self.corner) / np.array(self.volume.spacing_mm) + 0.5).astype(int)
        if (index < 0).any() or (index >= self.labels.shape).any():
            return ""
        return self.names.get(int(self.labels[tuple(index)]), "")

    def beside(self, elements: Indices, axis: int, steps: int) -> Indices:
        """The elements (k,) so many steps along an axis from ``elements`` (k,), or -1 beyond the volume's side."""
        stride, count = self.volume.strides[axis], self.volume.shape[axis]
        at = elements // stride % count + steps
        return np.where((at >= 0) & (at < count), elements + steps * stride, -1).astype(np.int32)

    def mm3(self, elements: Indices) -> float:
        """What ``elements`` (k,) take up at rest."""
        return float(len(elements) * self.volume.element_mm3)

    def note(self, change: Change) -> dict[str, Indices]:
        """Remember what a cut or tear has opened and severed; returns by structure what (k,) lost a link."""
        labels = self.volume.labels.reshape(-1)[change.elements]
        found = {s: change.elements[labels == number_of(s)] for s in self.elements}
        found = {s: lost for s, lost in found.items() if len(lost)}
        for structure, lost in found.items():
            self.opened[structure] = np.union1d(self.opened.get(structure, lost), lost).astype(np.int32)
        self.severed |= {s for s in found if s in self.bridges and not self.leads_through(s)}
        return found

    def leads_through(self, structure: str) -> bool:
        """Whether a way through ``structure`` alone leads from one of what it is grown to to another."""
        labels, strides = self.volume.labels.reshape(-1), grid_strides(self.volume)
        ends = [number_of(end) for end in self.tissue[structure].grown_to]
        for part in islands(self.state, self.volume, number_of(structure)):
            linked = [part[(self.state.links[part] & (1 << d)) != 0] + strides[d] for d in range(len(STEPS))]
            if np.isin(ends, labels[np.concatenate(linked)]).sum() > 1:
                return True
        return False

    def parted_mm(self, structure: str) -> float:
        """How far the cut ends of a severed structure have moved apart, mm; 0 as long as it holds together.

        The mean difference of the displacements of elements that were neighbours and are in different parts now.
        """
        if structure not in self.severed:
            return 0.0
        part = np.empty(self.volume.labels.size, dtype=np.int32)
        for number, elements in enumerate(islands(self.state, self.volume, number_of(structure))):
            part[elements] = number
        opened, u = self.opened[structure], self.state.u
        gaps = []
        for axis in range(3):
            beside = self.beside(opened, axis, 1)
            both = np.isin(beside, opened)
            a, b = opened[both], beside[both]
            apart = part[a] != part[b]
            gaps.append(np.linalg.norm(u[:, b[apart]] - u[:, a[apart]], axis=0))
        found = np.concatenate(gaps)
        return float(found.mean()) if len(found) else 0.0


def build(task: Task, spec: AnatomySpec, anatomy: Anatomy | None = None) -> Region:
    """The region of a task at rest, of ``anatomy`` or of the knee that its ``spec`` names.

    Raises ConfigError for an anatomy or structures that are not there.
    """
    handled = [s.structure for s in task.step if s.kind in (*TISSUE_STEPS, "probe")]
    needed = dict.fromkeys([t.structure for t in spec.tissue] + handled)
    for structure in (*needed, *(end for t in spec.tissue for end in t.grown_to)):
        if structure not in structures():
            raise ConfigError(f"unknown structure '{structure}'; known: {', '.join(structures())}")
    free = {number_of(t.structure): _material(t) for t in spec.tissue}
    grown = {(number_of(t.structure), number_of(end)) for t in spec.tissue for end in t.grown_to}
    labels, spacing, corner, name = _labels(spec, anatomy)
    missing = [structure for structure in needed if not (labels == number_of(structure)).any()]
    if missing:
        raise ConfigError(f"anatomy '{name}' has no {' and no '.join(missing)} where the task takes place")
    near = np.argwhere(np.isin(labels, list(free)))
    lowest, highest = np.maximum(near.min(axis=0) - 1, 0), near.max(axis=0) + 2
    part = np.ascontiguousarray(labels[tuple(slice(a, b) for a, b in zip(lowest, highest, strict=True))])
    try:
        volume = volumes.build(part, spacing, free, grown)
    except VolumeError as error:
        raise ConfigError(f"anatomy '{name}': {error}") from None
    state = volumes.start(volume)
    thin = [axis for axis, n in enumerate(labels.shape) if n == 1]
    elements = {
        t.structure: np.flatnonzero(part.reshape(-1) == number_of(t.structure)).astype(np.int32) for t in spec.tissue
    }
    if spec.knee is not None:
        for structure, own in elements.items():
            if structures()[structure].kind == "ligament":
                _lay_against_bone(volume, state, own)
    instruments = len(task.scene.instrument)
    region = Region(
        volume=volume,
        state=state,
        origin=corner + lowest * np.array(spacing),
        labels=labels,
        corner=corner,
        flat=thin[0] if thin else -1,
        tissue={t.structure: t for t in spec.tissue},
        names={s.number: name for name, s in structures().items()},
        elements=elements,
        held=[None] * instruments,
        blades=[Blades() for _ in range(instruments)],
        inside=[""] * instruments,
        touch=[Touch() for _ in range(instruments)],
        hard=_hard(spec, labels, spacing, corner),
        tacked=np.zeros(part.size, dtype=bool),
    )
    region.bridges = frozenset(structure for structure in elements if region.leads_through(structure))
    for step in task.step:
        if step.kind in SEVERING_STEPS and step.structure not in region.bridges:
            ends = " and ".join(region.tissue[step.structure].grown_to)
            raise ConfigError(
                f"anatomy '{name}': the {step.structure} does not join {ends}, so that it cannot be cut through"
            )
    return region


def _hard(spec: AnatomySpec, labels: np.ndarray, spacing: Triple, corner: Array) -> DensityField | None:
    """What presses on a probe's tip; None where the task tells no hardness."""
    if spec.hardness_mN_per_mm is None:
        return None
    rigid = (labels > 0) & ~np.isin(labels, [number_of(t.structure) for t in spec.tissue])
    hardness = spec.hardness_mN_per_mm.value
    # No device's limit: what a hand presses with is to be told, not what a motor can.
    return density_field(rigid, spacing, Rigid(corner, np.array([1.0, 0.0, 0.0, 0.0])), hardness, 1e9)


def _labels(spec: AnatomySpec, anatomy: Anatomy | None) -> tuple[np.ndarray, Triple, Array, str]:
    """All labels, their spacing, where the first is, and what to call them."""
    if spec.knee is None:
        labels, spacing, corner = section.build(section.load(spec.section))
        return labels, spacing, corner, spec.section
    knee = anatomy or library.load(spec.knee.name, spec.knee.voxel_mm)
    labels, corner = block.cut_out(knee, spec.knee)
    return labels, (spec.knee.voxel_mm,) * 3, corner, knee.name


def _lay_against_bone(volume: Volume, state: VolumeState, elements: Indices) -> None:
    """Break the links of a ligament to anything else but near its ends: there alone it is grown to it."""
    rest = volume.rest(elements)
    along = rest @ lengthwise(rest)
    low, high = float(along.min()), float(along.max())
    middle = elements[np.abs(along - 0.5 * (low + high)) < (0.5 - INSERTION) * (high - low)]
    labels, strides = volume.labels.reshape(-1), grid_strides(volume)
    for d in range(len(STEPS)):
        linked = middle[(state.links[middle] & (1 << d)) != 0]
        others = linked + strides[d]
        apart = labels[others] != labels[linked]
        state.links[linked[apart]] &= np.uint8(0xFF ^ (1 << d))
        state.links[others[apart]] &= np.uint8(0xFF ^ (1 << (d ^ 1)))


def _material(t: TissueSpec) -> Material:
    def along(value: float) -> Triple:
        return (value, value, value)

    return Material(
        name=t.structure,
        stretch=along(t.stretch.value),
        compression=along(t.compression.value),
        shear=along(t.shear.value),
        young_kPa=t.young_kPa.value,
        shear_kPa=t.shear_kPa.value,
        time_constant_s=t.time_constant_s.value,
        colour=structures()[t.structure].colour,
    )
