"""The thread lies over walls, blades and itself, and goes through none of them but where it has a hole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from through_walls import depth, in_walls, winding

from trainer import scene
from trainer.curriculum import Task, load_task
from trainer.drivers.scripted import ScriptedHands
from trainer.events import Drape, Event, Undrape
from trainer.geometry import Array
from trainer.instruments import forceps
from trainer.interactions import thread_pull
from trainer.interactions.drape import LIFTED_S
from trainer.poses import ToolPoses
from trainer.profile import load_profile
from trainer.scene import Scene


def draping(task: Task) -> Task:
    """The task with a thread that lies over things."""
    assert task.scene.thread is not None
    return replace(task, scene=replace(task.scene, thread=replace(task.scene.thread, drapes=True)))


STITCH = draping(load_task("anastomosis/single-stitch").task)
RADIUS = 0.0125  # of a 10-0 thread, mm
#: How deep a node may lie in a wall, mm. It keeps its skin from it, which next to a hole is half of its distance to the
#: hole along the thread, to ``TOLERANCE_MM``: a node nearer than 2 µm to a hole may be 1 µm in; three times that for
#: the edges of facets, where solid angles and planes disagree.
IN_WALL = 0.003
#: How deep a link may lie in a wall between its nodes, mm: the thread rounds an edge with links of 0.2 mm, of which the
#: part of 0.3 next to a hole or grip does not touch; there a link may cut a corner of 90 degrees by half of that.
CORNER = 0.03


def test_winding_tells_inside_from_outside() -> None:
    """A tetrahedron: 1 at its middle, 0 beside it; and the distance of its middle to a face, 1 / (2 sqrt 3)."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    middle = x.mean(axis=0)
    assert winding(np.array([middle, [1.0, 1.0, 1.0]]), x, faces) == pytest.approx([1.0, 0.0], abs=1e-12)
    assert depth(middle, x, faces) == pytest.approx(0.25 / np.sqrt(3.0), abs=1e-12)


def test_the_thread_lies_outside_the_walls_in_a_whole_stitch() -> None:
    """Looked at every 0.4 s, by solid angles. Without contact, links are through walls in two looks of five.

    Where a wall springs back over the thread by more than half its thickness in a movement, as the needle's rear end
    leaves it or two ends come together, a link may be caught in it for a while (README): in one look of twenty at most.
    """
    hand = load_profile("scripted-expert").profile.hand
    assert hand is not None
    s = scene.build(STITCH)
    hands = ScriptedHands(hand, STITCH, s.home, 9)
    caught: list[str] = []
    looks = 0
    while not s.outcome:
        seen = hands.poll(s.tick, s.view())
        assert seen is not None, hands.summary()
        s.step(seen)
        if s.tick % 40 == 0 or s.outcome:
            node, link = in_walls(s.world)
            looks += 1
            if node > IN_WALL or link > CORNER:
                caught.append(f"tick {s.tick}: a node {node:.3f} mm deep in a wall, a link {link:.3f} mm")
            assert thread_pull.stretch(s.world) <= 1e-6
    assert s.outcome == "completed"
    assert len(caught) <= looks // 20, caught


def sweep(s: Scene, tool: int, way: Array, ticks: int) -> list[Event]:
    """An instrument moves by ``way`` (3,) mm in a straight line."""
    start, events = s.view().poses, list[Event]()
    for k in range(1, ticks + 1):
        place = start.position.copy()
        place[tool] += k / ticks * way
        events += s.step(ToolPoses(place, start.quaternion, start.closure, np.ones(2, dtype=bool)))
    return events


def least_distance(s: Scene, tool: int) -> float:
    """Of the thread's points to the surfaces of a tool's blades, mm: negative inside. Points lie 5 µm apart."""
    jaw = s.world.jaws[tool]
    ends, radii = forceps.capsules(jaw.pose, jaw.closure)
    nodes = s.world.nodes
    share = np.linspace(0.0, 1.0, 41)[:, None, None]
    points = ((1.0 - share) * nodes[:-1] + share * nodes[1:]).reshape(-1, 3)
    least = np.inf
    for k in range(0, len(ends), 2):
        axis = ends[k + 1] - ends[k]
        t = np.clip((points - ends[k]) @ axis / (axis @ axis), 0.0, 1.0)
        gap = np.linalg.norm(points - ends[k] - t[:, None] * axis, axis=1) - (1.0 - t) * radii[k] - t * radii[k + 1]
        least = min(least, float(np.min(gap)))
    return least


@pytest.mark.parametrize("ticks", [20, 200])
def test_a_blade_takes_the_thread_along_however_fast(ticks: int) -> None:
    """Closed forceps sweep 4 mm across the straight thread: it never gets through them, and does not stretch.

    The thread's surface may be ``TOLERANCE_MM`` in them, 1 µm, and a point of a link as far as a capsule's taper tilts
    its surface against the axis, under 2 % of its radius of 0.3 mm at the root: 10 µm in all.
    """
    task = replace(STITCH, scene=replace(STITCH.scene, vessel=()), step=(STITCH.step[2],))
    s = scene.build(task)
    home = s.view().poses
    middle = s.world.nodes[50]
    blade = np.array([-5.0, 0.0, 0.0])
    along = s.world.jaws[0].pose.rotate(blade)
    thread = s.world.nodes[51] - s.world.nodes[49]
    across = np.cross(along, thread)
    across /= np.linalg.norm(across)
    place = home.position.copy()
    place[0] = middle - along - 2.0 * across
    jaws = np.array([1.0, home.closure[1]])
    s.step(ToolPoses(place, home.quaternion, jaws, np.ones(2, dtype=bool)))
    before = s.world.nodes.copy()
    events = sweep(s, 0, 4.0 * across, ticks)
    assert least_distance(s, 0) >= RADIUS - 0.01
    assert np.max((s.world.nodes - before) @ across) > 1.5, "the thread did not come along"
    assert thread_pull.stretch(s.world) <= 1e-6
    assert [e.tool for e in events if isinstance(e, Drape)] == ["left"]
    # Back again: it lies there no longer, once, and is told a tenth of a second after that.
    events = sweep(s, 0, -4.0 * across, ticks) + sweep(s, 0, np.zeros(3), round(LIFTED_S * task.tick_hz) + 1)
    assert [e.tool for e in events if isinstance(e, Undrape)] == ["left"]
    assert not [e for e in events if isinstance(e, Drape)]


def test_a_scene_without_thread_has_no_contact_of_one() -> None:
    drive = load_task("anastomosis/needle-drive").task
    assert scene.build(drive).world.draping is None
