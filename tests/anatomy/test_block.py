"""Blocks cut out of a knee along the axes of a scene; what tells one knee from another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.anatomy import block, library
from trainer.anatomy.imported import Anatomy
from trainer.anatomy.structures import number_of
from trainer.config import ConfigError
from trainer.curriculum import KneeSpec
from trainer.geometry import quaternion_from_euler_deg, quaternion_multiply

ACL = "anterior cruciate ligament"
SPEC = KneeSpec("knee", ACL, "up", 2.0, (-30.0, -30.0, -30.0), (40.0, 30.0, 30.0))


@pytest.fixture(scope="module")
def built() -> Anatomy:
    return library.load("knee", 2.0)


@settings(max_examples=25, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-40.0, 40.0)] * 3), axis=st.sampled_from(["up", "along"]), place=st.integers(0, 10**6)
)
def test_each_element_has_the_label_of_the_voxel_it_lies_in(
    built: Anatomy, turn: tuple[float, float, float], axis: str, place: int
) -> None:
    """Also of a scan whose axes lie obliquely in the patient: looked up one by one through the patient's frame."""
    volume = built.volume
    oblique = quaternion_multiply(quaternion_from_euler_deg(turn), volume.lps_from_volume.quaternion)
    turned = replace(built, volume=replace(volume, lps_from_volume=replace(volume.lps_from_volume, quaternion=oblique)))
    spec = replace(SPEC, axis=axis)
    labels, corner = block.cut_out(turned, spec)
    index = np.unravel_index(place % labels.size, labels.shape)
    lps = block.lps_from_scene(turned, spec).apply(corner + 2.0 * np.array(index))
    voxel = turned.volume.lps_from_volume.inverse().apply(lps) / 2.0 + 0.5
    if np.abs(voxel - np.round(voxel)).min() < 1e-6:
        return  # on the border of two voxels rounding decides
    i = np.floor(voxel).astype(int)
    inside = bool(((i >= 0) & (i < volume.labels.shape)).all())
    assert labels[index] == (volume.labels[tuple(i)] if inside else 0)


def test_the_scene_has_the_structure_in_its_middle_and_the_patella_in_front(built: Anatomy) -> None:
    """The mean of a structure's elements is its middle to a voxel; x runs to the front, y up."""
    labels, corner = block.cut_out(built, SPEC)
    assert np.abs((corner + 2.0 * np.argwhere(labels == number_of(ACL))).mean(axis=0)).max() < 2.0
    femur, tibia, cartilage = (
        (corner + 2.0 * np.argwhere(labels == number_of(name))).mean(axis=0)
        for name in ("femur", "tibia", "femoral cartilage")
    )
    assert femur[1] > 10.0 > -10.0 > tibia[1]
    assert cartilage[0] > femur[0]


def test_a_knee_without_the_structure_is_refused(built: Anatomy) -> None:
    with pytest.raises(ConfigError, match=r"^unknown structure 'achilles tendon'; known: femur, "):
        block.cut_out(built, replace(SPEC, about="achilles tendon"))


def test_the_fingerprint_is_that_of_labels_place_and_side(built: Anatomy) -> None:
    same = library.fingerprint(library.load("knee", 2.0))
    assert library.fingerprint(built) == same
    labels = built.volume.labels.copy()
    labels[0, 0, 0] ^= 1
    moved = replace(built.volume.lps_from_volume, position=built.volume.lps_from_volume.position + 1e-9)
    others = (
        replace(built, side="left"),
        replace(built, volume=replace(built.volume, labels=labels)),
        replace(built, volume=replace(built.volume, lps_from_volume=moved)),
    )
    assert len({same, *map(library.fingerprint, others)}) == 4
