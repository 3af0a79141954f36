"""The laws that a scene obeys at every tick, whatever comes in; see :mod:`trainer.bench.hard_scene`.

No node of the thread leaps: in a tick it moves by no more than d + R + R'. d is the way of what holds the thread, and
twice that of the tissue: a hole that moves takes along the thread in it, and lets as much slide. A thread that is held
at one end follows its leader: the distance to the leader's new place differs from the link's length by no more than the
leader's way, and that is how far a node goes. Between two grips or holes at the distance c, with the arc L between
them, a node at the arc s lies in both balls of s and L − s about them. R is how far a point of both balls may be from
the one at the share s / L of the way between them, before the tick; R' is that after it. That point itself moves by no
more than d. Both R vanish as the thread becomes straight, which is when a bad method leaps. Where something gives way,
the link that was bent at a grip is stretched: one link more.
"""

from __future__ import annotations

import math

import numpy as np

from trainer.events import Event, Slip, Tear
from trainer.geometry import Array
from trainer.interactions import thread_pull
from trainer.interactions.world import World
from trainer.mechanics.links import forces
from trainer.poses import ToolPoses
from trainer.scene import Scene

LENGTH_ERROR = 1e-6
#: What may be left unbalanced in tissue at rest, mN: ten times the bound at which the scene stops its iterations.
SETTLED_mN = 0.1


def step(s: Scene, poses: ToolPoses) -> tuple[Event, ...]:
    """One tick, and the laws. Raises AssertionError where one is broken."""
    world = s.world
    x, nodes, room = tissue(world).copy(), world.nodes.copy(), _room(world)
    held_at = _held_at(world)
    events = s.step(poses)
    for what, values in (("tissue", tissue(world)), ("thread", world.nodes), ("needle", world.needle_pose.matrix)):
        assert np.isfinite(values).all(), f"tick {s.tick}: the {what} is not finite"
    assert np.isfinite(world.needle_pose.position).all(), f"tick {s.tick}: the needle is not finite"
    stretch = thread_pull.stretch(world)
    assert stretch <= LENGTH_ERROR, f"tick {s.tick}: a link is off its length by {stretch:.1e}"
    for e in events:
        if isinstance(e, Tear):
            assert e.force_mN > e.limit_mN, f"a tear at {e.force_mN:g} mN, and the limit is {e.limit_mN:g} mN"
        elif isinstance(e, Slip):
            assert e.load_mN >= e.limit_mN, f"a slip at {e.load_mN:g} mN, and the limit is {e.limit_mN:g} mN"
    if world.thread is not None:
        now = _held_at(world)
        way = max((math.dist(now[who], held_at[who]) for who in now.keys() & held_at.keys()), default=0.0)
        way += 2.0 * float(np.max(np.linalg.norm(tissue(world) - x, axis=1), initial=0.0))
        gave_way = any(e.kind in ("slip", "break", "tear", "release") for e in events)
        allowed = way + room + _room(world) + world.thread.link * gave_way
        over = np.linalg.norm(world.nodes - nodes, axis=1) - allowed
        assert np.max(over) <= 1e-6, (
            f"tick {s.tick}: a node of the thread leaps {np.max(over):.2g} mm further than it may"
        )
    return events


def tissue(world: World) -> Array:
    return world.solver.x if world.solver is not None else np.zeros((0, 3))


def _held_at(world: World) -> dict[str, Array]:
    """Where swage and thread-holding grips are."""
    places = {world.tools[i]: j.pose.position for i, j in enumerate(world.jaws)}
    return {**places, "swage": thread_pull.swage(world)} if world.needle is not None else places


def _room(world: World) -> Array:
    """R of each node of the thread (n,) mm, see above."""
    room = np.zeros(len(world.nodes))
    if world.thread is None:
        return room
    held = thread_pull.constraints(world)
    arcs = world.thread.needle_length + world.thread.link * np.arange(len(room))
    for k in range(len(held.arc) - 1):
        length = float(held.arc[k + 1] - held.arc[k])
        chord = min(math.dist(held.position[k], held.position[k + 1]), length)
        for node in np.flatnonzero((arcs > held.arc[k]) & (arcs < held.arc[k + 1])).tolist():
            room[node] = _farthest(float(arcs[node] - held.arc[k]), length, chord)
    return room


def _farthest(s: float, length: float, chord: float) -> float:
    """The greatest distance of a point of both balls, of s and length − s at the distance chord, to their share's.

    On each ball's cap the distance to a point of the axis rises or falls all the way: it is greatest at a cap's tip, or
    on the circle that both share.
    """
    middle = chord * s / length
    tips = (min(s, chord + length - s) - middle, middle - max(-s, chord - length + s))
    if chord == 0.0:
        return max(tips)
    at = (chord * chord + s * s - (length - s) ** 2) / (2.0 * chord)
    return max(*tips, math.hypot(at - middle, math.sqrt(max(0.0, s * s - at * at))))


def settled(s: Scene) -> float:
    """The largest force on a node of the tissue that nothing holds, mN; at rest. Raises AssertionError."""
    world = s.world
    if world.solver is None:
        return 0.0
    mesh = world.solver.mesh
    free = ~mesh.fixed
    for hole in world.open_holes():
        free[hole.place.nodes] = False
    for jaw in world.jaws:
        if jaw.target == "wall":
            free[world.wall(jaw.vessel, jaw.wall).ravel()] = False
    if world.contact is not None:
        free[world.contact.place.nodes] = False
    left = float(np.max(np.linalg.norm(forces(mesh, world.solver.x)[free], axis=1), initial=0.0))
    assert left <= SETTLED_mN, f"{left:.2g} mN are left unbalanced"
    return left
