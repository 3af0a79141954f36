"""What instruments, needle and thread do to the tissue in one movement, and what gives way under it.

The tissue is held at the needle's tip, along its shaft, in jaws, and by the thread; its equilibrium tells the
forces. They are judged afterwards: a wall tears, a grip slips, the thread breaks, a limit is exceeded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.events import Overforce, Tear
from trainer.geometry import Array, Rigid
from trainer.instruments.needle import needle_point, needle_tangent
from trainer.interactions import grasp, pierce, thread_pull
from trainer.interactions.world import Hole, World, vector
from trainer.mechanics.attachments import Anchors, Cable, Loads

#: Stiffness of what holds the tissue, in units of modulus times wall thickness: a hundred times the wall's own,
#: so that a held point is off its place by a hundredth of the dent that the force makes.
HOLD = 100.0
#: Unbalanced force at which the tissue counts as in equilibrium, mN: a thousandth of a puncture force.
TOLERANCE_MN = 2e-3
#: Iterations of one solve; the next tick goes on where it stopped.
MOST_ITERATIONS = 30
#: Sliding in one movement at which friction in a hole is fully developed, mm (assumed).
FULL_DRAG_MM = 0.005
#: An exceeded limit counts again once the value has fallen below this share of it.
REARM = 0.9


@dataclass(frozen=True)
class Grips:
    """Who holds the tissue where: row by row the anchors of one solve."""

    anchors: Anchors
    owner: tuple[Hole | int | None, ...]  # a hole on the needle, an instrument, or None for the needle's tip


def grips(world: World) -> Grips:
    """The anchors of tip, shaft and jaws at the places where needle and instruments are now."""
    assert world.tissue is not None
    slot: list[int] = []
    target: list[Array] = []
    stiffness: list[Array] = []
    owner: list[Hole | int | None] = []

    def add(at: int, place: Array, matrix: Array, who: Hole | int | None) -> None:
        slot.append(at)
        target.append(place)
        stiffness.append(matrix)
        owner.append(who)

    k = HOLD * max(v.spec.modulus_kPa.value * v.spec.wall_mm for v in world.tissue.vessels)
    if world.contact is not None:
        n = world.contact.normal
        matrix = k * (np.eye(3) if world.contact.stuck else np.outer(n, n))
        add(world.contact.slot, world.needle_pose.position, matrix, None)
    if world.needle is not None:
        for hole in world.open_holes():
            if hole.arc <= world.needle.length:
                arc = max(hole.arc, 0.0)
                t = world.needle_pose.rotate(needle_tangent(world.needle, arc))
                on_needle = world.needle_pose.apply(needle_point(world.needle, arc))
                add(hole.slot, on_needle, k * (np.eye(3) - np.outer(t, t)), hole)
    for i, jaw in enumerate(world.jaws):
        for s, p in zip(jaw.slots, jaw.points, strict=True):
            add(s, jaw.pose.apply(p), k * np.eye(3), i)
    return Grips(
        Anchors(np.array(slot, dtype=np.int64), np.array(target).reshape(-1, 3), np.array(stiffness).reshape(-1, 3, 3)),
        tuple(owner),
    )


def drag(world: World) -> Loads:
    """Friction of needle and thread in their holes, along the way they ran in the last movement."""
    scene = world.task.scene
    slot, force = [], []
    for hole in world.open_holes():
        on_needle = world.needle is not None and hole.arc <= world.needle.length
        spec = scene.needle if on_needle else scene.thread
        if spec is not None and hole.slid_mm != 0.0:
            slot.append(hole.slot)
            force.append(spec.drag_mN.value * max(-1.0, min(1.0, hole.slid_mm / FULL_DRAG_MM)) * hole.along)
    return Loads(np.array(slot, dtype=np.int64), np.array(force).reshape(-1, 3)) if slot else Loads.none()


def equilibrate(world: World, before: Rigid, start_s: float, span_s: float, tool: str) -> None:
    """Bring the tissue to equilibrium with all that holds it, then see what gives way."""
    if world.tissue is None or world.solver is None:
        return
    end_s = start_s + span_s
    held = grips(world)
    taut: list[tuple[int, int, Cable]] = []
    if world.thread is not None:
        rows = thread_pull.constraints(world)
        taut = thread_pull.cables(rows)
    world.before = world.solver.x.copy()
    found = world.solver.solve(
        held.anchors,
        tuple(c for _, _, c in taut),
        drag(world),
        tolerance_mN=TOLERANCE_MN,
        max_iterations=MOST_ITERATIONS,
    )
    force = found.anchor_force
    tip = next((force[r] for r, who in enumerate(held.owner) if who is None), None)
    if tip is not None:
        pierce.puncture(world, before, world.needle_pose, tip, start_s, span_s, tool)
    _judge_needle(world, held, force, end_s)
    _judge_jaws(world, held, force, end_s)
    world.tension_mN = float(np.max(found.tension, initial=0.0))
    for (first, last, cable), tension in zip(taut, found.tension, strict=True):
        _judge_thread(world, rows, first, last, cable, float(tension), end_s)
    _limits(world, held, force, end_s)


def _judge_needle(world: World, held: Grips, force: Array, time_s: float) -> None:
    """A wall tears where the needle's shaft pulls too hard; the needle slips out of jaws that hold it too weakly."""
    total = np.zeros(3)
    for r, who in enumerate(held.owner):
        if isinstance(who, int):
            continue
        total += force[r]
        if isinstance(who, Hole):
            _tear(world, who, float(np.linalg.norm(force[r])), time_s)
    holder = world.needle_tool()
    if holder is not None:
        load, limit = float(np.linalg.norm(total)), grasp.capacity_mN(world, holder)
        if load > limit:
            grasp.slip(world, holder, load, limit, time_s)


def _judge_jaws(world: World, held: Grips, force: Array, time_s: float) -> None:
    for i, jaw in enumerate(world.jaws):
        if jaw.target != "wall":
            continue
        load = float(
            np.linalg.norm(
                sum((force[r] for r, who in enumerate(held.owner) if who is not None and who == i), np.zeros(3))
            )
        )
        assert world.tissue is not None
        tear = world.tissue.vessels[jaw.vessel].spec.tear_mN.value
        limit = grasp.capacity_mN(world, i)
        if load > tear:
            body = world.tissue.vessels[jaw.vessel].spec.name
            grasp.let_go(world, jaw)
            world.emit(
                Tear, time_s, world.tools[i], body=body, wall="outer", hole=-1, point=vector(jaw.pose.position),
                force_mN=load, limit_mN=tear,
            )  # fmt: skip
        elif load > limit:
            grasp.slip(world, i, load, limit, time_s)


def _judge_thread(
    world: World, rows: thread_pull.Constraints, first: int, last: int, cable: Cable, tension: float, time_s: float
) -> None:
    """A taut thread slips from the weaker of its grips, breaks, or cuts through the wall: whichever comes first."""
    spec = world.task.scene.thread
    assert spec is not None
    gripping = [i for i in (rows.grip[first], rows.grip[last]) if i >= 0]
    if rows.grip[first] < 0 and (leader := world.needle_tool()) is not None:
        gripping.append(leader)
    weakest = min(gripping, key=lambda i: grasp.capacity_mN(world, i), default=None)
    limit = grasp.capacity_mN(world, weakest) if weakest is not None else math.inf
    if weakest is not None and tension > limit and limit <= spec.strength_mN.value:
        grasp.slip(world, weakest, tension, limit, time_s)
        return
    if tension > spec.strength_mN.value:
        thread_pull.snap(world, 0.5 * float(rows.arc[first] + rows.arc[first + 1]), tension, time_s)
        return
    for row in range(first + 1, last):
        hole = rows.hole[row]
        if hole is not None:
            pull = np.zeros(3)
            for k, inside in ((row - 1, cable.channel[row - 1 - first]), (row + 1, cable.channel[row - first])):
                way = rows.position[k] - rows.position[row]
                size = float(np.linalg.norm(way))
                if not inside and size > 0.0:
                    pull += tension * way / size
            _tear(world, hole, float(np.linalg.norm(pull)), time_s)


def relieve(world: World, time_s: float) -> None:
    """A thread drawn further than it and the tissue can give: the weaker grip slips, or it breaks."""
    if world.thread is None:
        return
    spec = world.task.scene.thread
    assert spec is not None
    while (found := thread_pull.overdrawn(world)) is not None:
        gripping, arc = found
        weakest = min(gripping, key=lambda i: grasp.capacity_mN(world, i), default=None)
        limit = grasp.capacity_mN(world, weakest) if weakest is not None else math.inf
        if weakest is not None and limit <= spec.strength_mN.value:
            grasp.slip(world, weakest, limit, limit, time_s)
        else:
            thread_pull.snap(world, arc, spec.strength_mN.value, time_s)


def _tear(world: World, hole: Hole, load: float, time_s: float) -> None:
    assert world.tissue is not None
    limit = world.tissue.vessels[hole.place.vessel].spec.tear_mN.value
    if load <= limit or not hole.open:
        return
    pierce.close(world, hole)
    world.emit(
        Tear, time_s, "", body=world.vessel_name(hole.place), wall=hole.place.wall, hole=hole.number,
        point=vector(world.point(hole.place)), force_mN=load, limit_mN=limit,
    )  # fmt: skip


def _limits(world: World, held: Grips, force: Array, time_s: float) -> None:
    """Report the task's limits that are exceeded, once for each excursion."""
    by_needle = np.zeros(3)
    by_jaw = [np.zeros(3) for _ in world.jaws]
    for r, who in enumerate(held.owner):
        if isinstance(who, int):
            by_jaw[who] += force[r]
        else:
            by_needle += force[r]
    world.tissue_force_mN = max(
        world.tension_mN, float(np.linalg.norm(by_needle)), *(float(np.linalg.norm(f)) for f in by_jaw)
    )
    _check(world, "tissue_pull", world.tissue_force_mN, "", "", time_s)
    for i, jaw in enumerate(world.jaws):
        pressure = grasp.pressure_kPa(world, i) if jaw.target == "wall" else 0.0
        body = world.tissue.vessels[jaw.vessel].spec.name if world.tissue is not None and jaw.vessel >= 0 else ""
        _check(world, "grasp_pressure", pressure, world.tools[i], body, time_s)


def _check(world: World, name: str, value: float, tool: str, body: str, time_s: float) -> None:
    limit = world.task.limits.get(name)
    if limit is None:
        return
    key = f"{name} {tool}"
    if value > limit.value and key not in world.over:
        world.over.add(key)
        world.emit(Overforce, time_s, tool, body=body, quantity=name, value=value, limit=limit.value, unit=limit.unit)
    elif value < REARM * limit.value:
        world.over.discard(key)
