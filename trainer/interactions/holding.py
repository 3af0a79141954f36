"""What instruments, needle and thread do to the tissue in one movement.

The tissue is held at the needle's tip, along its shaft, in jaws, and by the thread; its equilibrium tells the
forces, by which it is judged what gives way.
"""

from __future__ import annotations

from dataclasses import dataclass

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
#: Iterations of one solve; the next movement goes on where it stopped. In two stitches none of 5300 solves ended here.
#: With 8 a wall that is pulled fast may no longer tear: while it moves, its forces are never settled enough.
MOST_ITERATIONS = 12


@dataclass(frozen=True)
class Skewered:
    """A hole that the needle is in, and where."""

    hole: Hole
    place: Array  # (3,) mm, of the needle's point that is in it
    tangent: Array  # (3,) of the needle there


def on_needle(world: World) -> list[Skewered]:
    """The holes that the needle is in; one that is ahead of the tip counts as at the tip."""
    if world.needle is None:
        return []
    needle, pose, found = world.needle, world.needle_pose, []
    for hole in world.open_holes():
        if hole.arc <= needle.length:
            arc = max(hole.arc, 0.0)
            place, tangent = pose.apply(needle_point(needle, arc)), pose.rotate(needle_tangent(needle, arc))
            found.append(Skewered(hole, place, tangent))
    return found


def grips(world: World, skewered: list[Skewered]) -> Grips:
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
    for s in skewered:
        add(s.hole.slot, s.place, k * (EVERY_WAY - s.tangent[:, None] * s.tangent), s.hole)
    for i, jaw in enumerate(world.jaws):
        for at, p in zip(jaw.slots, jaw.points, strict=True):
            add(at, jaw.pose.apply(p), k * EVERY_WAY, i)
    return Grips(
        Anchors(np.array(slot, dtype=np.int64), np.array(target).reshape(-1, 3), np.array(stiffness).reshape(-1, 3, 3)),
        tuple(owner),
    )


def drag(world: World, skewered: list[Skewered]) -> Frictions:
    """Friction of needle and thread in their holes, which carry the tissue along until they slide."""
    scene = world.task.scene
    rubbed: list[tuple[Hole, Array, Array, float]] = []
    if scene.needle is not None and (limit := scene.needle.drag_mN.value):
        rubbed += [(s.hole, s.place, s.tangent, limit) for s in skewered]
    if scene.thread is not None and (limit := scene.thread.drag_mN.value):
        threaded = [hole for hole in world.open_holes() if world.needle is None or hole.arc > world.needle.length]
        rubbed += [(h, np.array(p), h.along, limit) for h, p in zip(threaded, world.points(threaded), strict=True)]
    if not rubbed:
        return Frictions.none()
    most = np.array([limit for *_, limit in rubbed])
    return Frictions(
        slot=np.array([hole.slot for hole, *_ in rubbed], dtype=np.int64),
        place=np.array([place + hole.drawn_mm * way for hole, place, way, _ in rubbed]),
        along=np.array([way for *_, way, _ in rubbed]),
        stiffness=most / pierce.FULL_DRAG_MM,
        limit=most,
    )


def equilibrate(world: World, before: Rigid, start_s: float, span_s: float, tool: str, tolerance_mN: float) -> None:
    """Bring the tissue to equilibrium with all that holds it, then judge what gives way."""
    if world.tissue is None or world.solver is None:
        return
    skewered = on_needle(world)
    held = grips(world, skewered)
    rows = thread_pull.constraints(world, lagging=False) if world.thread is not None else None
    taut = thread_pull.cables(world, rows) if rows is not None else []
    world.before[:] = world.solver.x
    found = _solve(world, held, skewered, taut, tolerance_mN)
    if pierce.lift(world, start_s + span_s):
        held = grips(world, skewered)
        found = _solve(world, held, skewered, taut, tolerance_mN)
    tip = next((found.anchor_force[r] for r, who in enumerate(held.owner) if who is None), None)
    if tip is not None and giving_way.settled(found, length(tip)):
        pierce.puncture(world, before, world.needle_pose, tip, start_s, span_s, tool)
    world.tension_mN = float(np.max(found.tension, initial=0.0))
    giving_way.judge(world, held, rows, taut, found, start_s + span_s)


def _solve(
    world: World,
    held: Grips,
    skewered: list[Skewered],
    taut: list[tuple[int, int, Cable]],
    tolerance_mN: float,
) -> Result:
    assert world.solver is not None
    return world.solver.solve(
        held.anchors,
        tuple(c for _, _, c in taut),
        drag(world, skewered),
        tolerance_mN=tolerance_mN,
        max_iterations=MOST_ITERATIONS,
    )
