"""The steps of a task: which one is reached."""

from __future__ import annotations

import math

from trainer.curriculum import TISSUE_STEPS, Step
from trainer.interactions.region import Region
from trainer.interactions.thread_pull import tail_mm
from trainer.interactions.world import Hole, World


def reached(world: World, step: Step, used: set[int]) -> bool:
    """Whether ``step`` is reached now; a pass of the needle counts for one step only and is put into ``used``."""
    if step.kind in TISSUE_STEPS:
        return world.region is not None and _handled(world.region, step)
    if step.kind == "probe":
        return world.region is not None and step.structure in world.region.inside
    if step.kind == "drive":
        passes = _driven(world, step) - used
        used |= passes
        return bool(passes)
    if step.kind == "withdraw":
        last = [h for h in world.holes if h.pass_number == world.passes]
        return not world.open_holes() and not any(h.torn for h in last)
    threaded = [h for h in world.open_holes() if world.needle is not None and h.arc > world.needle.length]
    if step.kind == "tail":
        return len(threaded) == len(world.open_holes()) and 0.0 < tail_mm(world) <= step.at_most_mm
    return bool(threaded) and 0.0 < gap_mm(world) <= step.at_most_mm


def _handled(region: Region, step: Step) -> bool:
    """Whether the step's structure is held, displaced, tacked, severed or drawn apart as the step asks."""
    holds = [h.elements for h in region.held if h is not None and h.structure == step.structure]
    match step.kind:
        case "grasp":
            return bool(holds)
        case "pull":
            return any(region.displaced_mm(elements) >= step.at_least_mm for elements in holds)
        case "tack":
            elements = region.elements[step.structure]
            tacked = elements[region.tacked[elements]]
            return len(tacked) > 0 and region.displaced_mm(tacked) >= step.at_least_mm
        case "cut":
            return step.structure in region.severed and not any(blades.cut for blades in region.blades)
        case _:
            return region.parted_mm(step.structure) >= step.at_least_mm


def gap_mm(world: World) -> float:
    """Distance of the cut edges of two vessels at the stitch that joins them, or of a structure's; 0 without either."""
    if world.region is not None:
        return max(map(world.region.parted_mm, world.region.severed), default=0.0)
    if world.solver is None:
        return 0.0
    outer: dict[int, Hole] = {h.place.vessel: h for h in world.open_holes() if h.place.wall == "outer"}
    if len(outer) != 2:
        return 0.0
    a, b = (weights @ world.solver.x[nodes] for nodes, weights in (hole.edge for hole in outer.values()))
    return math.dist(a, b)


def _driven(world: World, step: Step) -> set[int]:
    """Passes of the needle that went through both walls of the step's vessel the way it asks."""
    walls: dict[int, set[str]] = {}
    for hole in world.open_holes():
        if world.vessel_name(hole.place) == step.vessel and hole.inwards == (step.direction == "in"):
            walls.setdefault(hole.pass_number, set()).add(hole.place.wall)
    return {number for number, seen in walls.items() if seen == {"outer", "inner"}}
