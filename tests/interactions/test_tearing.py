"""A wall that tears opens from there to its cut edge, and practice goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_scene import LEFT, RIGHT, STITCH, at, close, go, poses

from trainer import scene
from trainer.anatomy.slit import slit_links
from trainer.anatomy.vessel import wall_point
from trainer.curriculum import Task
from trainer.drivers.scripted import ScriptedHands
from trainer.events import Event, Tear
from trainer.geometry import Rigid
from trainer.interactions import pierce, tearing
from trainer.interactions.world import Hole, World
from trainer.mechanics.links import forces
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.scene import Scene

#: Of vessel A at 12 o'clock: the slit runs between the last hour's nodes and the first's.
LIPS = [47 - 24, 0]
#: From here on the needle is dragged sideways.
THROUGH = 500


def torn() -> tuple[Scene, list[Event], list[bytes]]:
    """The needle driven through both walls of A, and dragged out sideways; with all events and poses."""
    s = scene.build(STITCH)
    hands = ScriptedHands(Hand(), STITCH, s.home, 0)
    events: list[Event] = []
    taken: list[bytes] = []

    def step(now: ToolPoses) -> None:
        taken.append(now.pack())
        events.extend(s.step(now))

    while s.tick < THROUGH:
        seen = hands.poll(s.tick, s.view())
        assert seen is not None
        step(seen)
    start = at(s, RIGHT)
    for k in range(1, 121):
        step(poses(s, RIGHT, start + np.array([0.0, 0.05 * k, 0.0]), 1.0))
    return s, events, taken


@pytest.fixture(scope="module")
def performed() -> tuple[Scene, list[Event], list[bytes]]:
    return torn()


@pytest.fixture
def world(performed: tuple[Scene, list[Event], list[bytes]]) -> World:
    return performed[0].world


def across(world: World) -> np.ndarray:
    """The links of A that its two torn holes have between their lips, as far as the nearer of them."""
    assert world.tissue is not None
    outer, inner = world.holes[0].place, world.holes[1].place
    near = min(outer.axial_mm, inner.axial_mm)
    return slit_links(world.tissue.vessels[0], ("outer", "inner"), (outer.clock, inner.clock), near)


def test_holes_that_tear_out_leave_no_link_across_their_slit(performed: tuple[Scene, list[Event], list[bytes]]) -> None:
    """Outer wall and inner wall tear one after the other; the vessel is whole elsewhere, and so is the other one."""
    s, events, _ = performed
    tears = [e for e in events if isinstance(e, Tear)]
    assert [(e.body, e.wall, e.hole) for e in tears] == [("A", "outer", 0), ("A", "inner", 1)]
    assert all(e.force_mN > e.limit_mN for e in tears)
    solver, tissue = s.world.solver, s.world.tissue
    assert solver is not None
    assert tissue is not None
    cut = np.flatnonzero(solver.mesh.stiffness == 0.0)
    assert len(across(s.world)) > 10
    assert np.isin(across(s.world), cut).all()
    clock = tissue.vessels[0].clock[tissue.mesh.links[cut]]
    assert (np.abs(np.remainder(clock + np.pi, 2.0 * np.pi) - np.pi) < 0.6).all()
    assert (tissue.vessels[0].axial_mm[tissue.mesh.links[cut]].min(axis=1) <= 0.36).all()


def test_what_nothing_holds_any_more_is_at_rest_with_its_slit_closed(world: World) -> None:
    assert world.solver is not None
    assert world.tissue is not None
    assert not world.open_holes()
    assert np.array_equal(world.solver.x[world.tissue.nodes(0)], world.tissue.mesh.rest[world.tissue.nodes(0)])


def test_a_session_with_a_tear_is_the_same_bits_again(performed: tuple[Scene, list[Event], list[bytes]]) -> None:
    """From its poses alone, as a replay does it."""
    s, events, taken = performed
    again = scene.build(STITCH)
    assert [e for p in taken for e in again.step(ToolPoses.unpack(p))] == events
    assert s.world.solver is not None
    assert again.world.solver is not None
    assert np.array_equal(again.world.solver.x, s.world.solver.x)


def drawn_aside(s: Scene) -> float:
    """How far the cut edge's two nodes beside 12 o'clock part when jaws draw one side of it by 0.1 mm, and forces."""
    place, _ = s.view().look("A", 20.0, 0.15, "outer")
    go(s, LEFT, place, 0.0, 0.5)
    close(s, LEFT, 0.93)
    assert s.world.jaws[LEFT].target == "wall"
    solver = s.world.solver
    assert solver is not None
    before = float(np.linalg.norm(np.subtract(*solver.x[LIPS])))
    three = s.world.tissue.vessels[0].three if s.world.tissue is not None else np.zeros(3)
    go(s, LEFT, place + 0.1 * three, 0.93, 0.005)
    assert s.world.jaws[LEFT].target == "wall"
    return float(np.linalg.norm(np.subtract(*solver.x[LIPS]))) - before


def test_the_lips_of_a_slit_part_where_an_intact_wall_holds() -> None:
    """Drawn aside by 0.1 mm beside it: by a tenth of that at least, while a link of an intact wall there, which goes
    along as a whole, lengthens by less than a hundredth (0.028 mm and 0.00003 mm were measured). Nothing bears across:
    without the links the forces are the same."""
    s, _, _ = torn()
    assert drawn_aside(s) > 0.01
    solver = s.world.solver
    assert solver is not None
    left = solver.mesh.stiffness > 0.0
    whole = replace(solver.mesh, links=solver.mesh.links[left], rest_length=solver.mesh.rest_length[left],
                    stiffness=solver.mesh.stiffness[left])  # fmt: skip
    assert np.array_equal(forces(whole, solver.x), forces(solver.mesh, solver.x))
    assert abs(drawn_aside(scene.build(STITCH))) < 0.001


def crossing(world: World, triangle: int) -> bool:
    """Whether a tip that goes through the middle of a wall's triangle begins a contact there."""
    assert world.solver is not None
    corners = world.solver.x[world.surface[triangle]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal *= 0.01 / np.linalg.norm(normal)
    before = Rigid(corners.mean(axis=0) + normal, np.array([1.0, 0.0, 0.0, 0.0]))
    after = Rigid(corners.mean(axis=0) - normal, before.quaternion)
    world.before = world.solver.x.copy()
    pierce.detect(world, before, after, 0.0, 0.01, "right")
    touched = world.contact is not None
    if world.contact is not None:
        world.solver.drop(world.contact.slot)
        world.contact = None
    return touched


def test_the_needle_s_tip_meets_nothing_between_the_lips(world: World) -> None:
    """Each triangle across the slit lets it through, each of their neighbours is a wall; grasping finds these alone."""
    opened = np.flatnonzero(world.slit)
    assert len(opened) >= 8
    assert not any(crossing(world, f) for f in opened.tolist())
    beside = np.flatnonzero(np.isin(world.surface, world.surface[opened]).any(axis=1) & ~world.slit)
    assert all(crossing(world, f) for f in beside.tolist())
    first, last = world.part[0, "outer"]
    assert len(world.wall(0, "outer")) == last - first - np.count_nonzero(world.slit[first:last])
    first, last = world.part[1, "outer"]
    assert len(world.wall(1, "outer")) == last - first


def weak() -> Task:
    """Walls that tear before they slip out of jaws."""
    vessels = STITCH.scene.vessel
    frail = tuple(replace(v, tear_mN=replace(v.tear_mN, value=6.0)) for v in vessels)
    return replace(STITCH, scene=replace(STITCH.scene, vessel=frail))


def test_a_wall_that_tears_in_jaws_is_slit_through_from_where_they_held_it() -> None:
    """Both hulls; the needle's tip that pressed on what is open now touches nothing, and its hold is given back. The
    jaws may take the wall again."""
    s = scene.build(weak())
    world = s.world
    place, _ = s.view().look("A", 90.0, 0.4, "outer")
    go(s, LEFT, place, 0.0, 0.5)
    close(s, LEFT, 1.0)
    assert world.solver is not None
    nodes = world.solver.compliance.slot_nodes[list(world.jaws[LEFT].slots)]
    events = go(s, LEFT, place + np.array([0.0, 1.5, 0.0]), 1.0, 0.05)
    (tear,) = [e for e in events if isinstance(e, Tear)]
    assert (tear.body, tear.wall, tear.hole, tear.tool) == ("A", "outer", -1, "left")
    assert world.tissue is not None
    vessel = world.tissue.vessels[0]
    clock, axial = vessel.clock[nodes[0]].mean(), vessel.axial_mm[nodes[0]].mean()
    through = slit_links(vessel, ("outer", "inner"), (clock, clock), axial)
    assert len(through) > 10
    assert np.array_equal(np.flatnonzero(world.solver.mesh.stiffness == 0.0), through)
    assert world.jaws[LEFT].target == ""
    close(s, LEFT, 0.0)
    go(s, LEFT, place, 0.0, 0.5)
    assert "grasp" in [e.kind for e in close(s, LEFT, 0.9)]


@pytest.mark.parametrize(("hour", "same_pass", "open_through"), [(0.7, 1, True), (0.7, 2, False), (3.5, 1, False)])
def test_the_two_holes_of_a_bite_make_one_slit(hour: float, same_pass: int, open_through: bool) -> None:
    """Outer wall at 0.2 rad, inner wall further on: nothing is left across once both tore, unless they are of two
    passes, or of the vessel's two sides. Those are slits of their own, and the wall is whole between them."""
    s = scene.build(STITCH)
    world = s.world
    assert world.tissue is not None
    assert world.solver is not None
    for number, (wall, clock, pass_number) in enumerate((("outer", 0.2, 1), ("inner", hour, same_pass))):
        nodes, weights = wall_point(world.tissue.vessels[0], clock, 0.4, "inner" if number else "outer")
        place = pierce.place_on(world, 0, wall, nodes, weights)
        slot = world.solver.hold(nodes, weights)
        edge = nodes, weights
        around = np.zeros(0, dtype=np.int64)
        hole = Hole(number, place, slot, True, pass_number, np.zeros(3), 0.0, around, edge, open=False, torn=True)
        world.holes.append(hole)
        tearing.rip_out(world, hole)

    def left(walls: tuple[str, ...], clocks: tuple[float, float]) -> bool:
        """Whether a link of these walls bears across a slit at these hours of the two."""
        assert world.tissue is not None
        assert world.solver is not None
        crossed = slit_links(world.tissue.vessels[0], walls, clocks, 0.35)
        return bool((world.solver.mesh.stiffness[crossed] > 0.0).any())

    if open_through:
        assert not left(("outer", "inner"), (0.2, hour))
    else:
        assert not left(("outer",), (0.2, 0.2))
        assert not left(("inner",), (hour, hour))
        assert left(("outer", "inner"), (0.2, 0.2))


def test_a_tip_on_what_a_slit_opens_touches_nothing_any_more() -> None:
    s = scene.build(STITCH)
    world = s.world
    assert world.solver is not None
    assert world.tissue is not None
    vessel = world.tissue.vessels[0]
    held = np.array([vessel.node(4, 5), vessel.node(5, 5), vessel.node(4, 6)])
    free = world.solver.compliance.slot_body.count(-1)
    for hour, stays in ((5, False), (15, True)):
        nodes = np.array([vessel.node(2, hour), vessel.node(3, hour), vessel.node(2, hour + 1)])
        at_nodes = pierce.place_on(world, 0, "outer", nodes, np.full(3, 1.0 / 3.0))
        slot = world.solver.hold(nodes, at_nodes.weights)
        world.contact = pierce.TipContact(at_nodes, slot, True, True, 0.0, 0.1, np.array([0.0, 0.0, 1.0]))
        tearing.rip_from_jaws(world, 0, held)
        assert (world.contact is not None) == stays
        assert world.solver.compliance.slot_body.count(-1) == free - stays
