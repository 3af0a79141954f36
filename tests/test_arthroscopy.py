"""The arthroscopic scene: a ligament is grasped, pulled, tacked and cut; what holds in whatever hands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from performing import Performance, perform, region_of

from trainer import curriculum, scene
from trainer.config import ConfigError
from trainer.curriculum import TISSUE_STEPS, load_task
from trainer.drivers import scripted_hands
from trainer.events import Cut, Event, Grasp, Probe, StepDone, Tack
from trainer.poses import ToolPoses
from trainer.profile import Hand

LIGAMENT = load_task("arthroscopy/ligament-2d").task
PCL = "posterior cruciate ligament"
LEFT, RIGHT = 0, 1


@pytest.fixture(scope="module")
def expert() -> Performance:
    return perform(LIGAMENT, "scripted-expert")


def kinds(events: Iterable[Event]) -> list[str]:
    return [e.kind for e in events]


def test_the_expert_completes_every_step_in_order(expert: Performance) -> None:
    assert expert.scene.outcome == "completed"
    assert [e.index for e in expert.events if isinstance(e, StepDone)] == list(range(len(LIGAMENT.step)))
    assert {s.kind for s in LIGAMENT.step} == set(TISSUE_STEPS)
    found = kinds(expert.events)
    assert found.index("grasp") < found.index("tack") < found.index("release") < found.index("cut")
    assert not {"tear", "slip", "overforce", "probe"} & set(found)


def test_volumes_are_whole_elements_and_the_cut_lies_on_the_femurs_side(expert: Performance) -> None:
    """An element is 1 by 1 by 6 mm; between tack and femur is above the grasped place."""
    sizes = [
        e.volume_mm3 / region_of(expert.scene).volume.element_mm3 for e in expert.events if isinstance(e, Cut | Tack)
    ]
    assert all(size == round(size) > 0 for size in sizes)
    grasped = next(e for e in expert.events if isinstance(e, Grasp))
    assert all(e.point[1] > grasped.point[1] for e in expert.events if isinstance(e, Cut))


def test_cut_tissue_springs_back(expert: Performance) -> None:
    """What was pulled by 3 mm and is cut off from the tack is within half of that from where it rests."""
    region = region_of(expert.scene)
    elements = region.elements[PCL]
    stump = elements[region.rest(elements)[:, 1] > -3.0]
    assert region.severed == {PCL}
    assert region.displaced_mm(stump) < 0.5 * LIGAMENT.step[1].at_least_mm
    assert region.parted_mm(PCL) >= LIGAMENT.step[-1].at_least_mm


def test_a_novice_is_worse(expert: Performance) -> None:
    """Longer, and with faults that the expert does not make."""
    novice = perform(LIGAMENT, "scripted-novice", seed=1)
    assert novice.scene.tick > 2 * expert.scene.tick
    assert {"tear", "slip", "overforce", "probe"} & set(kinds(novice.events))


def test_the_same_poses_give_the_same_events(expert: Performance) -> None:
    again = scene.build(LIGAMENT)
    assert tuple(e for p in expert.poses for e in again.step(p)) == expert.events
    assert np.array_equal(region_of(again).state.u, region_of(expert.scene).state.u)


def test_where_the_scene_stands_changes_nothing_that_happens(expert: Performance) -> None:
    """Poses that are turned with the scene give the same kinds at the same ticks: it is simulated in its own frame."""
    spec = replace(LIGAMENT.scene, position_mm=(100.0, -50.0, 30.0), rotation_deg=(20.0, -40.0, 70.0))
    moved = perform(replace(LIGAMENT, scene=spec, step=LIGAMENT.step[:1]), "scripted-expert")
    grasp = next(e for e in moved.events if isinstance(e, Grasp))
    world = moved.scene.world.scene_from_world
    assert world.apply(np.array(grasp.point)) == pytest.approx((-4.0, -14.0, 0.0), abs=1.5)


def poses(s: scene.Scene, tool: int, place: tuple[float, float, float], closure: float) -> ToolPoses:
    now = s.view().poses
    position, jaws = now.position.copy(), now.closure.copy()
    position[tool], jaws[tool] = place, closure
    return ToolPoses(position, now.quaternion, jaws, np.ones(2, dtype=bool))


def test_a_tip_in_bone_is_told_once_for_each_visit() -> None:
    s = scene.build(LIGAMENT)
    found: list[Event] = []
    for place in ((6.0, 14.0, 0.0), (6.0, 15.0, 0.0), (28.0, -16.0, 0.0), (6.0, 14.0, 0.0)):
        found += s.step(poses(s, LEFT, place, 0.0))
    assert [e.tool for e in found if isinstance(e, Probe) and e.body == "femur"] == ["left"] * 2


def test_depth_does_not_count_in_one_layer() -> None:
    """A grasp 50 mm above the drawing holds what one in it does, and nothing leaves the layer when it is pulled."""
    s = scene.build(LIGAMENT)
    s.step(poses(s, LEFT, (-4.0, -14.0, 50.0), 0.0))
    s.step(poses(s, LEFT, (-4.0, -14.0, 50.0), 0.9))
    assert s.view().tissue_holders == (LEFT,)
    for k in range(5):
        s.step(poses(s, LEFT, (-4.0 + 0.1 * k, -14.0, 50.0 - k), 0.9))
    assert not region_of(s).state.u[2].any()
    assert region_of(s).state.u[0].max() == pytest.approx(0.4, abs=1e-6)


def test_a_tack_holds_and_a_new_grasp_takes_it_out() -> None:
    s = scene.build(LIGAMENT)
    place = (-4.0, -14.0, 0.0)
    for closure in (0.0, 0.9, 1.0, 0.0):
        s.step(poses(s, LEFT, place, closure))
    region = region_of(s)
    assert region.tacked.any()
    for closure in (0.9, 0.0):
        s.step(poses(s, LEFT, place, closure))
    assert not region.tacked.any()
    assert region.state.free_count == len(region.elements[PCL])


def test_a_leap_of_a_hundred_elements_tears_or_slips_and_stays_finite() -> None:
    s = scene.build(LIGAMENT)
    for closure in (0.0, 0.9):
        s.step(poses(s, LEFT, (-4.0, -14.0, 0.0), closure))
    events = s.step(poses(s, LEFT, (96.0, -14.0, 0.0), 0.9))
    assert {"slip", "tear"} & {e.kind for e in events}
    assert np.isfinite(region_of(s).state.u).all()


def test_a_ligament_torn_through_is_a_failure() -> None:
    hasty = Hand(speed_mm_s=20.0)
    firm = replace(LIGAMENT.scene.instrument[0], grip_mN=replace(LIGAMENT.scene.instrument[0].grip_mN, value=1e6))
    step = replace(LIGAMENT.step[1], place_mm=(40.0, -30.0, 0.0), at_least_mm=40.0)
    task = replace(LIGAMENT, scene=replace(LIGAMENT.scene, instrument=(firm, LIGAMENT.scene.instrument[1])),
                   step=(LIGAMENT.step[0], step))  # fmt: skip
    s = scene.build(task)
    hands = scripted_hands(hasty, task, s.home, 0)
    while not s.outcome:
        seen = hands.poll(s.tick, s.view())
        assert seen is not None
        s.step(seen)
    assert (s.outcome, s.reason) == ("failed", f"the {PCL} tore through")


WRONG = [
    (f'structure = "{PCL}"\nplace', 'structure = "femur"\nplace', "names no movable structure of the scene: 'femur'"),
    ("tack_at = 0.97", "tack_at = 0.6", "'tack_at' is for a grasper, and greater than 'close_at'"),
    ("stretch = { value = 1.5", "stretch = { value = 0.5", "stretch' must be >= 1"),
    ("tack_at = 0.97", "", "step 'tack it there' needs a grasper with 'tack_at'"),
    ('kind = "scissors"', 'kind = "grasper"', "step 'cut it through between tack and femur' needs an instrument of"),
    ('kind = "scissors"', 'kind = "saw"', "must be one of 'forceps', 'grasper', 'scissors', 'probe', found 'saw'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[new for _, new, _ in WRONG])
def test_a_wrong_task_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    text = load_task("arthroscopy/ligament-2d").text
    assert old in text
    with pytest.raises(ConfigError, match=r"^t\.toml: ") as caught:
        curriculum.parse_task(text.replace(old, new, 1), "t.toml")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('section = "sagittal"', 'section = "axial"', "no built-in section 'axial'; there is sagittal"),
        ('grown_to = ["femur", "tibia"]', 'grown_to = ["femur", "tibula"]', "unknown structure 'tibula'"),
    ],
)
def test_an_anatomy_that_is_not_there_is_named(old: str, new: str, message: str) -> None:
    text = load_task("arthroscopy/ligament-2d").text.replace(old, new, 1)
    with pytest.raises(ConfigError, match=message):
        scene.build(curriculum.parse_task(text, "t.toml"))
