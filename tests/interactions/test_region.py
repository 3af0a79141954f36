"""A region of the anatomy: what hangs together in it, and which tasks fit it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainer import curriculum, scene
from trainer.anatomy.imported import Anatomy
from trainer.anatomy.label_volume import LabelVolume
from trainer.anatomy.structures import number_of
from trainer.config import ConfigError
from trainer.curriculum import Task, load_task
from trainer.geometry import Rigid
from trainer.interactions import sight
from trainer.interactions.region import Region
from trainer.mechanics.incision import cut

RELEASE = load_task("arthroscopy/ligament-release")
PCL, ACL = "posterior cruciate ligament", "anterior cruciate ligament"


def two_bridges(apart: int = 1, to_tibia: bool = True, tall: int = 6) -> Anatomy:
    """Femur above tibia and between them two columns, 3 by 3 mm and so tall, so many voxels apart."""
    labels = np.zeros((7 + apart, 7, 8 + tall), np.uint8)
    labels[:, :, :4], labels[:, :, 4 + tall :] = number_of("tibia"), number_of("femur")
    labels[:3, 2:5, 4 : 4 + tall] = number_of(PCL)
    labels[3 + apart : 6 + apart, 2:5, 4 if to_tibia else 5 : 4 + tall] = number_of(ACL)
    still = Rigid(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    return Anatomy("two bridges", LabelVolume(labels, (1.0, 1.0, 1.0), still), "right", "two bridges")


def task_with(step: str, *movable: str, kind: str = "cut", side_mm: tuple[float, float, float] = (8.0,) * 3) -> Task:
    """The release of a ligament about the PCL, but only its step of a ``kind``, with so many movable."""
    task = RELEASE.task
    anatomy = task.scene.anatomy
    assert anatomy is not None
    assert anatomy.knee is not None
    tissue = tuple(replace(anatomy.tissue[0], structure=name) for name in movable)
    low = (-side_mm[0], -side_mm[1], -side_mm[2])
    knee = replace(anatomy.knee, axis="up", low_mm=low, high_mm=side_mm)
    steps = tuple(replace(s, structure=step) for s in task.step if s.kind == kind)
    return replace(task, step=steps, scene=replace(task.scene, anatomy=replace(anatomy, tissue=tissue, knee=knee)))


def region_of(task: Task, anatomy: Anatomy) -> Region:
    region = scene.build(task, anatomy=anatomy).world.region
    assert region is not None
    return region


def knife(region: Region, before: float, after: float) -> None:
    """An edge along x just above the middle of the PCL, from one z to another; the ACL is beyond z = -2."""
    edges = [np.array([[-4.0, 0.25, z], [4.0, 0.25, z]]) - region.origin for z in (before, after)]
    region.note(cut(region.volume, region.state, *edges))


@pytest.mark.parametrize("apart", [0, 1], ids=["side by side", "apart"])
def test_what_is_cut_through_is_severed_though_another_structure_leads_across(apart: int) -> None:
    """Also where the other one has grown together with both stumps. The stumps part by what one of them is moved."""
    region = region_of(task_with(PCL, PCL, ACL), two_bridges(apart))
    knife(region, 2.0, 0.0)
    assert set(region.opened) == {PCL}
    assert not region.severed
    knife(region, 0.0, -1.75)
    assert region.severed == {PCL}
    assert region.parted_mm(PCL) == 0.0
    elements = region.elements[PCL]
    region.state.u[1, elements[region.rest(elements)[:, 1] > 0.0]] = 2.0
    assert region.parted_mm(PCL) == 2.0


def test_a_cut_of_one_structure_says_nothing_of_another() -> None:
    """One that is grown to nothing where the task takes place is not severed by any cut, nor torn through."""
    region = region_of(task_with(PCL, PCL, ACL), two_bridges(to_tibia=False))
    knife(region, 2.0, -1.75)
    assert region.severed == {PCL}
    knife(region, -1.75, -4.0)
    assert set(region.opened) == {PCL, ACL}
    assert region.severed == {PCL}


def test_a_structure_that_joins_nothing_cannot_be_asked_to_be_cut() -> None:
    wrong = f"anatomy 'two bridges': the {ACL} does not join femur and tibia, so that it cannot be cut through$"
    with pytest.raises(ConfigError, match=wrong):
        scene.build(task_with(ACL, PCL, ACL), anatomy=two_bridges(to_tibia=False))


def test_a_structure_that_fills_the_block_has_no_neighbours_round_its_sides() -> None:
    """The block is as thick along z, the fastest index, as the ligament: a row's last element comes before the next
    row's first. The stumps part by 2, 3 and 4 mm in the three layers."""
    region = region_of(task_with(PCL, PCL, side_mm=(8.0, 8.0, 1.5)), two_bridges())
    assert region.volume.shape[2] == 3
    knife(region, 2.0, -2.0)
    elements = region.elements[PCL]
    upper = elements[region.rest(elements)[:, 1] > 0.0]
    region.state.u[1, upper] = 3.0 + region.rest(upper)[:, 2]
    assert region.parted_mm(PCL) == pytest.approx(3.0, abs=1e-6)  # float32 displacements


def test_a_cut_at_one_end_of_a_block_is_not_seen_at_the_other() -> None:
    """The ligament goes on to both sides of the block along y: from the highest row a step up is no row lower down."""
    task = task_with(PCL, PCL, kind="grasp", side_mm=(1.5, 6.0, 1.5))
    region = region_of(task, two_bridges(tall=12))
    assert region.volume.shape == (3, 12, 3)
    high = np.array([0.0, 3.5, 0.0])
    whole = sight.uncut_at(region, PCL, high)
    assert len(whole)
    edges = [np.array([[-4.0, -4.75, z], [4.0, -4.75, z]]) - region.origin for z in (2.0, -2.0)]
    region.note(cut(region.volume, region.state, *edges))
    assert region.opened[PCL].size
    assert np.array_equal(sight.uncut_at(region, PCL, high), whole)
    assert not sight.uncut_at(region, PCL, np.array([0.0, -4.0, 0.0])).size


@pytest.mark.parametrize("ends", ['["tibia"]', "[]", '["tibia", "tibia"]'])
def test_a_cut_through_needs_two_ends(ends: str) -> None:
    text = RELEASE.text.replace('grown_to = ["femur", "tibia"]', f"grown_to = {ends}")
    wrong = rf"^t\.toml: .*step 'cut .*: 'grown_to' of the {PCL} must name both"
    with pytest.raises(ConfigError, match=wrong) as caught:
        curriculum.parse_task(text, "t.toml")
    assert "\n" not in str(caught.value)
