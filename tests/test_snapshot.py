"""What a tick copies, read by another process, is the scene as it was."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from trainer import scene, showing
from trainer.curriculum import load_task
from trainer.geometry import Array
from trainer.instruments import arthroscopic, forceps
from trainer.interactions import thread_pull
from trainer.mechanics.thread import polyline
from trainer.poses import ToolPoses
from trainer.scene import Scene
from trainer.sinks.surface import Frame


def placed(task_path: str) -> Scene:
    """A scene that lies askew in the world, on a coarse mesh, after two ticks."""
    task = load_task(task_path).task
    vessels = tuple(replace(vessel, layers=9, around=8) for vessel in task.scene.vessel)
    askew = replace(task.scene, position_mm=(1.0, -2.0, 3.0), rotation_deg=(20.0, -30.0, 40.0), vessel=vessels)
    s = scene.build(replace(task, scene=askew))
    for shift in (0.0, 0.05):
        home = s.home
        s.step(ToolPoses(home.position + shift, home.quaternion, np.full(len(s.tools), 0.9), home.valid))
    return s


def shown(s: Scene) -> Frame:
    """By way of what can pass to another process."""
    frame = pickle.loads(pickle.dumps(s.layout().frame))
    made: Frame = frame(s.snapshot())
    return made


def same(found: tuple[Array, ...], expected: list[Array]) -> None:
    """Bit for bit: the numbers take another way, and none is changed on it."""
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_vessels_instruments_and_needle_are_where_the_scene_has_them() -> None:
    s = placed("anastomosis/single-stitch")
    world, out, frame = s.world, s.world.world_from_scene, shown(s)
    assert world.tissue is not None
    assert world.solver is not None
    world.tissue_force_mN, world.tension_mN = 3.25, 1.5
    same(frame.vertices, [out.apply(world.solver.x[world.tissue.nodes(v)]) for v in (0, 1)])
    blades = [forceps.part_poses(out @ jaw.pose, jaw.closure) for jaw in world.jaws]
    np.testing.assert_array_equal(frame.part_position, np.concatenate([position for position, _ in blades]))
    np.testing.assert_array_equal(frame.part_quaternion, np.concatenate([turn for _, turn in blades]))
    needle = out @ world.needle_pose
    np.testing.assert_array_equal(frame.needle_position, needle.position)
    np.testing.assert_array_equal(frame.needle_quaternion, needle.quaternion)
    assert (shown(s).force_mN, shown(s).tension_mN) == (3.25, 1.5)


@pytest.mark.parametrize("broken", [False, True])
def test_a_thread_runs_from_the_swage_through_its_grip_in_as_many_pieces_as_it_has(broken: bool) -> None:
    s = placed("anastomosis/single-stitch")
    world, out = s.world, s.world.world_from_scene
    assert world.thread is not None
    jaw = world.jaws[0]
    jaw.target, jaw.arc = "thread", world.thread.needle_length + 4.3 * world.thread.link
    jaw.pose = replace(jaw.pose, position=thread_pull.swage(world) + 0.3)
    if broken:
        thread_pull.snap(world, world.thread.needle_length + 7.5 * world.thread.link, 9.0, 0.0)
    held = thread_pull.constraints(world)
    lines = polyline(world.thread, world.nodes, held.arc, held.position, world.pieces)
    found = shown(s).thread
    assert len(found) == 1 + broken
    same(found, [out.apply(line) for line in lines])
    np.testing.assert_array_equal(found[0][0], out.apply(thread_pull.swage(world)))
    assert np.any(np.all(found[0] == out.apply(jaw.pose.position), axis=1))


def test_of_a_knee_the_elements_that_move_and_neither_needle_nor_thread() -> None:
    s = placed("arthroscopy/ligament-2d")
    frame, out = shown(s), s.world.world_from_scene
    assert s.world.region is not None
    same(frame.clouds, [out.apply(places) for places in showing.moving(s.world.region)])
    parts = [arthroscopic.part_poses(out @ jaw.pose, jaw.closure) for jaw in s.world.jaws]
    np.testing.assert_array_equal(frame.part_position, np.concatenate([position for position, _ in parts]))
    assert (frame.vertices, frame.thread, frame.needle_position, frame.needle_quaternion) == ((), (), None, None)


@pytest.mark.parametrize("task", ["anastomosis/single-stitch", "arthroscopy/ligament-2d"])
def test_what_was_copied_stays_as_it_was(task: str) -> None:
    """The pipe may take it later."""
    s = placed(task)
    copied = s.snapshot()
    world, before = s.world, copied.copy()
    for jaw in world.jaws:
        jaw.pose.position[:] += 1.0
    if world.solver is not None:
        world.solver.x += 1.0
        world.nodes += 1.0
    if world.region is not None:
        world.region.state.u += 1.0
    np.testing.assert_array_equal(copied, before)
    assert not np.array_equal(s.snapshot(), before)


def test_the_reader_needs_no_rule_of_interaction() -> None:
    """The process that writes a recording is ready the sooner, by 0.2 s of imports."""
    code = "import sys, trainer.snapshot; print([m for m in sys.modules if m.startswith('trainer.interactions')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
