"""What instruments, needle and thread do to the tissue in one movement.

The tissue is held at the needle's tip, along its shaft, in jaws, and by the thread; its equilibrium tells the
forces, by which it is judged what gives way.
"""

from __future__ import annotations

import numpy as np

from trainer.geometry import Array, Rigid, length
from trainer.instruments.needle import needle_point, needle_tangent
from trainer.interactions import giving_way, pierce, thread_pull
from trainer.interactions.giving_way import Grips
from trainer.interactions.world import Hole, World
from trainer.mechanics.attachments import Anchors, Cable, Frictions
from trainer.mechanics.equilibrium import Result

#: Stiffness of what holds the tissue, in units of modulus times wall thickness: a hundred times the wall's own,
#: so that a held point is off its place by a hundredth of the dent that the force makes.
HOLD = 100.0
#: Unbalanced force at which the tissue counts as in equilibrium, mN, where nobody chose another: a hundredth of a
#: puncture force. In a stitch this leaves nodes 0.1 µm (median; 2.4 µm at most in 99 of 100) from where they would
#: come to rest, and forces 0.01 mN. Stored sessions that name no tolerance were made with it: leave it as it is.
TOLERANCE_MN = 1e-2
#: A hold that resists every way alike.
EVERY_WAY = np.eye(3)
#: Iterations of one solve; the next movement goes on where it stopped. In a stitch 2 solves of 1000 end here. With 6 a
#: wall that is pulled fast no longer tears: while it moves, its forces are never settled enough to be judged.
MOST_ITERATIONS = 8


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
        matrix = k * (EVERY_WAY if world.contact.stuck else n[:, None] * n)
        add(world.contact.slot, world.needle_pose.position, matrix, None)
    if world.needle is not None:
        for hole in world.open_holes():
            if hole.arc <= world.needle.length:
                arc = max(hole.arc, 0.0)
                t = world.needle_pose.rotate(needle_tangent(world.needle, arc))
                on_needle = world.needle_pose.apply(needle_point(world.needle, arc))
                add(hole.slot, on_needle, k * (EVERY_WAY - t[:, None] * t), hole)
    for i, jaw in enumerate(world.jaws):
        for s, p in zip(jaw.slots, jaw.points, strict=True):
            add(s, jaw.pose.apply(p), k * EVERY_WAY, i)
    return Grips(
        Anchors(np.array(slot, dtype=np.int64), np.array(target).reshape(-1, 3), np.array(stiffness).reshape(-1, 3, 3)),
        tuple(owner),
    )


def drag(world: World) -> Frictions:
    """Friction of needle and thread in their holes, which carry the tissue along until they slide."""
    scene = world.task.scene
    slot, place, along, limit = [], [], [], []
    for hole in world.open_holes():
        on_needle = world.needle is not None and hole.arc <= world.needle.length
        spec = scene.needle if on_needle else scene.thread
        if spec is None or spec.drag_mN.value == 0.0:
            continue
        if on_needle:
            assert world.needle is not None
            arc = max(hole.arc, 0.0)
            at = world.needle_pose.apply(needle_point(world.needle, arc))
            way = world.needle_pose.rotate(needle_tangent(world.needle, arc))
        else:
            at, way = world.point(hole.place), hole.along
        slot.append(hole.slot)
        place.append(at + hole.drawn_mm * way)
        along.append(way)
        limit.append(spec.drag_mN.value)
    if not slot:
        return Frictions.none()
    most = np.array(limit)
    return Frictions(np.array(slot, dtype=np.int64), np.array(place), np.array(along), most / pierce.FULL_DRAG_MM, most)


def equilibrate(world: World, before: Rigid, start_s: float, span_s: float, tool: str, tolerance_mN: float) -> None:
    """Bring the tissue to equilibrium with all that holds it, then judge what gives way."""
    if world.tissue is None or world.solver is None:
        return
    held = grips(world)
    rows = thread_pull.constraints(world, lagging=False) if world.thread is not None else None
    taut = thread_pull.cables(world, rows) if rows is not None else []
    world.before[:] = world.solver.x
    found = _solve(world, held, taut, tolerance_mN)
    if pierce.lift(world, start_s + span_s):
        held = grips(world)
        found = _solve(world, held, taut, tolerance_mN)
    tip = next((found.anchor_force[r] for r, who in enumerate(held.owner) if who is None), None)
    if tip is not None and giving_way.settled(found, length(tip)):
        pierce.puncture(world, before, world.needle_pose, tip, start_s, span_s, tool)
    world.tension_mN = float(np.max(found.tension, initial=0.0))
    giving_way.judge(world, held, rows, taut, found, start_s + span_s)


def _solve(world: World, held: Grips, taut: list[tuple[int, int, Cable]], tolerance_mN: float) -> Result:
    assert world.solver is not None
    return world.solver.solve(
        held.anchors,
        tuple(c for _, _, c in taut),
        drag(world),
        tolerance_mN=tolerance_mN,
        max_iterations=MOST_ITERATIONS,
    )
