"""Tasks in a knee of three dimensions, built-in and real: scripted hands, and what holds in whatever hands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from performing import Performance, perform, record_of, region_of

from trainer import curriculum, scene
from trainer.anatomy import knee, label_map, library, volume_file
from trainer.anatomy.imported import Anatomy
from trainer.anatomy.label_volume import sorted_axes
from trainer.anatomy.ligaments import swept_cruciates
from trainer.config import ConfigError
from trainer.curriculum import Task, load_task
from trainer.events import Cut, Event, Overforce, PortalEnter, PortalExit, Probe, StepDone
from trainer.geometry import Array
from trainer.mechanics.density_field import REACH, WEIGHTS
from trainer.mechanics.volume import FREE, PRESENT
from trainer.metrics import score
from trainer.poses import ToolPoses

REAL = Path(__file__).parents[2] / "shared/data/knee/SAG_3D_DESS_RIGHT_bones_cart_men_fib-label.nrrd"
real_knee = pytest.mark.skipif(not REAL.exists(), reason="the segmented knee of shared/data is not here")
RELEASE = load_task("arthroscopy/ligament-release").task
LANDMARKS = load_task("arthroscopy/probe-landmarks").task
PCL, ACL = "posterior cruciate ligament", "anterior cruciate ligament"


@pytest.fixture(scope="module")
def built() -> Anatomy:
    return library.load("knee", 1.0)


@pytest.fixture(scope="module")
def real() -> Anatomy:
    """The scan as ``anatomy import`` keeps it, without its surfaces."""
    given = label_map.read(Path("mskt"))
    volume, swept, _ = swept_cruciates(sorted_axes(volume_file.read(REAL), given.renumber()), "right")
    assert set(swept) == {PCL, ACL}
    return Anatomy("real", volume, "right", "real")


def metrics(done: Performance, task: Task) -> dict[str, float | None]:
    return {m.name: m.value for m in score(record_of(done, task), task)}


def check_release(done: Performance) -> None:
    """Every step, nothing torn, the cut between tack and femur; what was pulled by 3 mm is on the femur's side within
    half of that from where it rests, and apart from the rest."""
    assert done.done.outcome == "completed"
    assert [e.index for e in done.events if isinstance(e, StepDone)] == list(range(len(RELEASE.step)))
    assert not {"tear", "slip", "overforce"} & {e.kind for e in done.events}
    region = region_of(done.scene)
    assert region.severed == {PCL}
    assert all(done.scene.world.scene_from_world.apply(np.array(e.point))[1] > 2.0
               for e in done.events if isinstance(e, Cut))  # fmt: skip
    elements = region.elements[PCL]
    assert region.displaced_mm(elements[region.rest(elements)[:, 1] > 8.0]) < 0.5 * RELEASE.step[1].at_least_mm
    assert region.parted_mm(PCL) >= RELEASE.step[-1].at_least_mm


@pytest.fixture(scope="module")
def released(built: Anatomy) -> Performance:
    return perform(RELEASE, "scripted-expert", anatomy=built)


def test_the_expert_releases_the_ligament_of_the_built_in_knee(released: Performance) -> None:
    check_release(released)
    assert metrics(released, RELEASE)["structures_touched_count"] == 1.0


@real_knee
@pytest.mark.parametrize("seed", [0, 3, 9])
def test_the_expert_releases_the_ligament_of_the_real_knee_and_touches_no_bone(real: Anatomy, seed: int) -> None:
    """The femur lies in front of a third of the ligament; seed 9 leaves strands at several levels."""
    done = perform(RELEASE, "scripted-expert", seed, anatomy=real)
    check_release(done)
    assert metrics(done, RELEASE)["iatrogenic_contact_count"] == 0.0


@pytest.fixture(scope="module")
def probed(built: Anatomy) -> Performance:
    return perform(LANDMARKS, "scripted-expert", anatomy=built)


def check_landmarks(done: Performance) -> None:
    """Each landmark in order through the portal, nothing else, and no force above the task's limit."""
    assert done.done.outcome == "completed"
    assert [e.body for e in done.events if isinstance(e, Probe)] == [s.structure for s in LANDMARKS.step]
    assert isinstance(done.events[1], PortalEnter)
    assert 0.0 < done.done.press_max_mN <= LANDMARKS.limits["probe_force"].value
    assert "overforce" not in {e.kind for e in done.events}


def test_the_expert_touches_the_landmarks_of_the_built_in_knee(probed: Performance) -> None:
    check_landmarks(probed)


@real_knee
def test_the_expert_touches_the_landmarks_of_the_real_knee(real: Anatomy) -> None:
    check_landmarks(perform(LANDMARKS, "scripted-expert", anatomy=real))


def test_a_novice_is_worse_at_the_landmarks(built: Anatomy, probed: Performance) -> None:
    """Longer, further, harder: of a hand that hesitates, makes detours and stops late."""
    expert = metrics(probed, LANDMARKS)
    novice = metrics(perform(LANDMARKS, "scripted-novice", anatomy=built), LANDMARKS)
    for name in ("time_s", "path_length_right_mm", "probe_force_max_mN"):
        a, b = expert[name], novice[name]
        assert a is not None
        assert b is not None
        assert b > 1.5 * a, name


def test_the_same_poses_give_the_same_events(probed: Performance, built: Anatomy) -> None:
    again = scene.build(LANDMARKS, anatomy=built)
    assert tuple(e for p in probed.poses for e in again.step(ToolPoses.unpack(p.pack()))) == probed.events
    assert np.array_equal(region_of(again).state.u, region_of(probed.scene).state.u)


def test_a_left_knee_can_be_probed_too(tmp_path: Path) -> None:
    path = tmp_path / "left.toml"
    text = (Path(knee.__file__).parent / "data/knees/knee.toml").read_text()
    path.write_text(text.replace('side = "right"', 'side = "left"'))
    left = Anatomy("left", knee.build(knee.load(str(path)), 1.0), "left", "left")
    done = perform(replace(LANDMARKS, step=LANDMARKS.step[:2]), "scripted-expert", anatomy=left)
    assert done.done.outcome == "completed"


def to(s: scene.Scene, places: Array, closure: float = 0.0) -> ToolPoses:
    """The first instrument at ``places`` (3,) mm of the scene, the others where they are."""
    now = s.view().poses
    position, jaws = now.position.copy(), now.closure.copy()
    position[0], jaws[0] = s.world.world_from_scene.apply(places), closure
    return ToolPoses(position, now.quaternion, jaws, np.ones(len(jaws), dtype=bool))


def test_a_shaft_goes_through_its_portal_whatever_the_device_says(built: Anatomy) -> None:
    """Inside, portal and tip lie on the instrument's x axis (to rounding: 1e-9 mm), and the tip is the device's."""
    s = scene.build(LANDMARKS, anatomy=built)
    portal = np.array(LANDMARKS.scene.instrument[0].portal_mm)
    rng = np.random.default_rng(5)
    for _ in range(20):
        tip = rng.uniform(-15.0, 15.0, 3)
        s.step(to(s, tip))
        pose = s.world.jaws[0].pose
        assert pose.position == pytest.approx(tip, abs=1e-9)
        back = pose.inverse().apply(portal)
        assert back[0] < 0.0
        assert np.abs(back[1:]).max() < 1e-9


def test_a_tip_that_trembles_in_a_portal_goes_in_once(built: Anatomy) -> None:
    s = scene.build(LANDMARKS, anatomy=built)
    portal = np.array(LANDMARKS.scene.instrument[0].portal_mm)
    out = portal / np.linalg.norm(portal)
    found: list[Event] = []
    for deep in (-5.0, 0.2, -0.3, 0.1, -0.5, 3.0, 0.1, -0.9, -1.5, -5.0):
        found += s.step(to(s, portal - deep * out))
    assert [type(e) for e in found if isinstance(e, PortalEnter | PortalExit)] == [PortalEnter, PortalExit]


def test_soft_tissue_presses_back_the_harder_the_deeper_and_comes_back(built: Anatomy) -> None:
    """A ball pressed into the ligament from the front: the force grows with the way, and no element is left in the
    ball; where the ball is gone for ten times as long as the ligament needs (assumed 2 s), all is back to a hundredth
    of the push and nothing is felt."""
    task = replace(LANDMARKS, time_limit_s=1000.0, scene=replace(LANDMARKS.scene, anatomy=replace(
        LANDMARKS.scene.anatomy, hardness_mN_per_mm=None)))  # fmt: skip
    s = scene.build(task, anatomy=built)
    region = region_of(s)
    elements = region.elements[ACL]
    rest = region.rest(elements)
    middle = rest[np.argmin(np.linalg.norm(rest - rest.mean(axis=0), axis=1))]
    line = rest[(np.abs(rest[:, 1:] - middle[1:]) < 0.1).all(axis=1)]
    surface = line[np.argmax(line[:, 0])]
    forces = []
    for deep in (0.2, 0.6, 1.0):
        tip = surface + np.array([1.0 - deep, 0.0, 0.0])
        s.step(to(s, tip))
        forces.append(region.touch[0].force_mN)
        assert np.linalg.norm(region.places(elements) - tip, axis=1).min() >= 1.0 - 1e-5  # float32 of the places
    assert 0.0 < forces[0] < forces[1] < forces[2]
    assert region.inside == [ACL]
    s.step(to(s, np.array([50.0, 0.0, 0.0])))
    assert region.touch[0].force_mN == 0.0
    for _ in range(2000):
        s.step(to(s, np.array([50.0, 0.0, 0.0])))
    assert np.abs(region.state.u).max() < 0.01
    assert region.state.free_count == len(elements)


def test_hard_tissue_presses_back_by_its_density_field(built: Anatomy) -> None:
    """Where all is femur for three voxels around, the density is 1 and the force hardness times spacing over the
    Gaussian's middle weight (float32 densities: 1e-6); on the way there it rises above the limit."""
    s = scene.build(LANDMARKS, anatomy=built)
    region = region_of(s)
    femur = region.labels == 1
    deep = np.argwhere(sliding_window_view(femur, (7, 7, 7)).all(axis=(3, 4, 5)))[0] + 3
    events = [e for way in (-40.0, -20.0, 0.0) for e in s.step(to(s, region.corner + deep + np.array([way, 0.0, 0.0])))]
    limit = LANDMARKS.limits["probe_force"].value
    assert region.touch[0].force_mN == pytest.approx(1000.0 / WEIGHTS[REACH], rel=1e-6)
    assert region.inside == ["femur"]
    over = [e for e in events if isinstance(e, Overforce)]
    assert over
    assert all(e.value > limit == e.limit for e in over)


def test_a_ligament_is_grown_to_bone_near_its_ends_alone(built: Anatomy) -> None:
    """No link leads from the middle half of the ligament to anything else, and from both ends some do."""
    region = region_of(scene.build(RELEASE, anatomy=built))
    elements, labels = region.elements[PCL], region.volume.labels.reshape(-1)
    along = region.rest(elements)[:, 1]
    grown = np.zeros(len(elements), dtype=bool)
    for d, stride in enumerate(s * x for x in region.volume.strides for s in (1, -1)):
        linked = (region.state.links[elements] & (1 << d)) != 0
        grown |= linked & (labels[np.where(linked, elements + stride, elements)] != labels[elements])
    low, high = along.min(), along.max()
    assert grown[along < low + 0.2 * (high - low)].any()
    assert grown[along > high - 0.2 * (high - low)].any()
    assert not grown[np.abs(along - 0.5 * (low + high)) < 0.2 * (high - low)].any()
    assert region.state.free_count == len(elements)
    assert ((region.state.links[elements] & (FREE | PRESENT)) == (FREE | PRESENT)).all()


def test_an_anatomy_without_the_structure_is_refused_in_one_line(built: Anatomy) -> None:
    labels = np.where(built.volume.labels == 12, 0, built.volume.labels).astype(np.uint8)
    without = replace(built, volume=replace(built.volume, labels=labels))
    message = f"^task 'ligament-release': anatomy 'knee' has no {PCL}, around which the task's scene lies$"
    with pytest.raises(ConfigError, match=message):
        scene.build(RELEASE, anatomy=without)
    labels = np.where(built.volume.labels == 9, 0, built.volume.labels).astype(np.uint8)
    with pytest.raises(ConfigError, match=r"^task 'probe-landmarks': anatomy 'knee' has no medial meniscus where .*$"):
        scene.build(LANDMARKS, anatomy=replace(built, volume=replace(built.volume, labels=labels)))


WRONG = [
    ('axis = "up"', 'axis = "down"', "must be one of 'up', 'along', found 'down'"),
    ("voxel_mm = 1.0", "voxel_mm = 0.0", "'scene.anatomy.knee.voxel_mm' must be >= 0.2 and <= 2, found 0"),
    ("high_mm = [60.0", "high_mm = [-60.0", "'high_mm' must be greater than 'low_mm'"),
    ("low_mm = [-40.0", "low_mm = [-4e4", "a block has at most 10000000 elements: 'voxel_mm' is too small"),
    ("[scene.anatomy]\n", '[scene.anatomy]\nsection = "sagittal"\n', "an anatomy is either a 'section' or a 'knee'"),
    ("portal_mm = [30.0, -6.0, 8.0]", "portal_mm = [0.0, 0.0, 0.0]", "'portal_mm' must be at least 1 mm from"),
    ('kind = "probe"\nportal', 'kind = "scissors"\nportal', "needs an 'anatomy' and an instrument of kind 'probe'"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[new for _, new, _ in WRONG])
def test_a_wrong_task_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    text = load_task("arthroscopy/probe-landmarks").text
    assert old in text
    with pytest.raises(ConfigError, match=r"^t\.toml: ") as caught:
        curriculum.parse_task(text.replace(old, new, 1), "t.toml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
