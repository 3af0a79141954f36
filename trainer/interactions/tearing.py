"""A torn wall: its net of links opens from the place that gave way to the cut edge.

Brown et al. 2001 let the suture slide or break, and name cutting as a collision of an edge and a face (section 5), but
say nothing of a wall that rips. What tears out of it here comes free, and there is one way out that crosses no whole
tissue: a slit along the vessel to the cut edge, whichever way it was pulled (assumed). The links across the slit bear
nothing from then on, and what was a wall between its lips is none for the needle's tip. What goes through a triangle
that is slit, another hole or jaws, holds both lips until it tears itself.
"""

from __future__ import annotations

import math

import numpy as np

from trainer.anatomy.slit import ASIDE, slit_links
from trainer.anatomy.vessel import material_coordinates
from trainer.interactions.world import Hole, World


def rip_out(world: World, hole: Hole) -> None:
    """Slits the wall of a ``hole`` that tears; together with that of the other wall, if the same pass tore that."""
    place = hole.place
    hours = {place.wall: place.clock}
    for other in world.holes:
        there = other.place
        same_bite = other.torn and other.pass_number == hole.pass_number and there.vessel == place.vessel
        if same_bite and abs(math.remainder(there.clock - place.clock, 2.0 * math.pi)) < 0.5 * ASIDE:
            hours.setdefault(there.wall, there.clock)
    clocks = hours.get("outer", place.clock), hours.get("inner", place.clock)
    _slit(world, place.vessel, (place.wall,), clocks, place.axial_mm)


def rip_from_jaws(world: World, vessel: int, nodes: np.ndarray) -> None:
    """Slits both walls of a vessel from the middle of the triangle of ``nodes`` (3,) that jaws held: they had the wall
    between them."""
    assert world.tissue is not None
    own = nodes - world.tissue.offset[vessel]
    axial, clock = material_coordinates(world.tissue.vessels[vessel], own, np.full(3, 1.0 / 3.0))
    _slit(world, vessel, ("outer", "inner"), (clock, clock), axial)


def _slit(world: World, vessel: int, walls: tuple[str, ...], clocks: tuple[float, float], axial_mm: float) -> None:
    tissue, solver = world.tissue, world.solver
    assert tissue is not None and solver is not None
    torn = tissue.vessels[vessel]
    across = slit_links(torn, walls, clocks, axial_mm)
    solver.cut(across + sum(len(v.mesh.links) for v in tissue.vessels[:vessel]))
    ends = torn.mesh.links[across] + tissue.offset[vessel]
    world.slit |= _have_edge(world.surface, ends)
    contact = world.contact
    if contact is not None and _have_edge(contact.place.nodes[None], ends)[0]:
        solver.drop(contact.slot)  # the tip is between the lips now
        world.contact = None


def _have_edge(triangles: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Which of the triangles (f, 3) have one of ``edges`` (k, 2), as bool (f,)."""
    first, last = np.sort(edges, axis=1).T
    count = int(triangles.max()) + 1 + int(edges.max(initial=0))
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).astype(np.int64)
    return np.asarray(np.isin(sides[..., 0] * count + sides[..., 1], first.astype(np.int64) * count + last).any(axis=1))
