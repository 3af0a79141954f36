"""The needle's tip and a wall: contact, piercing, and the holes that the needle then goes through.

A tip that meets a wall sticks to the material it touched and dents it, until the force along the needle
reaches the wall's puncture force (Brown 2001, section 5: a collision of needle and vessel face). The instant
of puncture is interpolated between the two ends of the movement, and so are the values of the event.
"""

from __future__ import annotations

import math

import numpy as np

from trainer.anatomy.vessel import material_coordinates, ring, wall_point
from trainer.curriculum import VesselSpec
from trainer.events import Contact, Pierce, PullThrough, Withdraw
from trainer.geometry import Array, Rigid, length, unit
from trainer.instruments.needle import needle_closest, needle_point, needle_tangent
from trainer.interactions.crossing import first_crossing, nearest_on_surface, side
from trainer.interactions.world import Hole, LastSeen, Place, TipContact, World

#: A tip pushed hard but not along itself goes through as well, at this many puncture forces (assumed).
SIDEWAYS = 2.0
#: A tip that lifts off a wall and is back this soon, s, has never left it: one touch, one event (assumed).
SAME_TOUCH_S = 0.1
#: A hole this far ahead of the tip, mm, has slipped off it, however the wall is bent (assumed: a wire's thickness).
SLIPPED_MM = 0.07
#: Way through a hole over which friction develops, mm (assumed).
FULL_DRAG_MM = 0.02
#: Needle behind the tip, mm, up to which the wall next to its hole counts as already crossed.
JUST_THROUGH_MM = 0.4


def detect(world: World, before: Rigid, after: Rigid, start_s: float, span_s: float, tool: str) -> None:
    """Begin a contact where the tip meets a wall on its way from ``before`` to ``after`` (world_from_needle)."""
    if world.contact is not None:
        world.contact.fraction = 0.0
    if world.tissue is None or world.solver is None or world.contact is not None or world.last_seen is not None:
        return
    triangles = world.surface
    passed_by = passed(world, JUST_THROUGH_MM)
    hit = first_crossing(before.position, after.position, world.before, world.solver.x, triangles, passed_by)
    if hit is None:
        return
    triangle, fraction, inwards, weights = hit
    vessel, wall = world.wall_of(triangle)
    place = place_on(world, vessel, wall, triangles[triangle], weights)
    normal, _ = world.undented(place)
    slot = world.solver.hold(place.nodes, place.weights)
    world.contact = TipContact(place, slot, inwards, _sticks(world, after, normal), fraction, 0.0, normal)
    now, last = start_s + fraction * span_s, world.touched.get((place.vessel, place.wall), -math.inf)
    if now - last < SAME_TOUCH_S:
        return
    point = before.position + fraction * (after.position - before.position)
    world.emit(
        Contact, now, tool, body=world.vessel_name(place), wall=place.wall,
        direction="in" if inwards else "out", point=world.place_in_world(point), axial_mm=place.axial_mm,
        clock_deg=math.degrees(place.clock),
    )  # fmt: skip


def glide(world: World) -> None:
    """A tip too flat to stick slides along the wall: it now touches the material nearest to it."""
    contact = world.contact
    if contact is None or contact.stuck or world.solver is None:
        return
    tip = world.needle_pose.position
    triangles = world.wall(contact.place.vessel, contact.place.wall)
    triangle, weights = nearest_on_surface(tip, world.solver.x, triangles)
    world.solver.drop(contact.slot)
    contact.place = place_on(world, contact.place.vessel, contact.place.wall, triangles[triangle], weights)
    contact.slot = world.solver.hold(contact.place.nodes, contact.place.weights)


def lift(world: World, time_s: float) -> bool:
    """End the contact where the wall pulls at the tip: it is back on the side that it came from, as the wall lies now.

    Returns whether it ended. The wall then goes back to where it lies without the tip, which may take it over the tip
    again: a contact anew, at what it touches there. So a tip that is drawn along a wall, or off it, takes none of the
    wall with it.
    """
    contact = world.contact
    if contact is None or world.solver is None:
        return False
    world.touched[contact.place.vessel, contact.place.wall] = time_s
    if _side(world, contact.place) * (1.0 if contact.inwards else -1.0) <= 0.0:
        return False
    world.solver.drop(contact.slot)
    world.contact = None
    world.before[:] = world.solver.x
    return True


def puncture(world: World, before: Rigid, after: Rigid, force: Array, start_s: float, span_s: float, tool: str) -> None:
    """Make the contact a hole where the wall gives way to the ``force`` (3,) mN of the tip at a movement's end."""
    contact = world.contact
    if contact is None or world.tissue is None or world.solver is None:
        return
    normal, surface = world.undented(contact.place)
    tangent = after.rotate(np.array([1.0, 0.0, 0.0]))
    along, limit = float(force @ tangent), _puncture_mN(world, contact.place)
    reached = max(along, length(force) / SIDEWAYS)
    if reached < limit:
        contact.stuck = _sticks(world, after, normal)
        contact.force_mN, contact.normal = reached, normal
        return
    rise = reached - contact.force_mN
    share = contact.fraction + (1.0 - contact.fraction) * ((limit - contact.force_mN) / rise if rise > 0.0 else 1.0)
    tip = before.position + share * (after.position - before.position)
    heading = before.rotate(np.array([1.0, 0.0, 0.0]))
    heading = unit(heading + share * (tangent - heading))
    upright = unit(contact.normal + share * (normal - contact.normal))
    if all(h.arc > _needle_length(world) for h in world.open_holes()):
        world.passes += 1
    hole = Hole(
        len(world.holes), contact.place, contact.slot, contact.inwards, world.passes, upright, arc=0.0,
        around=_around(world, contact.place), edge=_edge(world, contact.place),
    )  # fmt: skip
    world.holes.append(hole)
    world.contact = None
    world.emit(
        Pierce, start_s + share * span_s, tool, body=world.vessel_name(hole.place), wall=hole.place.wall,
        direction="in" if hole.inwards else "out", pass_number=hole.pass_number, hole=hole.number,
        point=world.place_in_world(tip), axial_mm=hole.place.axial_mm, clock_deg=math.degrees(hole.place.clock),
        tangent=world.way_in_world(heading), normal=world.way_in_world(upright),
        entry_angle_deg=math.degrees(math.asin(min(1.0, abs(float(heading @ upright))))),
        force_mN=limit if reached == along else SIDEWAYS * limit, depth_mm=float((surface - tip) @ upright),
    )  # fmt: skip


def follow_needle(world: World, time_s: float, tool: str) -> None:
    """Bring each hole on the needle to the arc at which the needle now goes through it."""
    if world.needle is None or world.solver is None:
        return
    rear = world.needle.length
    needle_from_scene = world.needle_pose.inverse()
    holes = [hole for hole in world.open_holes() if hole.arc <= rear]
    for hole, place in zip(holes, world.points(holes), strict=True):
        point = np.array(place)
        arc = _arc_through(world, needle_from_scene.apply(point))
        draw(hole, arc)
        beyond = (world.needle_pose.position - point) @ hole.normal
        hole.reached_mm = max(hole.reached_mm, float(-beyond if hole.inwards else beyond))
        shared = {
            "body": world.vessel_name(hole.place), "wall": hole.place.wall, "hole": hole.number,
            "pass_number": hole.pass_number, "reached_mm": hole.reached_mm,
        }  # fmt: skip
        outside = _side(world, hole.place) * (1.0 if hole.inwards else -1.0) > 0.0
        if (arc < 0.0 and outside) or arc < -SLIPPED_MM:
            close(world, hole)
            world.before[:] = world.solver.x  # out of the hole as the wall lies now
            if world.last_seen is not None:
                world.last_seen = LastSeen(world.needle_pose.position, world.before.copy())
            world.emit(Withdraw, time_s, tool, end="tip", **shared)
        elif arc > rear:
            hole.drawn_mm = 0.0
            world.emit(PullThrough, time_s, tool, **shared)
            if world.thread is None:
                close(world, hole)


def draw(hole: Hole, arc: float) -> None:
    """What is in the hole runs on to ``arc``, and draws the tissue along until friction is fully developed.

    Coulomb friction with a short elastic way before it slides (Dahl 1968): without it the force would jump from one
    direction to the other at each tremor of the hand, and shake the wall.
    """
    hole.drawn_mm = min(FULL_DRAG_MM, max(-FULL_DRAG_MM, hole.drawn_mm + arc - hole.arc))
    hole.arc = arc


def close(world: World, hole: Hole) -> None:
    """Nothing goes through the hole any more; the mark stays."""
    assert world.solver is not None
    world.solver.drop(hole.slot)
    hole.open = False


def place_on(world: World, vessel: int, wall: str, nodes: np.ndarray, weights: Array) -> Place:
    """The material point of a triangle (3,) of the whole tissue's nodes, with barycentric ``weights`` (3,)."""
    assert world.tissue is not None
    inside = np.clip(weights, 0.0, None)
    inside = inside / inside.sum()
    v = world.tissue.vessels[vessel]
    axial, clock = material_coordinates(v, nodes - world.tissue.offset[vessel], inside)
    return Place(vessel, wall, nodes.astype(np.int32), inside, axial, clock, ring(v, clock, axial))


def passed(world: World, arc: float) -> np.ndarray:
    """Triangles (f,) bool of the walls that touch a hole which is less than ``arc`` mm behind the tip, or ahead of
    it; and those that a tear has opened."""
    skip = world.slit.copy()
    for hole in world.open_holes():
        if hole.arc < arc:
            skip[hole.around] = True
    return skip


def _around(world: World, place: Place) -> np.ndarray:
    """The triangles (k,) of its wall that touch that of ``place``."""
    first, last = world.part[place.vessel, place.wall]
    return first + np.flatnonzero(np.isin(world.surface[first:last], place.nodes).any(axis=1))


def _edge(world: World, place: Place) -> tuple[np.ndarray, Array]:
    """The material point of the cut edge at the hour of ``place``: nodes (3,) of the whole tissue, weights (3,)."""
    assert world.tissue is not None
    nodes, weights = wall_point(world.tissue.vessels[place.vessel], place.clock, 0.0, "outer")
    return nodes + world.tissue.offset[place.vessel], weights


def _arc_through(world: World, at: Array) -> float:
    """Arc (mm) at which the needle passes a point of its own frame; negative ahead of the tip.

    Ahead of the tip and behind the rear end the needle goes on as its tangents there.
    """
    assert world.needle is not None
    if at[0] > 0.0 and abs(at[1]) < world.needle.radius:
        return -float(at[0])
    _, arc = needle_closest(world.needle, at)
    if arc < world.needle.length:
        return arc
    end = at - needle_point(world.needle, world.needle.length)
    return world.needle.length + max(0.0, -float(end @ needle_tangent(world.needle, world.needle.length)))


def _side(world: World, place: Place) -> float:
    """Positive where the tip lies outwards of the triangle of ``place``, as the next crossing will judge it."""
    assert world.solver is not None
    return float(side(world.needle_pose.position, world.solver.x, place.nodes))


def _needle_length(world: World) -> float:
    return world.needle.length if world.needle else 0.0


def _sticks(world: World, pose: Rigid, normal: Array) -> bool:
    spec = world.task.scene.needle
    assert spec is not None
    tangent = pose.rotate(np.array([1.0, 0.0, 0.0]))
    return abs(float(tangent @ normal)) >= math.sin(math.radians(spec.skid_deg.value))


def _puncture_mN(world: World, place: Place) -> float:
    assert world.tissue is not None
    spec: VesselSpec = world.tissue.vessels[place.vessel].spec
    return (spec.puncture_outer_mN if place.wall == "outer" else spec.puncture_inner_mN).value
