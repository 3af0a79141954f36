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
from trainer.interactions.region import Region
from trainer.mechanics.incision import cut

RELEASE = load_task("arthroscopy/ligament-release")
PCL, ACL = "posterior cruciate ligament", "anterior cruciate ligament"


def two_bridges(apart: int = 1, to_tibia: bool = True) -> Anatomy:
    """Femur above tibia and between them two columns, 3 by 3 by 6 mm, so many voxels apart."""
    labels = np.zeros((7 + apart, 7, 14), np.uint8)
    labels[:, :, :4], labels[:, :, 10:] = number_of("tibia"), number_of("femur")
    labels[:3, 2:5, 4:10] = number_of(PCL)
    labels[3 + apart : 6 + apart, 2:5, 4 if to_tibia else 5 : 10] = number_of(ACL)
    still = Rigid(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    return Anatomy("two bridges", LabelVolume(labels, (1.0, 1.0, 1.0), still), "right", "two bridges")


def task_with(step: str, *movable: str) -> Task:
    """The release of a ligament about the PCL, cut down to its ``cut`` of ``step``, with so many movable."""
    task = RELEASE.task
    anatomy = task.scene.anatomy
    assert anatomy is not None
    assert anatomy.knee is not None
    tissue = tuple(replace(anatomy.tissue[0], structure=name) for name in movable)
    knee = replace(anatomy.knee, axis="up", low_mm=(-8.0,) * 3, high_mm=(8.0,) * 3)
    steps = tuple(replace(s, structure=step) for s in task.step if s.kind == "cut")
    return replace(task, step=steps, scene=replace(task.scene, anatomy=replace(anatomy, tissue=tissue, knee=knee)))


def region_with(anatomy: Anatomy, step: str, *movable: str) -> Region:
    region = scene.build(task_with(step, *movable), anatomy=anatomy).world.region
    assert region is not None
    return region


def knife(region: Region, before: float, after: float) -> None:
    """An edge along x just above the middle of the PCL, from one z to another; the ACL is beyond z = -2."""
    edges = [np.array([[-4.0, 0.25, z], [4.0, 0.25, z]]) - region.origin for z in (before, after)]
    region.note(cut(region.volume, region.state, *edges))


@pytest.mark.parametrize("apart", [0, 1], ids=["side by side", "apart"])
def test_what_is_cut_through_is_severed_though_another_structure_leads_across(apart: int) -> None:
    """Also where the other one has grown together with both stumps. The stumps part by what one of them is moved."""
    region = region_with(two_bridges(apart), PCL, PCL, ACL)
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
    region = region_with(two_bridges(to_tibia=False), PCL, PCL, ACL)
    knife(region, 2.0, -1.75)
    assert region.severed == {PCL}
    knife(region, -1.75, -4.0)
    assert set(region.opened) == {PCL, ACL}
    assert region.severed == {PCL}


def test_a_structure_that_joins_nothing_cannot_be_asked_to_be_cut() -> None:
    wrong = f"^anatomy 'two bridges': the {ACL} does not join femur and tibia, so that it cannot be cut through$"
    with pytest.raises(ConfigError, match=wrong):
        scene.build(task_with(ACL, PCL, ACL), anatomy=two_bridges(to_tibia=False))


@pytest.mark.parametrize("ends", ['["tibia"]', "[]", '["tibia", "tibia"]'])
def test_a_cut_through_needs_two_ends(ends: str) -> None:
    text = RELEASE.text.replace('grown_to = ["femur", "tibia"]', f"grown_to = {ends}")
    wrong = rf"^t\.toml: .*step 'cut .*: 'grown_to' of the {PCL} must name both"
    with pytest.raises(ConfigError, match=wrong) as caught:
        curriculum.parse_task(text, "t.toml")
    assert "\n" not in str(caught.value)
