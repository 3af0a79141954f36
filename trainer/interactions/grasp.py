"""The jaws: what they catch when they close, and when they let go of it (Brown 2001, section 5)."""

from __future__ import annotations

import math

import numpy as np

from trainer.curriculum import InstrumentSpec
from trainer.events import Drop, Grasp, Release, Slip
from trainer.geometry import Array
from trainer.instruments.forceps import jaw_gap_mm
from trainer.instruments.needle import needle_closest
from trainer.interactions.crossing import nearest_on_surface
from trainer.interactions.pierce import place_on
from trainer.interactions.thread_pull import thread_point
from trainer.interactions.world import Jaw, World

#: Area of one jaw's tip on tissue, mm²: 0.1 mm wide and 0.3 mm deep (assumed).
PAD_MM2 = 0.03
#: A second instrument on the needle loses it when the two drift apart by this much, mm (assumed: tips flex).
WRENCH_MM = 0.5


def close_and_open(world: World, closures: Array, time_s: float) -> None:
    """Let the jaws go to ``closures`` (k,) and catch or release what they meet on the way.

    Needle and thread are caught when the closure rises through ``close_at`` and released below ``open_at``; a wall as
    long as the jaws are closer together than it is thick.
    """
    for i, (jaw, spec) in enumerate(zip(world.jaws, world.task.scene.instrument, strict=True)):
        before, jaw.closure = jaw.closure, float(closures[i])
        if spec.kind != "forceps":  # a region's rules are tissue_handling's
            continue
        if jaw.target:
            if jaw.closure < spec.open_at or (jaw.target == "wall" and pressure_kPa(world, i) == 0.0):
                target, body = jaw.target, _body(world, jaw)
                let_go(world, jaw)
                world.emit(Release, time_s, world.tools[i], target=target, body=body)
                _dropped(world, target, time_s, world.tools[i])
            continue
        if before < spec.close_at <= jaw.closure:
            _catch(world, i, jaw, spec, time_s)
        if before < jaw.closure and not jaw.target:
            _catch_wall(world, i, jaw, spec, before, time_s)


def slip(world: World, tool: int, load_mN: float, limit_mN: float, time_s: float) -> None:
    """The held thing is pulled out of the jaws."""
    jaw = world.jaws[tool]
    target, body = jaw.target, _body(world, jaw)
    let_go(world, jaw)
    world.emit(Slip, time_s, world.tools[tool], target=target, body=body, load_mN=load_mN, limit_mN=limit_mN)
    _dropped(world, target, time_s, world.tools[tool])


def let_go(world: World, jaw: Jaw) -> None:
    """Empty the jaws. Who else holds the needle holds it as it lies now."""
    for other in world.jaws:
        if other is not jaw and jaw.target == other.target == "needle":
            other.tool_from_needle = other.pose.inverse() @ world.needle_pose
    for slot in jaw.slots:
        assert world.solver is not None
        world.solver.drop(slot)
    jaw.target, jaw.tool_from_needle, jaw.slots, jaw.points, jaw.vessel = "", None, (), np.zeros((0, 3)), -1
    jaw.wall, jaw.lag_mm = "", 0.0


def hold_needle(world: World, tool: int, arc: float) -> None:
    """Let the jaws hold the needle as it lies now, at ``arc`` mm from its tip."""
    jaw = world.jaws[tool]
    jaw.target, jaw.arc = "needle", arc
    jaw.since = 1 + max(j.since for j in world.jaws)
    jaw.tool_from_needle = jaw.pose.inverse() @ world.needle_pose


def report_held(world: World, time_s: float) -> None:
    """Write a grasp for what the jaws hold as the exercise begins."""
    for i, jaw in enumerate(world.jaws):
        if jaw.target:
            _grasped(world, i, _body(world, jaw), jaw.arc, capacity_mN(world, i), time_s)


def capacity_mN(world: World, tool: int) -> float:
    """The pull that the jaws resist at their present closure.

    Needle and thread: the instrument's grip, in proportion to how far the jaws are closed beyond letting go.
    Wall: two pads rub with the friction coefficient 1/2 (assumed), so the pull equals pressure times area.
    """
    jaw, spec = world.jaws[tool], world.task.scene.instrument[tool]
    if jaw.target == "wall":
        return pressure_kPa(world, tool) * PAD_MM2
    return spec.grip_mN.value * (jaw.closure - spec.open_at) / (1.0 - spec.open_at)


def pressure_kPa(world: World, tool: int) -> float:
    """Pressure of the jaws on a held wall: its modulus times its compression (linear, assumed)."""
    jaw = world.jaws[tool]
    assert world.tissue is not None
    vessel = world.tissue.vessels[jaw.vessel].spec
    return vessel.modulus_kPa.value * max(0.0, 1.0 - jaw_gap_mm(jaw.closure) / vessel.wall_mm)


def second_grips(world: World, time_s: float) -> None:
    """The needle follows the instrument that leads it; another one loses it when they drift apart.

    Two grips of one needle are rigid, so that the load rises until this one slips: at its limit.
    """
    leader = world.needle_tool()
    for i, jaw in enumerate(world.jaws):
        if jaw.target == "needle" and i != leader and jaw.tool_from_needle is not None:
            meant = world.needle_pose @ jaw.tool_from_needle.inverse()
            if math.dist(meant.position, jaw.pose.position) > WRENCH_MM:
                slip(world, i, capacity_mN(world, i), capacity_mN(world, i), time_s)


def _catch(world: World, tool: int, jaw: Jaw, spec: InstrumentSpec, time_s: float) -> None:
    """Grasp the needle, else the thread, where it lies within reach of the jaws' centre."""
    centre = jaw.pose.position
    if world.needle is not None:
        distance, arc = needle_closest(world.needle, world.needle_pose.inverse().apply(centre))
        if distance <= spec.reach_mm:
            hold_needle(world, tool, arc)
            _grasped(world, tool, "", arc, capacity_mN(world, tool), time_s)
            return
    if world.thread is not None:
        distance, arc = thread_point(world, centre)
        if distance <= spec.reach_mm:
            jaw.target, jaw.arc = "thread", arc
            _grasped(world, tool, "", arc, capacity_mN(world, tool), time_s)


def _catch_wall(world: World, tool: int, jaw: Jaw, spec: InstrumentSpec, before: float, time_s: float) -> None:
    """Grasp the nearest wall within reach, if the jaws have just become narrower than it is thick."""
    if world.tissue is None or world.solver is None:
        return
    centre = jaw.pose.position
    found: tuple[float, int, str, int, Array] | None = None
    narrowest = jaw_gap_mm(jaw.closure)
    if all(narrowest >= v.spec.wall_mm for v in world.tissue.vessels):
        return
    for vessel, wall in world.part:
        triangles = world.wall(vessel, wall)
        triangle, weights = nearest_on_surface(centre, world.solver.x, triangles)
        distance = float(np.linalg.norm(weights @ world.solver.x[triangles[triangle]] - centre))
        thick = world.tissue.vessels[vessel].spec.wall_mm
        if not jaw_gap_mm(jaw.closure) < thick <= jaw_gap_mm(before):
            continue
        if distance <= spec.reach_mm and (found is None or distance < found[0]):
            found = (distance, vessel, wall, triangle, weights)
    if found is None:
        return
    _, vessel, wall, triangle, weights = found
    nodes = world.wall(vessel, wall)[triangle]
    corners = [place_on(world, vessel, wall, nodes, w) for w in np.eye(3)]
    jaw.target, jaw.vessel, jaw.wall = "wall", vessel, wall
    jaw.slots = tuple(world.solver.hold(c.nodes, c.weights) for c in corners)
    jaw.points = jaw.pose.inverse().apply(world.solver.x[nodes])
    _grasped(world, tool, _body(world, jaw), 0.0, capacity_mN(world, tool), time_s)


def _grasped(world: World, tool: int, body: str, arc: float, force: float, time_s: float) -> None:
    jaw = world.jaws[tool]
    world.emit(
        Grasp, time_s, world.tools[tool], target=jaw.target, body=body, arc_mm=arc,
        point=world.place_in_world(jaw.pose.position), force_mN=force,
    )  # fmt: skip


def _dropped(world: World, target: str, time_s: float, tool: str) -> None:
    if target == "needle" and world.needle_tool() is None and world.contact is not None and world.solver is not None:
        world.solver.drop(world.contact.slot)  # nobody presses it any more
        world.contact = None
    in_tissue = any(world.needle is not None and h.arc <= world.needle.length for h in world.open_holes())
    if target == "needle" and world.needle_tool() is None and not in_tissue:
        world.emit(Drop, time_s, tool, target="needle", point=world.place_in_world(world.needle_pose.position))


def _body(world: World, jaw: Jaw) -> str:
    return world.tissue.vessels[jaw.vessel].spec.name if world.tissue is not None and jaw.vessel >= 0 else ""
