"""Hard cases of a thread of 1000 links on vessels: dropped by its weight, and wound and heaped by an instrument.

The laws, at every tick: what is finite stays so, and no link is off its length by more than 1e-6 (beyond what the rod's
own tension makes of it). The *rod* falls on a fixed tube of triangles, and nothing holds it, so that it gains no energy
but 5e-3 of what lifts it by its length (``bench.thread_laws``); friction only takes. Its skin goes no deeper into a
triangle than a tenth of its radius, 1.2 µm, and no node is in the tube: planes of contact are those of the tick's
start, which a round tube is behind; where it bulges (0.12 / mm along its axis) a node that goes 0.04 mm along one, as
at 150 mm/s, is 0.1 µm deep. Places *near* are those looked at, within a margin; a part of them touch.

*Follow-the-leader, draped* is the paper's thread as a scene with ``drapes`` runs it: an instrument leads its end round
both vessels, to and fro, until much of it lies on them and on itself. No point of it is deeper in a wall than half of
it, from where it would be through. A node may be 3 µm deep and a link between its nodes 30 µm (it rounds edges with
straight links; derived in ``tests/interactions/test_drape.py``): its projections are bounded in number, and where they
were too few for that the case says that it did not converge, since the method does not. How far a node goes beyond
its leader is told, and is no law: each touch along the way pushes what follows a little further.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from trainer import scene
from trainer.bench.contact import chain, vessel
from trainer.bench.hard_scene import LEFT, RIGHT, instruments, place_of, task_of
from trainer.bench.thread_laws import Rod, Watch, ended
from trainer.geometry import Array
from trainer.interactions import thread_pull
from trainer.mechanics.cells import Cells
from trainer.mechanics.closest_points import point_triangle
from trainer.mechanics.self_contact import SelfContact
from trainer.mechanics.thread_contact import touch_itself, touch_triangles
from trainer.mechanics.thread_rod import RodStalled, monofilament, no_contacts
from trainer.scene import Scene

LINKS = 1000
#: 10-0 thread, mm.
RADIUS_MM = 0.0125
FRICTION = 0.3
DROP_TICK_S = 2.5e-4
#: Nothing is nearer to the tube's axis outside of it, mm: 3 % less than its radius, and the facets' 0.7 %.
INSIDE_MM = 0.963
#: The least margin in which contacts are looked for, mm; else twice what the fastest node goes in a tick.
MARGIN_MM = 0.02
#: Turns of the instrument round the vessels: mm from their axis, mm a tick, ticks.
TURN_MM, STRIDE_MM, TICKS = 1.0, 0.4, 200
#: How deep a node and a link's inside may lie in a wall, mm.
NODE_MM, LINK_MM = 3e-3, 0.03
WALL_MM = 0.15
#: A link lies on what it is nearer to than this, mm.
LIES_MM = 0.01


def dropped(softness: float, link_mm: float, ticks: int) -> str:
    """A coil of thread falls from 0.1 mm above across a tube of 2 mm; EI is ``softness`` of nylon's: limp silk.

    Nylon's own would spring open. Turns are 0.1 mm apart; links nearer along the thread than three do not touch.
    """
    nylon = monofilament(2.0 * RADIUS_MM, 1.14e-6, 2.5e6, LINKS * link_mm, LINKS + 1)
    model = replace(nylon, bending=softness * nylon.bending)
    turn = np.arange(LINKS + 1) * model.link / 1.5
    coil = np.stack([5.0 + 1.5 * np.cos(turn), 1.5 * np.sin(turn), 1.1 + 0.1 * turn / (2.0 * math.pi)], axis=1)
    surfaces, triangles = vessel(32, 32)
    surface, contacts = surfaces[0], no_contacts(40_000)
    rod = Rod(model, coil, [], contacts=contacts)
    watch, cells, own = Watch(rod), Cells(chain(LINKS + 1), triangles, surface), SelfContact(chain(LINKS + 1), 3)
    most = most_own = 0
    for _ in range(ticks):
        margin = max(MARGIN_MM, 2.0 * DROP_TICK_S * float(np.max(np.linalg.norm(rod.v, axis=1))))
        near = cells.near(rod.x, surface, RADIUS_MM + margin)
        touch_triangles(contacts, rod.x, RADIUS_MM, surface, surface, triangles, near, FRICTION, margin)
        on_wall = int(contacts.used[0])
        touch_itself(contacts, rod.x, RADIUS_MM, own.near(rod.x, 2.0 * RADIUS_MM + margin), FRICTION, margin)
        most, most_own = max(most, on_wall), max(most_own, int(contacts.used[0]) - on_wall)
        try:
            watch.tick(DROP_TICK_S)
        except RodStalled as stalled:  # said, and the rod is where it was
            return f"not converged: {stalled} ({on_wall} places near the wall, {most_own} near itself)"
        least = gap(rod.x, surface, triangles, cells.near(rod.x, surface, RADIUS_MM))
        assert least >= 0.9 * RADIUS_MM, f"a node is {least:.2g} mm from the wall, its skin {RADIUS_MM} mm"
        assert np.min(np.hypot(rod.x[:, 1], rod.x[:, 2])) >= INSIDE_MM, "a node is in the tube"
    return ended(
        watch, words=f"{1e3 * DROP_TICK_S * ticks:g} ms, up to {most} places near the wall, {most_own} near itself"
    )


def gap(x: Array, surface: Array, triangles: np.ndarray, pairs: np.ndarray) -> float:
    """The least distance mm of the nodes ``x`` of ``pairs`` (k, 2), link and triangle, to the tube: negative inside.

    A tube bulges outwards: a node is outside where it is before the plane of any triangle that is near.
    """
    far, outside = np.full(len(x), math.inf), np.zeros(len(x), dtype=bool)
    for link, f in pairs:
        a, b, c = triangles[f]
        normal = np.cross(surface[b] - surface[a], surface[c] - surface[a])
        normal *= np.sign(normal[1:] @ surface[a, 1:])
        for node in (link, link + 1):
            outside[node] |= (x[node] - surface[a]) @ normal >= 0.0
            far[node] = min(
                far[node], math.sqrt(point_triangle(x[node, 0], x[node, 1], x[node, 2], surface, a, b, c)[0])
            )
    return float(np.min(np.where(outside | (far == math.inf), far, -far)))


def in_wall(s: Scene, points: Array) -> Array:
    """How deep points (p, 3) mm lie in the walls of the vessels at rest, mm; negative outside.

    A wall at rest is what lies between two prisms of ``around`` sides: planes at the apothem's height.
    """
    deepest = np.full(len(points), -math.inf)
    for v in s.world.task.scene.vessel:
        clock = (np.arange(v.around) + 0.5) * (2.0 * math.pi / v.around)
        normals = np.stack([np.cos(clock), np.sin(clock)])
        high = np.max(points[:, 1:] @ normals, axis=1)
        outer, flat = 0.5 * v.outer_diameter_mm, math.cos(math.pi / v.around)
        along = (points - np.array(v.cut_edge_mm)) @ np.array(v.axis)
        depth = np.minimum(outer * flat - high, high - (outer - v.wall_mm) * flat)
        deepest = np.maximum(deepest, np.minimum(depth, np.minimum(along, v.length_mm - along)))
    return deepest


def lead(s: Scene, tool: int, to: Array, closure: float, step_mm: float) -> None:
    """Move an instrument straight to a place, ``step_mm`` a tick."""
    start = place_of(s, tool)
    ticks = math.ceil(math.dist(to, start) / step_mm)
    for k in range(1, ticks + 1):
        s.step(instruments(s, tool, start + k / ticks * (to - start), closure))


def heaped() -> str:
    """The needle is dropped, the thread's end led round the vessels' axis, and along it to and fro."""
    task = task_of("single-stitch")
    spec = task.scene.thread
    assert spec is not None
    thread = replace(spec, drapes=True, link_mm=0.1, length_mm=0.1 * LINKS)
    s = scene.build(replace(task, scene=replace(task.scene, thread=thread)))
    lead(s, LEFT, s.world.nodes[5].copy(), 0.0, 0.5)
    for tool, closure in ((LEFT, 1.0), (RIGHT, 0.0)):
        s.step(instruments(s, tool, place_of(s, tool), closure))
    assert s.view().thread_holders == (LEFT,), "the jaws do not hold the thread"
    lead(s, RIGHT, np.array([4.0, -6.0, 6.0]), 0.0, 0.8)
    lead(s, LEFT, np.array([-2.0, 0.0, 3.0]), 1.0, 0.8)
    share = np.linspace(0.0, 1.0, 11)[:, None, None]
    node_deep = link_deep = beyond = stretch = 0.0
    on_walls = on_itself = 0
    own = SelfContact(chain(LINKS + 1), 3)
    for k in range(1, TICKS + 1):
        angle = k * STRIDE_MM / TURN_MM
        place = np.array([1.6 * math.cos(0.13 * angle), TURN_MM * math.sin(angle), TURN_MM * math.cos(angle)])
        before, held_at = s.world.nodes.copy(), place_of(s, LEFT)
        s.step(instruments(s, LEFT, place, 1.0))
        x = s.world.nodes
        assert np.isfinite(x).all(), f"tick {s.tick}: the thread is not finite"
        stretch = max(stretch, thread_pull.stretch(s.world))
        assert stretch <= 1e-6, f"tick {s.tick}: a link is off its length by {stretch:.1e}"
        deep = in_wall(s, ((1.0 - share) * x[:-1] + share * x[1:]).reshape(-1, 3)).reshape(11, -1)
        node_deep, link_deep = max(node_deep, float(np.max(deep[[0, -1]]))), max(link_deep, float(np.max(deep)))
        way = float(np.max(np.linalg.norm(x - before, axis=1)))
        beyond = max(beyond, way - math.dist(place_of(s, LEFT), held_at))
        on_walls = max(on_walls, int(np.count_nonzero(np.max(deep, axis=0) > -RADIUS_MM - LIES_MM)))
        on_itself = max(on_itself, len(own.near(x, 2.0 * RADIUS_MM + LIES_MM)))
        assert link_deep <= 0.5 * WALL_MM, f"tick {s.tick}: the thread is {link_deep:.2g} mm deep in a wall"
    assert s.world.solver is not None
    assert np.array_equal(s.world.solver.x, s.world.solver.mesh.rest), (
        "a thread that presses on nothing moved the walls"
    )
    words = (
        f"{on_walls} links on the walls, {on_itself} pairs on one another; lengths to {stretch:.0e}; a node goes up to "
        f"{beyond:.2f} mm in a tick beyond its leader's {STRIDE_MM:g}"
    )
    deep_words = (
        f"nodes up to {1e3 * max(0.0, node_deep):.1f} µm deep in a wall, links {1e3 * max(0.0, link_deep):.1f} µm"
    )
    if node_deep > NODE_MM or link_deep > LINK_MM:
        return f"not converged: {deep_words}; {words}"
    return f"ok: {words}; {deep_words}"


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """(case, method, run)."""
    return [
        (f"{LINKS} links fall on the vessel in a heap, soft", "rod", partial(dropped, 1e-4, 0.05, 48)),
        (f"{LINKS} links fall on the vessel in a heap, limp", "rod", partial(dropped, 1e-5, 0.1, 64)),
        (f"{LINKS} links wound and heaped on two vessels", "follow-the-leader, draped", heaped),
    ]
