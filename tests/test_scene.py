"""What a scene does with two instruments: grasping, pulling, breaking, losing, and never leaving the rails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from allocations import kept_bytes
from performing import one_drive, perform

from trainer import scene
from trainer.curriculum import Task, load_task
from trainer.drivers import scripted_hands
from trainer.drivers.scripted import ScriptedHands
from trainer.events import Event, Grasp, Pierce, Tear, TrackingLost
from trainer.geometry import Array, Rigid, quaternion_multiply, slerp
from trainer.interactions import thread_pull
from trainer.interactions.thread_pull import stretch
from trainer.poses import ToolPoses
from trainer.profile import Hand, load_profile
from trainer.scene import Scene

STITCH = load_task("anastomosis/single-stitch").task
LEFT, RIGHT = 0, 1


def poses(s: Scene, tool: int, position: Array, closure: float, valid: bool = True) -> ToolPoses:
    """The instruments where they are, but ``tool`` at ``position`` with its jaws at ``closure``."""
    now = s.view().poses
    place, jaws, seen = now.position.copy(), now.closure.copy(), np.ones(2, dtype=bool)
    place[tool], jaws[tool], seen[tool] = position, closure, valid
    return ToolPoses(place, now.quaternion, jaws, seen)


def at(s: Scene, tool: int) -> Array:
    return np.asarray(s.view().poses.position[tool])


def go(s: Scene, tool: int, to: Array, closure: float, step_mm: float = 0.05) -> list[Event]:
    """Move an instrument straight to a place, ``step_mm`` at a tick."""
    start = at(s, tool)
    ticks = max(1, int(np.ceil(np.linalg.norm(to - start) / step_mm)))
    events: list[Event] = []
    for k in range(1, ticks + 1):
        if not s.outcome:
            events += s.step(poses(s, tool, start + k / ticks * (to - start), closure))
    return events


def close(s: Scene, tool: int, closure: float, ticks: int = 10) -> list[Event]:
    start = float(s.view().poses.closure[tool])
    return [
        e
        for k in range(1, ticks + 1)
        for e in s.step(poses(s, tool, at(s, tool), start + k / ticks * (closure - start)))
    ]


def kinds(events: list[Event]) -> list[str]:
    return [e.kind for e in events]


def threaded() -> Scene:
    """Both instruments on the thread, 4 mm of it between them, the needle dropped."""
    s = scene.build(STITCH)
    nodes = s.view().thread
    assert nodes is not None
    go(s, LEFT, nodes[40], 0.0, 0.5)
    close(s, LEFT, 1.0)
    close(s, RIGHT, 0.0)
    nodes = s.view().thread
    assert nodes is not None
    go(s, RIGHT, nodes[20], 0.0, 0.5)
    close(s, RIGHT, 1.0)
    assert s.view().thread_holders == (LEFT, RIGHT)
    return s


def test_the_same_hand_gives_the_same_events_and_so_do_its_poses() -> None:
    """Bit for bit: the hand repeats itself, and a scene is a function of task and poses alone."""
    hand = Hand(tremor_rms_um=38.0, aim_error_mm=0.02, seed=3)
    first, second = perform(one_drive(), hand), perform(one_drive(), hand)
    assert first.events == second.events
    again = scene.build(one_drive())
    events = [e for p in first.poses for e in again.step(ToolPoses.unpack(p.pack()))]
    assert tuple(events) == first.events


def test_a_tick_allocates_no_array_of_the_tissue() -> None:
    """With the needle in a wall that it moves to and fro, and the thread behind it: less than a vector of all nodes."""
    profile = load_profile("scripted-expert").profile
    assert profile.hand is not None
    s = scene.build(STITCH)
    hands, seen = scripted_hands(profile.hand, STITCH, s.home, 0), s.home
    while not s.world.holes:
        seen = hands.poll(s.tick, s.view()) or seen
        s.step(seen)
    solver = s.world.solver
    assert solver is not None
    off = replace(seen, position=seen.position + 0.01)

    def to_and_fro() -> None:
        s.step(off)
        s.step(seen)

    _, most = kept_bytes(to_and_fro)
    assert not s.outcome
    assert most < solver.x.nbytes


def test_a_scene_has_only_what_its_task_asks_for() -> None:
    """Without thread none is laid, without vessel nothing is solved."""
    drive = one_drive()
    assert scene.build(drive).world.thread is None
    bare = replace(drive, scene=replace(drive.scene, vessel=()), step=(replace(drive.step[0], kind="withdraw"),))
    s = scene.build(bare)
    assert (s.world.tissue, s.world.solver) == (None, None)
    events = s.step(s.home)
    assert events[-1].kind == "task_done"


def test_jaws_hold_a_wall_and_the_wall_comes_along() -> None:
    """The held patch follows the jaws within a hundredth of the movement (the grip's stiffness is a hundred walls').

    Firmly closed jaws compress the wall: the pressure limit of the task is reported once. Released, the wall goes back
    to rest exactly, the only state without force.
    """
    s = scene.build(STITCH)
    rest = s.world.solver.x.copy() if s.world.solver else np.zeros(0)
    place, _ = s.view().look("A", 90.0, 0.2, "outer")
    go(s, LEFT, place, 0.0, 0.5)
    events = close(s, LEFT, 0.95)
    grasp = next(e for e in events if isinstance(e, Grasp))
    assert (grasp.target, grasp.body) == ("wall", "A")
    assert kinds(events).count("overforce") == 1
    lift = np.array([0.0, 0.02, 0.0])
    events = go(s, LEFT, place + lift, 0.95, 0.005)
    moved, _ = s.view().look("A", 90.0, 0.2, "outer")
    assert "slip" not in kinds(events)
    assert moved - place == pytest.approx(lift, abs=0.1 * 0.02)
    assert "release" in kinds(close(s, LEFT, 0.0))
    assert s.world.solver is not None
    assert np.array_equal(s.world.solver.x, rest)


def test_a_wall_pulled_too_hard_slips_or_tears_and_never_leaps() -> None:
    """Closed fully, two pads hold 500 kPa · 0.03 mm² = 15 mN: a pull of 1.5 mm slips them off."""
    s = scene.build(STITCH)
    place, _ = s.view().look("A", 90.0, 0.2, "outer")
    go(s, LEFT, place, 0.0, 0.5)
    close(s, LEFT, 1.0)
    events = go(s, LEFT, place + np.array([0.0, 1.5, 0.0]), 1.0, 0.05)
    ends = [e for e in events if e.kind in ("slip", "tear")]
    assert len(ends) == 1
    assert s.world.jaws[LEFT].target == ""
    s.step(poses(s, LEFT, at(s, LEFT), 1.0))
    assert s.world.solver is not None
    assert np.array_equal(s.world.solver.x, s.world.solver.mesh.rest)


def test_a_thread_drawn_apart_breaks_in_firm_jaws_and_slips_from_loose_ones() -> None:
    """Brown 2001, section 4: between two hard constraints it breaks. Fully closed jaws hold 1000 mN, the thread 710.

    Jaws closed to 0.8 hold 600 mN and lose it first. The pieces keep their length either way.
    """
    for closure, ending in ((1.0, "break"), (0.8, "slip")):
        s = threaded()
        for tool in (LEFT, RIGHT):
            close(s, tool, closure)
        away = at(s, RIGHT) - at(s, LEFT)
        events = go(s, RIGHT, at(s, RIGHT) + 3.0 * away, closure)
        assert kinds(events).count(ending) == 1, (closure, kinds(events))
        assert stretch(s.world) <= 1e-6
        assert (s.outcome == "failed") == (ending == "break")


@pytest.mark.parametrize("step_mm", [0.001, 0.02, 0.4])
def test_a_thread_gives_way_at_the_same_place_however_fast_it_is_pulled(step_mm: float) -> None:
    """A rigid thread between two grips does not creep: it breaks when it is straight, within one tick's movement.

    Before, 4 mm of it lie between the grips; each grip may hold up to the jaws' reach away from its place.
    """
    s = threaded()
    close(s, LEFT, 1.0)
    way = at(s, RIGHT) - at(s, LEFT)
    held = abs(s.world.jaws[LEFT].arc - s.world.jaws[RIGHT].arc)
    go(s, RIGHT, at(s, LEFT) + way * (held - 2.0 * step_mm) / np.linalg.norm(way), 1.0, 0.01)
    assert s.outcome == ""
    events = go(s, RIGHT, at(s, LEFT) + way * (held + 4.0 * step_mm) / np.linalg.norm(way), 1.0, step_mm)
    assert kinds(events).count("break") == 1
    assert float(np.linalg.norm(at(s, RIGHT) - at(s, LEFT))) == pytest.approx(held, abs=2.1 * step_mm)
    broken = next(e for e in events if e.kind == "break")
    assert broken.tension_mN == broken.limit_mN == 710.0  # type: ignore[attr-defined]


def test_the_needle_does_not_move_when_it_changes_hands() -> None:
    """The second forceps turns in place while the first still leads; then the first lets go."""
    s = scene.build(STITCH)
    place = s.world.needle_pose.apply(np.array([-0.6, 0.1, 0.0]))
    go(s, LEFT, place, 0.0, 0.5)
    close(s, LEFT, 1.0)
    assert len(s.view().needle_holders) == 2
    now = s.view().poses
    for k in range(1, 21):
        turned = now.quaternion.copy()
        turned[LEFT] = slerp(
            now.quaternion[LEFT], quaternion_multiply(now.quaternion[LEFT], [0.0, 1.0, 0.0, 0.0]), k / 20
        )
        s.step(ToolPoses(now.position, turned, np.ones(2), np.ones(2, dtype=bool)))
    before = s.world.needle_pose
    for closure in (0.6, 0.4, 0.2):
        s.step(ToolPoses(now.position, turned, np.array([1.0, closure]), np.ones(2, dtype=bool)))
    assert s.view().needle_holders == (LEFT,)
    assert s.world.needle_pose.position == pytest.approx(before.position, abs=1e-9)
    assert abs(s.world.needle_pose.quaternion @ before.quaternion) == pytest.approx(1.0, abs=1e-12)


def test_a_stitch_without_tremor_makes_four_holes_and_leaves_none_again() -> None:
    """In, through, in, through: friction in the holes shakes nothing loose. No slot is left over at the end."""
    done = perform(STITCH, Hand())
    made = [(e.body, e.wall, e.direction) for e in done.events if isinstance(e, Pierce)]
    assert made == [("A", "outer", "in"), ("A", "inner", "in"), ("B", "inner", "out"), ("B", "outer", "out")]
    assert not [e for e in done.events if e.kind in ("withdraw", "tear", "slip", "drop", "break", "overforce")]
    world = done.scene.world
    assert world.solver is not None
    in_use = int(np.count_nonzero(np.any(world.solver.compliance.slot_weights != 0.0, axis=1)))
    assert in_use == len(world.open_holes()) == 4


def test_a_hole_that_tore_was_not_withdrawn_from() -> None:
    """The needle dragged sideways out of the wall is no way to reach the step that asks to take it back out."""
    drive = STITCH.step[0]
    task = replace(STITCH, step=(drive, replace(drive, name="out again", kind="withdraw")))
    s = scene.build(task)
    hands = ScriptedHands(Hand(), STITCH, s.home, 0)
    while s.tick < 500:  # the needle is now two millimetres through
        seen = hands.poll(s.tick, s.view())
        assert seen is not None
        s.step(seen)
    assert s.steps_done == 1
    events = go(s, RIGHT, at(s, RIGHT) + np.array([0.0, 6.0, 0.0]), 1.0, 0.05)
    assert "tear" in kinds(events)
    assert s.steps_done == 1


def test_a_broken_thread_is_two_that_both_keep_their_length() -> None:
    """The pieces end at the link that gave way, which is lost: lengths add up to the thread less one link."""
    s = threaded()
    world = s.world
    assert world.thread is not None
    thread_pull.snap(world, world.thread.needle_length + 6.1, 800.0, 0.0)
    assert len(world.pieces) == 2
    whole = world.thread.end - world.thread.needle_length
    assert np.sum(world.pieces[:, 1] - world.pieces[:, 0]) == pytest.approx(whole - world.thread.link, abs=1e-9)
    start = at(s, RIGHT)
    for k in range(60):
        s.step(poses(s, RIGHT, start + 0.05 * k * np.array([0.3, 1.0, 0.2]), 1.0))
        assert stretch(world) <= 1e-6


def test_a_needle_let_go_in_the_air_is_dropped_and_can_be_taken_again() -> None:
    s = scene.build(STITCH)
    events = close(s, RIGHT, 0.0)
    assert kinds(events)[-2:] == ["release", "drop"]
    needle = s.world.needle_pose.position.copy()
    assert s.view().needle_holders == ()
    events = close(s, RIGHT, 1.0)
    assert "grasp" in kinds(events)
    lift = np.array([0.0, 0.0, 1.0])
    go(s, RIGHT, at(s, RIGHT) + lift, 1.0)
    assert s.world.needle_pose.position == pytest.approx(needle + lift, abs=1e-9)


def test_a_pulled_thread_draws_a_loose_needle_after_it() -> None:
    """Nobody holds the needle: its rear end stays at the thread's first node and its length stays its own."""
    s = scene.build(STITCH)
    close(s, RIGHT, 0.0)
    nodes = s.view().thread
    assert nodes is not None
    go(s, LEFT, nodes[3], 0.0, 0.5)
    close(s, LEFT, 1.0)
    go(s, LEFT, at(s, LEFT) + np.array([3.0, 4.0, 2.0]), 1.0)
    assert thread_pull.swage(s.world) == pytest.approx(s.world.nodes[0], abs=1e-9)
    assert stretch(s.world) <= 1e-6
    assert np.linalg.norm(thread_pull.swage(s.world) - at(s, LEFT)) <= 3 * 0.2 + 0.25 + 1e-6


def test_a_flat_needle_glides_along_the_wall_without_a_hole() -> None:
    """Below the task's skid angle the tip does not stick; it may press, but 0.05 mm of pressing is no puncture."""
    task = one_drive()
    s = scene.build(task)
    needle = s.world.needle_pose
    point, normal = s.view().look("A", 0.0, 0.6, "outer")
    axis = s.view().vessel_axis["A"]
    steep = np.radians(5.0)
    heading = np.cos(steep) * axis - np.sin(steep) * normal
    from trainer.drivers.hand_motion import needle_pose

    flat = needle_pose(point - 0.3 * heading, heading, np.cos(steep) * normal + np.sin(steep) * axis, 0.0, 1.613)
    offset = needle.inverse() @ s.view().poses.world_from_tool(RIGHT)

    def step(pose: Rigid) -> tuple[Event, ...]:
        tool = pose @ offset
        home = s.home
        return s.step(
            ToolPoses(
                np.array([home.position[LEFT], tool.position]),
                np.array([home.quaternion[LEFT], tool.quaternion]),
                home.closure,
                np.ones(2, dtype=bool),
            )
        )

    events: list[Event] = []
    for k in range(90):
        events += step(Rigid(flat.position + 0.01 * k * heading, flat.quaternion))
    assert "contact" in kinds(events)
    assert "pierce" not in kinds(events)


def test_friction_does_not_shake_the_wall() -> None:
    """A needle that is steered in a wall carries it along: in most ticks no node goes further than the needle takes it.

    The wall at the hole goes no further than the needle there, d, and the needle than its tip. The hole lies in a
    triangle with the weights w: moved with the least effort, as if each node yielded alike, its nodes go w d / |w|²,
    and the furthest of them at most max(w) / |w|². With w = (a, (1 - a) / 2, (1 - a) / 2) that is greatest at
    a = 1 / √3, where it is (1 + √3) / 2. Nodes that draw each other along go less far than that. A friction that was
    taken from the tick before threw the wall to and fro by six times what the needle went.
    """
    s = scene.build(STITCH)
    hands = ScriptedHands(Hand(tremor_rms_um=5.0), STITCH, s.home, 3)
    world = s.world
    assert world.solver is not None
    assert world.needle is not None
    wall, needle = [], []
    while len(wall) < 200:
        x, tip = world.solver.x.copy(), world.needle_pose.position
        seen = hands.poll(s.tick, s.view())
        assert seen is not None
        s.step(seen)
        if any(0.0 < h.arc < world.needle.length for h in world.open_holes()):
            wall.append(np.linalg.norm(world.solver.x - x, axis=1).max())
            needle.append(np.linalg.norm(world.needle_pose.position - tip))
    assert np.median(wall) < 0.5 * (1.0 + np.sqrt(3.0)) * np.median(needle)


def test_a_lost_instrument_stays_and_comes_back() -> None:
    """Frozen in place with its jaws, reported once at each end; the needle in its jaws stays with it."""
    s = scene.build(STITCH)
    tip = s.world.needle_pose.position.copy()
    far = at(s, RIGHT) + np.array([50.0, 0.0, 0.0])
    unseen = [
        replace(poses(s, RIGHT, far, 0.0, valid=False), reason=("", why)) for why in ("the port is gone", "later")
    ]
    lost = [e for k in range(5) for e in s.step(unseen[min(k, 1)])]
    assert [e.reason for e in lost if isinstance(e, TrackingLost)] == ["the port is gone"]
    assert s.world.needle_pose.position == pytest.approx(tip, abs=1e-12)
    back = s.step(poses(s, RIGHT, at(s, RIGHT), 1.0))
    assert kinds(list(back)) == ["tracking_back"]
    assert back[0].lost_s == pytest.approx(0.05)  # type: ignore[attr-defined]


def leaping() -> Task:
    return replace(STITCH, time_limit_s=2.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_tracker_that_leaps_leaves_everything_finite_and_the_thread_whole(seed: int) -> None:
    """Poses thrown up to 20 mm from tick to tick through the vessels, jaws snapping: two seconds of rubbish.

    Nothing may become infinite, no link may stretch, and what tears is reported above its limit.
    """
    rng = np.random.default_rng(seed)
    s = scene.build(leaping())
    while not s.outcome:
        q = rng.normal(size=(2, 4))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        spread = 10.0 if s.tick % 7 == 0 else 0.3
        events = s.step(ToolPoses(rng.normal(0.0, spread, (2, 3)), q, rng.random(2), rng.random(2) > 0.1))
        assert s.world.solver is not None
        assert np.isfinite(s.world.solver.x).all()
        assert np.isfinite(s.world.nodes).all()
        assert stretch(s.world) <= 1e-6
        for e in events:
            if isinstance(e, Tear):
                assert e.force_mN > e.limit_mN


def test_refuses_poses_for_another_number_of_instruments() -> None:
    s = scene.build(STITCH)
    with pytest.raises(ValueError, match="2 instruments need 2 poses, found 1"):
        s.step(ToolPoses(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.zeros(1), np.ones(1, dtype=bool)))


def test_the_last_event_says_where_everything_is() -> None:
    s = scene.build(STITCH)
    s.step(s.home)
    aborted, done = s.finish("aborted", "interrupted")
    assert aborted.kind == "aborted"
    assert done.needle_tip == pytest.approx(tuple(s.world.needle_pose.position))  # type: ignore[attr-defined]
    assert done.thread_end == pytest.approx(tuple(s.world.nodes[-1]))  # type: ignore[attr-defined]
    assert s.outcome == "aborted"


def test_the_time_limit_ends_the_exercise() -> None:
    s = scene.build(replace(STITCH, time_limit_s=0.1))
    ticks = 0
    while not s.outcome:
        s.step(s.home)
        ticks += 1
    assert (s.outcome, ticks) == ("timeout", 10)
