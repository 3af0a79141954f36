"""A needle's tip whose way nobody saw: the device had lost the instrument, or its tracker leapt.

Else the tip is swept along the straight way between two ticks, and touches and pierces what lies on it
(:mod:`trainer.interactions.pierce`). A way that nobody saw is no fact: the tip touches nothing on it, and no wall that
lies between is pierced. Where it is found on the same side of all walls it goes on at once. Found on another side of
one, inside a vessel without a hole, say, it still touches nothing, until it is back where it can have come without one:
drawn out again as it went in, or withdrawn from the holes that the needle does have. What these hold of the tissue, and
what jaws and thread hold, goes along as ever, and may tear.
"""

from __future__ import annotations

import math
from collections import Counter

from trainer.geometry import Rigid
from trainer.instruments.needle import needle_point
from trainer.interactions import pierce
from trainer.interactions.crossing import first_crossing
from trainer.interactions.world import LastSeen, World

#: No hand under a microscope moves a tip faster, mm/s (assumed: an unhurried 10 mm in 2 s peaks at 9).
FASTEST_MM_S = 160.0
#: Found no further than this from where the device lost it, mm, the tip went straight (assumed: 50 ms at 10 mm/s).
STRAIGHT_MM = 0.5
#: A tip that presses on a wall is on the side on which the needle is this far behind it, mm.
BEHIND_MM = 0.01


def watch(world: World, seen_before: list[bool], targets: list[Rigid]) -> None:
    """Lose the tip where the way of the instrument that leads it, to its place in ``targets``, is none that was seen.

    ``seen_before`` says of each instrument whether the device saw it in the tick before.
    """
    leader = world.needle_tool()
    if leader is None or world.solver is None or world.needle is None:
        return
    held = world.jaws[leader].tool_from_needle
    assert held is not None
    way = math.dist(world.needle_pose.position, targets[leader].apply(held.position))
    if way <= (FASTEST_MM_S / world.task.tick_hz if seen_before[leader] else STRAIGHT_MM):
        return
    tip = world.needle_pose.position
    if world.contact is not None:
        tip = world.needle_pose.apply(needle_point(world.needle, BEHIND_MM))
        world.solver.drop(world.contact.slot)
        world.contact = None
    if world.last_seen is None:
        world.last_seen = LastSeen(tip, world.solver.x.copy())


def find(world: World) -> None:
    """At the end of a tick, let the tip touch again if it is on the side of all walls on which it was last seen.

    Through each wall it may have gone inwards as often as outwards. Next to the holes that the needle has it goes
    through them.
    """
    last, solver, needle = world.last_seen, world.solver, world.needle
    if last is None or solver is None or needle is None:
        return
    through: Counter[tuple[int, str]] = Counter()
    passed = pierce.passed(world, needle.length)
    while (
        hit := first_crossing(last.tip, world.needle_pose.position, last.x, solver.x, world.surface, passed)
    ) is not None:
        triangle, _, inwards, _ = hit
        passed[triangle] = True
        through[world.wall_of(triangle)] += 1 if inwards else -1
    if not any(through.values()):
        world.last_seen = None
        world.before[:] = solver.x
