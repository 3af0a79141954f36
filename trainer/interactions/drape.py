"""The thread draped over vessels, instruments and itself (Brown 2001, sections 4 and 5).

Each movement it is laid over what it met. It slides and sticks there with friction, but it presses on nothing: what it
lies over bears no force, and its tension is the same on both sides. A span that is drawn tight over something needs
more thread than the straight way between its ends: the *detour*, which its holes let it have.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from trainer import events
from trainer.geometry import Array
from trainer.instruments import forceps
from trainer.interactions.world import Draping, World
from trainer.mechanics.thread_drape import Drape
from trainer.mechanics.thread_search import Blades, surface

if TYPE_CHECKING:
    from trainer.interactions.thread_pull import Constraints

#: Coefficient of friction of the thread on tissue, steel and itself (assumed).
FRICTION = 0.2
#: Along the thread from where jaws hold it, and from the swage of a needle in them, their own blades touch nothing, mm.
IN_JAWS_MM = 0.5
#: A tool that goes further than this in one movement, mm, has leapt and sweeps nothing (a movement is 0.1 mm).
LEAP_MM = 0.5
#: How often in one movement the holes may give thread for a longer detour.
TURNS = 2
#: What a tightened detour is lengthened by beyond what was lacking, so that few turns are needed: a share, and mm.
MORE, MORE_MM = 0.25, 1e-3
#: … but by no more than a movement can have lengthened the way, mm.
MOST_MORE_MM = 0.1
#: The thread lies over what it touches this closely, and no longer over what it is further from than that, mm …
TOUCHES_MM, LIFTED_MM = 0.002, 0.04
#: … for this long, s. All assumed.
LIFTED_S = 0.1


def begin(world: World) -> None:
    """The thread's contact with the instruments, itself, and the walls if there are any."""
    assert world.thread is not None
    spec = world.task.scene.thread
    assert spec is not None
    vessels = world.tissue.vessels if world.tissue is not None else ()
    triangles, body, hull = np.zeros((0, 3), dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)
    if world.tissue is not None:
        each = [v.display_triangles + o for v, o in zip(vessels, world.tissue.offset, strict=False)]
        triangles = np.concatenate(each).astype(np.int32)
        body = np.repeat(np.arange(len(each), dtype=np.int32), [len(t) for t in each])
        # A vessel's surface is the outer hull, the inner one, and what joins them, in this order.
        sorts = [(len(v.outer_triangles), len(v.inner_triangles)) for v in vessels]
        hull = np.concatenate(
            [np.repeat([1, 2, 0], [a, b, len(t) - a - b]) for (a, b), t in zip(sorts, each, strict=True)]
        ).astype(np.int32)
    walls = surface(triangles, body, hull, np.array([v.spec.wall_mm for v in vessels]), _tissue(world))
    contact = Drape(world.thread, 0.5 * spec.diameter_mm.value, FRICTION, walls, len(world.tools))
    ends, _ = _blades(world)
    world.draping = Draping(contact, world.nodes.copy(), _tissue(world), ends, ends)


def over(world: World, held: Constraints) -> None:
    """Lay the thread, which ``held`` has drawn along, over what it met."""
    draping = world.draping
    if draping is None:
        return
    ends, radius = _blades(world)
    draping.blades_now = ends
    tools = len(world.tools)
    moved = np.abs(ends - draping.blades).reshape(tools, -1).max(axis=1) > LEAP_MM
    assert world.needle is not None
    swage = world.needle.length
    arcs = [j.arc if j.target == "thread" else swage if j.target == "needle" else np.nan for j in world.jaws]
    tool = np.repeat(np.arange(tools, dtype=np.int32), len(ends) // (2 * tools))
    keys = names(held)
    before = [draping.points.get(key, p) for key, p in zip(keys, held.position, strict=True)]
    holes = np.array([h is not None for h in held.hole], dtype=np.bool_)
    now = draping.x if world.solver is None else world.solver.x
    blades = Blades(draping.blades, ends, radius, tool, np.array(arcs), moved)
    lack, way = draping.contact.lay(
        world.nodes, draping.nodes, world.pieces, held.arc, held.position, np.array(before).reshape(-1, 3), holes,
        _channels(world, held), draping.x, now, blades, IN_JAWS_MM,
    )  # fmt: skip
    draping.lacks, draping.held_at = False, dict(zip(keys, held.position, strict=True))
    known, draping.detour = draping.detour, {}
    for k, span in enumerate(itertools.pairwise(keys)):
        so_far = known.get(span, 0.0)
        longer = max(0.0, float(way[k]) - float(np.linalg.norm(held.position[k + 1] - held.position[k])))
        if lack[k] > 0.0:
            draping.lacks = True
            draping.detour[span] = max(so_far, longer) + min((1.0 + MORE) * float(lack[k]) + MORE_MM, MOST_MORE_MM)
        elif so_far > 0.0 and longer > 0.0:
            draping.detour[span] = min(so_far, longer)


def detours(world: World, held: Constraints) -> Array:
    """By how much the way from each constraint to the next one is longer than the straight one (c,) mm."""
    found = np.zeros(len(held.arc))
    if world.draping is not None and world.draping.detour:
        keys = names(held)
        for k in range(len(keys) - 1):
            found[k] = world.draping.detour.get((keys[k], keys[k + 1]), 0.0)
    return found


def tell(world: World, time_s: float) -> None:
    """Write what the thread has come to lie over, or no longer does, and remember the movement's end."""
    draping = world.draping
    if draping is None:
        return
    vessels = world.tissue.vessels if world.tissue is not None else ()
    for b, (gap, arc, *place) in enumerate(draping.contact.near.tolist()):
        if b not in draping.lying and gap > TOUCHES_MM:
            continue
        tool = world.tools[b] if b < len(world.tools) else ""
        vessel = b - len(world.tools)
        body = vessels[vessel].spec.name if 0 <= vessel < len(vessels) else ""
        what = "instrument" if tool else "vessel" if body else "thread"
        if b not in draping.lying:
            draping.lying[b] = time_s, time_s
            point = world.place_in_world(np.array(place))
            world.emit(events.Drape, time_s, tool, over=what, body=body, arc_mm=arc, point=point)
        elif gap <= LIFTED_MM:
            draping.lying[b] = draping.lying[b][0], time_s
        elif time_s - draping.lying[b][1] > LIFTED_S:
            since, last = draping.lying.pop(b)
            world.emit(events.Undrape, time_s, tool, over=what, body=body, lay_s=last - since)
    remember(world)


def remember(world: World) -> None:
    """A movement begins where the last one ended."""
    draping = world.draping
    assert draping is not None
    draping.nodes[:] = world.nodes
    if world.solver is not None:
        draping.x[:] = world.solver.x
    draping.blades, draping.points = draping.blades_now, draping.held_at


def names(held: Constraints) -> list[str]:
    """What each constraint is, from movement to movement."""
    return [
        f"hole {hole.number}" if hole is not None else f"grip {grip}" if grip >= 0 else "swage"
        for hole, grip in zip(held.hole, held.grip, strict=True)
    ]


def _channels(world: World, held: Constraints) -> np.ndarray:
    """The vessel (c,) int32 in whose wall the thread runs from a constraint to the next, or -1.

    Both holes of a wall hold it, or the one does and the needle's rear end has yet to come out of the other.
    """
    assert world.needle is not None
    found = np.full(len(held.hole), -1, dtype=np.int32)
    ahead = [h for h in world.open_holes() if h.arc <= world.needle.length]
    for k, (a, b) in enumerate(zip(held.hole, held.hole[1:], strict=False)):
        others = ahead if a is None and held.grip[k] < 0 else [a]
        if b is not None and any(
            h is not None and h.pass_number == b.pass_number and h.place.vessel == b.place.vessel for h in others
        ):
            found[k] = b.place.vessel
    return found


def _tissue(world: World) -> Array:
    return world.solver.x.copy() if world.solver is not None else np.zeros((0, 3))


def _blades(world: World) -> tuple[Array, Array]:
    parts = [forceps.capsules(jaw.pose, jaw.closure) for jaw in world.jaws]
    return np.concatenate([ends for ends, _ in parts]), np.concatenate([radius for _, radius in parts])
