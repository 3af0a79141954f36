"""Hard cases of whole exercises, as a device or a trainee may bring them about, in the tasks that are trained.

The law in all of them, at every tick: tissue, thread and needle are finite, no link of the thread is off its length by
more than 1e-6, what tears or slips is reported with a force above its limit, and no node of the thread leaps: it goes
no further than what holds it, and than its slack between two grips or holes lets it (``bench.scene_laws`` derives the
bound).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from trainer import scene
from trainer.bench.scene_laws import settled, step, tissue
from trainer.curriculum import Task, load_task
from trainer.drivers.hand_motion import needle_pose
from trainer.drivers.scripted import ScriptedHands
from trainer.events import Event, Pierce
from trainer.geometry import Array
from trainer.interactions import thread_pull
from trainer.mechanics.links import energy
from trainer.poses import ToolPoses
from trainer.profile import Hand
from trainer.scene import Scene
from trainer.session import NO_POSE, admit

LEFT, RIGHT = 0, 1
#: A leap of the tracker, mm.
JUMP_MM = 20.0
#: Two ways to one place end on the same branch when no node is further apart, radii (as in hard_vessel).
BRANCH = 1e-2


def task_of(name: str) -> Task:
    return load_task(f"anastomosis/{name}").task


def instruments(s: Scene, tool: int, position: Array, closure: float) -> ToolPoses:
    """The instruments where they are, but ``tool`` at ``position`` with its jaws at ``closure``."""
    now = s.view().poses
    place, jaws = now.position.copy(), now.closure.copy()
    place[tool], jaws[tool] = position, closure
    return ToolPoses(place, now.quaternion, jaws, np.ones(2, dtype=bool))


def place_of(s: Scene, tool: int) -> Array:
    return np.array(s.view().poses.position[tool])


def _go(s: Scene, tool: int, to: Array, closure: float, step_mm: float) -> list[Event]:
    """Move an instrument straight to a place, ``step_mm`` at a tick, until the exercise ends."""
    start = place_of(s, tool)
    ticks = max(1, math.ceil(math.dist(to, start) / step_mm))
    events: list[Event] = []
    for k in range(1, ticks + 1):
        if not s.outcome:
            events += step(s, instruments(s, tool, start + k / ticks * (to - start), closure))
    return events


def _close(s: Scene, tool: int, closure: float) -> list[Event]:
    start, ticks = float(s.view().poses.closure[tool]), 10
    return [
        e
        for k in range(1, ticks + 1)
        for e in step(s, instruments(s, tool, place_of(s, tool), start + k / ticks * (closure - start)))
    ]


def _kinds(events: list[Event]) -> str:
    kinds = [e.kind for e in events if e.kind not in ("task_started", "step_done", "task_done")]
    return ", ".join(f"{kinds.count(k)} {k}" for k in dict.fromkeys(kinds)) or "nothing"


def two_in_one_triangle() -> str:
    """A second pass where the first left its thread: both hulls are pierced again, each within one triangle's reach.

    In the outer hull both holes are on the same three nodes. Thread and needle then hold the wall at two places that
    three nodes carry, and in the end no other node is out of balance.
    """
    task = task_of("single-stitch")
    first = replace(task.step[0], clock_deg=4.0, bite_mm=0.33)
    again = replace(first, name="again", clock_deg=5.0, bite_mm=0.34)
    task = replace(task, step=(first, again))
    s, events = _performed(task)
    made = [(e.wall, e.pass_number) for e in events if isinstance(e, Pierce)]
    assert made == [("outer", 1), ("inner", 1), ("outer", 2), ("inner", 2)], f"holes {made}"
    holes = [h for h in s.world.open_holes() if h.place.wall == "outer"]
    assert len(holes) == 2, f"{len(holes)} holes are open"
    assert set(holes[0].place.nodes.tolist()) == set(holes[1].place.nodes.tolist()), "they are in two triangles"
    for _ in range(100):
        events += step(s, s.view().poses)
    apart = math.dist(holes[0].place.weights, holes[1].place.weights)
    return f"ok: {_kinds(events)}; weights {apart:.2f} apart; {settled(s):.0e} mN unbalanced in the end"


def _needle_in_wall(name: str) -> Scene:
    """A scripted hand has driven the needle through both hulls of a wall."""
    task = task_of(name)
    s = scene.build(task)
    hands = ScriptedHands(Hand(), task, s.home, 0)
    while not s.steps_done:
        seen = hands.poll(s.tick, s.view())
        assert seen is not None, f"the hand stopped: {hands.summary()['stopped']}"
        step(s, seen)
    return s


def _threaded() -> Scene:
    """Both instruments hold the thread, 4 mm of it between them; the needle is dropped."""
    s = scene.build(task_of("single-stitch"))
    _go(s, LEFT, s.world.nodes[40].copy(), 0.0, 0.5)
    _close(s, LEFT, 1.0)
    _close(s, RIGHT, 0.0)
    _go(s, RIGHT, s.world.nodes[20].copy(), 0.0, 0.5)
    _close(s, RIGHT, 1.0)
    assert s.view().thread_holders == (LEFT, RIGHT), "the jaws do not hold the thread"
    return s


def jump(name: str, direction: tuple[float, float, float]) -> str:
    """The needle in the wall; its instrument leaps 20 mm in a tick, waits a second, leaps back, and waits.

    In the end the tissue is in equilibrium, to ``SETTLED_mN`` at every node that nothing holds.
    """
    s = _needle_in_wall(name)
    here, events = place_of(s, RIGHT), list[Event]()
    way = s.world.world_from_scene.rotate(s.world.needle_pose.rotate(np.array(direction)))
    for place in (here + JUMP_MM * way, here):
        for _ in range(100):
            if not s.outcome:
                events += step(s, instruments(s, RIGHT, place, 1.0))
    return f"ok: {_kinds(events)}; {settled(s):.0e} mN unbalanced in the end"


def pulled_apart(closure: float, step_mm: float) -> str:
    """Instruments that hold a slack thread draw apart: it breaks in firm jaws, and slips from loose ones, once."""
    s = _threaded()
    for tool in (LEFT, RIGHT):
        _close(s, tool, closure)
    between = place_of(s, RIGHT) - place_of(s, LEFT)
    _go(s, RIGHT, place_of(s, LEFT) + 0.7 * between, closure, 0.05)
    assert s.view().thread_holders == (LEFT, RIGHT), "the thread was lost while it was slack"
    events = _go(s, RIGHT, place_of(s, LEFT) + max(1.1, 0.7 + step_mm) * between, closure, step_mm)
    found, ending = [e.kind for e in events if e.kind in ("break", "slip")], "break" if closure == 1.0 else "slip"
    assert found == [ending], f"it ended in {found}, not in one {ending}"
    return f"ok: {_kinds(events)}; lengths to {thread_pull.stretch(s.world):.0e}"


def grazing(name: str) -> str:
    """The needle slides along the top of the vessel at 2 degrees, 1.5 mm far: 0.05 mm deep, which is no puncture."""
    s = scene.build(task_of(name))
    needle = s.world.needle
    assert needle is not None
    point, normal = s.view().look("A", 0.0, 0.6, "outer")
    axis = s.view().vessel_axis["A"]
    flat = math.radians(2.0)
    heading = math.cos(flat) * axis - math.sin(flat) * normal
    upright = math.cos(flat) * normal + math.sin(flat) * axis
    needle_from_tool = s.world.needle_pose.inverse() @ s.world.jaws[RIGHT].pose
    home, events, most = s.home, list[Event](), 0.0
    for k in range(150):
        tip = needle_pose(point + (0.01 * k - 0.3) * heading, heading, upright, 0.0, needle.radius)
        tool = tip @ needle_from_tool
        place, turn = home.position.copy(), home.quaternion.copy()
        place[RIGHT], turn[RIGHT] = tool.position, tool.quaternion
        events += step(s, ToolPoses(place, turn, home.closure, np.ones(2, dtype=bool)))
        most = max(most, s.world.tissue_force_mN)
    kinds = [e.kind for e in events]
    assert "contact" in kinds, "the needle went by"
    assert "pierce" not in kinds, "the needle made a hole"
    return f"ok: {_kinds(events)}; up to {most:.2g} mN"


def _performed(task: Task) -> tuple[Scene, list[Event]]:
    """The scene when a hand without fault has performed a task, and what happened."""
    s = scene.build(task)
    hands, events = ScriptedHands(Hand(), task, s.home, 0), list[Event]()
    while not s.outcome:
        seen = hands.poll(s.tick, s.view())
        assert seen is not None, f"the hand stopped: {hands.summary()['stopped']}"
        events += step(s, seen)
    return s, events


def _drive(tick_hz: float) -> Pierce:
    """One drive by a hand without fault: both hulls, once each."""
    task = task_of("needle-drive")
    task = replace(task, step=task.step[:1], tick_hz=tick_hz)
    s, events = _performed(task)
    made = [(e.wall, e.direction) for e in events if isinstance(e, Pierce)]
    assert s.outcome == "completed", f"the drive ended: {s.outcome}"
    assert made == [("outer", "in"), ("inner", "in")], f"holes {made}"
    return next(e for e in events if isinstance(e, Pierce))


def ticks(tick_hz: float) -> str:
    """The hole is where it is at the usual 10 ms, but for what the hand presses on in the longer tick.

    The hand sees the wall once a tick, and presses 1 mm/s, a quarter of its speed.
    """
    usual, found = _drive(100.0), _drive(tick_hz)
    off = math.dist(usual.point, found.point)
    most = 0.25 * Hand().speed_mm_s * max(0.01, 1.0 / tick_hz)
    assert off <= most, f"the hole is {off:.2g} mm from where it was at 10 ms"
    turned = abs(usual.entry_angle_deg - found.entry_angle_deg)
    return f"ok: both hulls; the hole within {off:.1e} mm and {turned:.1e} degrees of that at ticks of 10 ms"


BAD_POSES: dict[str, Callable[[ToolPoses], ToolPoses]] = {
    "a place that is not a number": lambda p: _spoilt(p, position=math.nan),
    "a place that is infinite": lambda p: _spoilt(p, position=-math.inf),
    "a turn that is not a number": lambda p: _spoilt(p, quaternion=math.nan),
    "a turn that is infinite": lambda p: _spoilt(p, quaternion=math.inf),
    "a turn that is denormal": lambda p: _spoilt(p, quaternion=5e-324),
    "a closure that is not a number": lambda p: _spoilt(p, closure=math.nan),
}


def _spoilt(
    p: ToolPoses, position: float | None = None, quaternion: float | None = None, closure: float | None = None
) -> ToolPoses:
    """The right instrument's numbers replaced."""
    place, turn, jaws = p.position.copy(), p.quaternion.copy(), p.closure.copy()
    if position is not None:
        place[RIGHT] = position
    if quaternion is not None:
        turn[RIGHT] = quaternion
    if closure is not None:
        jaws[RIGHT] = closure
    return ToolPoses(place, turn, jaws, p.valid)


def bad_poses(spoil: Callable[[ToolPoses], ToolPoses]) -> str:
    """With the needle in the wall 20 bad poses come, then good ones: as if the device had lost the instrument.

    Bit by bit: the events, the tissue, the thread and the needle.
    """
    ends = []
    for spoilt in (True, False):
        s = _needle_in_wall("single-stitch")
        held, events, here = s.view().poses, list[Event](), place_of(s, RIGHT)
        for k in range(40):
            good = instruments(s, RIGHT, here + 0.01 * k * np.array([0.0, 0.0, 1.0]), 1.0)
            lost = replace(good, valid=np.arange(2) != RIGHT, reason=tuple(NO_POSE * (i == RIGHT) for i in range(2)))
            seen = good if k >= 20 else admit(spoil(good), held) if spoilt else lost
            events += step(s, seen)
            held = seen
        ends.append((events, s.world.needle_pose.position, s.world.nodes, tissue(s.world)))
    (refused, *numbers), (expected, *others) = ends
    assert "tracking_lost" in [e.kind for e in refused], "the poses were taken"
    assert refused == expected, "other events than without the poses"
    for a, b in zip(numbers, others, strict=True):
        assert np.array_equal(a, b), "another scene than without the poses"
    return f"refused: {_kinds(refused)}; bit by bit as if the instrument had been lost"


def denormal_place() -> str:
    """A place of 5e-324 mm is one like any other: the same as at 0."""
    ends = []
    for place in (5e-324, 0.0):
        s = _needle_in_wall("single-stitch")
        poses = _spoilt(s.view().poses, position=place)
        taken = admit(poses, s.view().poses)
        assert taken.valid.all(), "the place was refused"
        for _ in range(20):
            step(s, taken)
        ends.append((s.world.needle_pose.position, s.world.nodes, tissue(s.world)))
    apart = max(float(np.max(np.abs(a - b))) for a, b in zip(*ends, strict=True))
    assert apart <= 1e-9, f"{apart:.1e} mm from where 0 leads"
    return f"ok: {apart:.0e} mm from where 0 leads"


def _pushed(depth: float, step_mm: float) -> tuple[list[Event], Array]:
    """Closed jaws on a patch of the wall push it in by so many radii and wait a second: also where it lies then.

    They hold it, or it slips or tears. Held, the tissue comes to equilibrium, and has no more energy than if nothing
    but the held nodes had moved; let go, it goes back to rest.
    """
    s = scene.build(task_of("needle-drive"))
    world = s.world
    assert world.solver is not None
    place, normal = s.view().look("A", 90.0, 0.6, "outer")
    _go(s, LEFT, place, 0.0, 0.5)
    _close(s, LEFT, 1.0)
    jaw, mesh = world.jaws[LEFT], world.solver.mesh
    assert jaw.target == "wall", "the jaws do not hold the wall"
    nodes = [int(np.argmin(np.linalg.norm(world.solver.x - p, axis=1))) for p in jaw.pose.apply(jaw.points)]
    radius = 0.5 * world.task.scene.vessel[0].outer_diameter_mm
    events = _go(s, LEFT, place - depth * radius * normal, 1.0, step_mm)
    for _ in range(100):
        events += step(s, instruments(s, LEFT, place_of(s, LEFT), 1.0))
    settled(s)
    if jaw.target == "wall":
        moved = mesh.rest.copy()
        moved[nodes] = jaw.pose.apply(jaw.points)
        share = energy(mesh, world.solver.x) / energy(mesh, moved)
        assert share <= 1.0, f"{share:.2g} times the energy of the held nodes moved alone"
    x = world.solver.x.copy()
    _close(s, LEFT, 0.0)
    for _ in range(100):
        step(s, s.view().poses)
    off = float(np.max(np.abs(world.solver.x - mesh.rest)))
    assert off <= 1e-6, f"let go, the wall stays {off:.2g} mm off"
    return events, x / radius


def pushed_in(depth: float) -> str:
    """In one tick, and by 0.01 mm a tick: both end alike."""
    at_once, x = _pushed(depth, JUMP_MM)
    slowly, reference = _pushed(depth, 0.01)
    assert _kinds(at_once) == _kinds(slowly), f"at once {_kinds(at_once)}, slowly {_kinds(slowly)}"
    apart = float(np.max(np.linalg.norm(x - reference, axis=1)))
    assert apart <= BRANCH, f"another branch, {apart:.2f} R away"
    return f"ok: {_kinds(at_once)} lost; {apart:.0e} R from where small steps lead, and back to rest"


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """(case, method, run); the method is the task whose scene meets the case."""
    ways = {"on along": (1.0, 0.0, 0.0), "back along": (-1.0, 0.0, 0.0), "across": (0.0, 1.0, 0.0),
            "across, the other way,": (0.0, -1.0, 0.0), "sideways to": (0.0, 0.0, 1.0)}  # fmt: skip
    tasks = ("needle-drive", "single-stitch")
    found: list[tuple[str, str, Callable[[], str]]] = []
    for how, way in ways.items():
        found += [(f"tracker jumps 20 mm {how} the needle in the wall", t, partial(jump, t, way)) for t in tasks]
    for closure, jaws in ((1.0, "firm"), (0.8, "loose")):
        for stride in (0.01, 0.1, JUMP_MM):
            case = f"{jaws} jaws draw the thread apart by {stride:g} mm a tick"
            found.append((case, "single-stitch", partial(pulled_apart, closure, stride)))
    found += [("needle grazes the wall at 2 degrees", t, partial(grazing, t)) for t in tasks]
    found.append(("thread and needle through one triangle", "single-stitch", two_in_one_triangle))
    found += [(f"ticks of {1e3 / hz:g} ms", "needle-drive", partial(ticks, hz)) for hz in (1000.0, 20.0)]
    found += [(f"poses with {bad}", "single-stitch", partial(bad_poses, spoil)) for bad, spoil in BAD_POSES.items()]
    found.append(("poses with a denormal place", "single-stitch", denormal_place))
    for depth in (0.5, 0.8, 1.2):
        case = f"closed forceps push the wall in by {depth:g} R in one tick"
        found.append((case, "needle-drive", partial(pushed_in, depth)))
    return found
