"""A region of the anatomy as a component of the scene: a volume of elements, what holds it, and what was done to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trainer.anatomy import section
from trainer.anatomy.structures import number_of, structures
from trainer.config import ConfigError
from trainer.curriculum import AnatomySpec, TissueSpec
from trainer.geometry import Array, Rigid
from trainer.mechanics import volume as volumes
from trainer.mechanics.incision import Change
from trainer.mechanics.islands import islands
from trainer.mechanics.volume import FREE, PRESENT, Indices, Material, Triple, Volume, VolumeError, VolumeState

#: Bits of an element that may be moved by whoever holds it.
LOOSE = FREE | PRESENT


@dataclass
class Hold:
    """What one instrument's jaws hold of a structure."""

    structure: str
    elements: Indices  # (k,)
    points: Array  # (k, 3) mm, where they are in the tool's frame
    tacked: bool = False  # since it was taken
    pull_mN: float = 0.0  # of the tissue on it, after the last movement


@dataclass
class Stroke:
    """What the blades of one instrument have cut since they began to close, by structure."""

    elements: dict[str, list[Indices]] = field(default_factory=dict)


@dataclass
class Region:
    """A volume in the scene. Element (0, 0, 0) rests at ``origin``; the axes are the scene's."""

    volume: Volume
    state: VolumeState
    origin: Array  # (3,) mm
    flat: int  # the axis along which there is one layer only, or -1: depth along it does not count
    tissue: dict[str, TissueSpec]  # by structure
    names: dict[int, str]  # of the labels
    elements: dict[str, Indices]  # of each movable structure
    held: list[Hold | None]  # by instrument
    strokes: list[Stroke | None]  # by instrument, while its blades close
    inside: list[str]  # by instrument: the rigid structure that its tip is in, or ""
    tacked: np.ndarray  # (n,) bool, fixed by a tack
    opened: dict[str, Indices] = field(default_factory=dict)  # elements of a structure that lost a link
    severed: set[str] = field(default_factory=set)  # structures that hold together no more
    torn_through: str = ""  # the first structure that was severed by a pull
    pull_max_mN: float = 0.0

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
        index = np.floor((place - self.origin) / np.array(self.volume.spacing_mm) + 0.5).astype(int)
        if (index < 0).any() or (index >= self.volume.shape).any():
            return ""
        return self.names.get(int(self.volume.labels[tuple(index)]), "")

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
        if found:
            self._note_severed()
        return found

    def _note_severed(self) -> None:
        labels = self.volume.labels.reshape(-1)
        parts = [np.unique(labels[part]) for part in islands(self.state, self.volume)]
        for structure, spec in self.tissue.items():
            ends = [number_of(end) for end in spec.grown_to]
            if not any(np.isin(ends, part).sum() > 1 for part in parts):
                self.severed.add(structure)

    def parted_mm(self, structure: str) -> float:
        """How far the cut ends of a severed structure have moved apart, mm; 0 as long as it holds together.

        The mean difference of the displacements of elements that were neighbours and are in different parts now.
        """
        if structure not in self.severed:
            return 0.0
        part = np.empty(self.volume.labels.size, dtype=np.int32)
        for number, elements in enumerate(islands(self.state, self.volume)):
            part[elements] = number
        opened, u = self.opened[structure], self.state.u
        gaps = []
        for step in self.volume.strides:
            pairs = opened[np.isin(opened + step, opened)]
            apart = pairs[part[pairs] != part[pairs + step]]
            gaps.append(np.linalg.norm(u[:, apart + step] - u[:, apart], axis=0))
        found = np.concatenate(gaps)
        return float(found.mean()) if len(found) else 0.0


def build(spec: AnatomySpec, instruments: int) -> Region:
    """The region at rest. Raises ConfigError for an anatomy or structures that are not there."""
    labels, spacing, origin = section.build(section.load(spec.section))
    for tissue in spec.tissue:
        for structure in (tissue.structure, *tissue.grown_to):
            if structure not in structures():
                raise ConfigError(f"unknown structure '{structure}'; known: {', '.join(structures())}")
    free = {number_of(t.structure): _material(t) for t in spec.tissue}
    grown = {(number_of(t.structure), number_of(end)) for t in spec.tissue for end in t.grown_to}
    try:
        volume = volumes.build(labels, spacing, free, grown)
    except VolumeError as error:
        raise ConfigError(f"anatomy '{spec.section}': {error}") from None
    flat_labels = labels.reshape(-1)
    thin = [axis for axis, n in enumerate(labels.shape) if n == 1]
    return Region(
        volume=volume,
        state=volumes.start(volume),
        origin=origin,
        flat=thin[0] if thin else -1,
        tissue={t.structure: t for t in spec.tissue},
        names={s.number: name for name, s in structures().items()},
        elements={
            t.structure: np.flatnonzero(flat_labels == number_of(t.structure)).astype(np.int32) for t in spec.tissue
        },
        held=[None] * instruments,
        strokes=[None] * instruments,
        inside=[""] * instruments,
        tacked=np.zeros(labels.size, dtype=bool),
    )


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
