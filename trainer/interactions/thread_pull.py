"""The thread between needle, holes and grips: sliding, pulling on tissue, slipping, breaking, tearing.

Swage and grips are hard constraints, holes are soft ones (Brown 2001, section 4): the thread slides through a
hole to relieve a stretch. Between two hard constraints with too little thread for that, it draws its holes
together: a taut cable in the tissue's equilibrium, whose tension slips a grip or breaks the thread.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from trainer.events import Break, Withdraw
from trainer.geometry import Array, Rigid, cross, length, quaternion_from_axis_angle, quaternion_multiply
from trainer.instruments.needle import needle_point
from trainer.interactions import drape
from trainer.interactions.pierce import close, draw
from trainer.interactions.world import Hole, World
from trainer.mechanics.attachments import Cable
from trainer.mechanics.thread import Slid, break_at, closest, follow, in_order, length_error, slide

#: Thread without holes between two grips is rigid: more than this too short, mm, and something gives way.
RIGID_MM = 1e-6
#: The tissue's equilibrium may lag behind a grip by this much thread, mm, before the grip loses it.
MOST_LAG_MM = 0.5


@dataclass(frozen=True)
class Constraints:
    """Where the thread is held, in the order of the arcs. A row is a hole, a grip, or the swage (neither)."""

    arc: Array  # (c,) mm
    position: Array  # (c, 3) mm
    hard: np.ndarray  # (c,) bool
    hole: tuple[Hole | None, ...]
    grip: tuple[int, ...]  # instrument, or -1


@dataclass(frozen=True)
class Slack:
    """Where the thread is held, and how it slides through its holes between."""

    held: Constraints
    slid: Slid


def constraints(world: World, lagging: bool = True) -> Constraints:
    """Swage, holes and grips as they are now.

    ``lagging``: a grip gives, for the time being, the thread that the tissue has yet to let it have.
    """
    assert world.thread is not None and world.needle is not None
    rows: list[tuple[float, list[float], Hole | None, int]] = []
    if needle_is_placed(world):
        rows.append((world.thread.needle_length, swage(world).tolist(), None, -1))
    # Holes that meet on one arc keep the order in which the needle made them: the latest is nearest to it.
    threaded = [hole for hole in reversed(world.open_holes()) if hole.arc > world.needle.length]
    rows += [(h.arc, place, h, -1) for h, place in zip(threaded, world.points(threaded), strict=True)]
    for i, jaw in enumerate(world.jaws):
        if jaw.target == "thread":
            rows.append((jaw.arc + lagging * jaw.lag_mm, jaw.pose.position.tolist(), None, i))
    rows.sort(key=itemgetter(0))
    arc, position, hole, grip = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Constraints(
        arc=np.array(arc),
        position=np.array(position).reshape(-1, 3),
        hard=np.array([h is None for h in hole], dtype=np.bool_),
        hole=hole,
        grip=grip,
    )


def needle_is_placed(world: World) -> bool:
    """Whether an instrument or a wall holds the needle; else it trails behind the thread."""
    return world.needle_tool() is not None or any(
        world.needle is not None and h.arc <= world.needle.length for h in world.open_holes()
    )


def swage(world: World) -> Array:
    """The needle's rear end (3,) mm, where the thread begins."""
    assert world.needle is not None
    return world.needle_pose.apply(needle_point(world.needle, world.needle.length))


def runs(world: World, held: Constraints) -> list[tuple[int, int]]:
    """The stretches of whole thread between two neighbouring hard constraints: first and last row."""
    arc, pieces = held.arc.tolist(), world.pieces.tolist()
    hard = [row for row, hole in enumerate(held.hole) if hole is None]
    return [
        (first, last)
        for first, last in itertools.pairwise(hard)
        if any(s0 <= arc[first] and arc[last] <= s1 for s0, s1 in pieces)
    ]


def cables(world: World, held: Constraints) -> list[tuple[int, int, Cable]]:
    """The runs with holes between their ends: (first row, last row, cable)."""
    found = []
    for first, last in runs(world, held):
        rows = range(first, last + 1)
        if len(rows) > 2:
            holes, place = [held.hole[r] for r in rows], held.position[rows.start : rows.stop]
            # In the channel between the two holes of one wall the thread is as long as the channel is now.
            channel = [
                a is not None and b is not None and a.pass_number == b.pass_number and a.place.vessel == b.place.vessel
                for a, b in itertools.pairwise([*holes, None])
            ]
            spans = itertools.pairwise(place.tolist())
            inside = sum(math.dist(a, b) for (a, b), hidden in zip(spans, channel, strict=False) if hidden)
            slots = np.array([h.slot if h is not None else -1 for h in holes], dtype=np.int64)
            round_about = sum(drape.detours(world, held).tolist()[first:last])
            outside = float(held.arc[last] - held.arc[first]) - inside - round_about
            found.append((first, last, Cable(slots, place, outside, np.array(channel))))
    return found


def slacken(world: World) -> Slack:
    """How the thread slides through its holes, as everything is now."""
    return _slackened(world, constraints(world))


def lend(world: World, held: Constraints) -> Slack:
    """How the thread slides where ``held`` holds it, with what its grips give for the time being."""
    arcs = zip(held.arc.tolist(), held.grip, strict=True)
    arc = np.array([s if grip < 0 else s + world.jaws[grip].lag_mm for s, grip in arcs])
    return _slackened(world, replace(held, arc=arc) if in_order(arc) else constraints(world))


def _slackened(world: World, held: Constraints) -> Slack:
    assert world.thread is not None
    return Slack(
        held, slide(world.thread, held.arc, held.position, held.hard, world.pieces, drape.detours(world, held))
    )


def settle(world: World, time_s: float, slack: Slack | None) -> None:
    """Let the thread slide through its holes as ``slack`` says and lay it from constraint to constraint, over what it
    meets."""
    if slack is None:
        return
    _run_and_lay(world, time_s, slack)
    for _ in range(drape.TURNS):
        if world.draping is not None and world.draping.lacks:
            slack = slacken(world)
            # Else the holes cannot give what is lacking: the next movement finds the thread too short.
            if not slack.slid.shortage.any():
                _run_and_lay(world, time_s, slack)


def _run_and_lay(world: World, time_s: float, slack: Slack) -> None:
    held, slid = slack.held, slack.slid
    for row, hole in enumerate(held.hole):
        if hole is None:
            continue
        hole.along = _towards_needle(held, row)
        draw(hole, float(slid.arc[row]))
        if slid.pulled_out[row]:
            close(world, hole)
            world.emit(
                Withdraw, time_s, "", body=world.vessel_name(hole.place), wall=hole.place.wall, hole=hole.number,
                pass_number=hole.pass_number, end="tail", reached_mm=hole.reached_mm,
            )  # fmt: skip
    lay(world, constraints(world) if slid.pulled_out.any() else replace(held, arc=slid.arc))


def overdrawn(world: World, slack: Slack) -> tuple[int, int] | None:
    """A run that its ends pull further apart than thread and tissue give: first and last row.

    What a run with holes lacks is the tissue's lag behind the instruments: its last grip gives that much thread until
    the equilibrium has caught up, unless it is too much. A run without holes is rigid.
    """
    assert world.thread is not None
    held, slid = slack.held, slack.slid
    if not slid.shortage.any():
        return None
    found = runs(world, held)
    for first, last in found:
        lack = float(slid.shortage[first])
        if last - first == 1:
            if lack > RIGID_MM:
                return first, last
        elif lack > 0.0:
            room = held.arc[last + 1] if last + 1 < len(held.arc) else world.thread.end
            if lack > min(MOST_LAG_MM, room - held.arc[last]):
                return first, last
            world.jaws[held.grip[last]].lag_mm = lack
    for first, last in found:
        if last - first == 1 and slid.shortage[first] > 0.0:  # rounding
            world.jaws[held.grip[last]].lag_mm = float(slid.shortage[first])
    return None


def lay(world: World, held: Constraints) -> None:
    """Place the thread's nodes between the constraints; a needle that nothing holds trails behind."""
    assert world.thread is not None
    arc, position = held.arc, held.position
    for s0, s1 in world.pieces.tolist():
        if not any(s0 <= s <= s1 for s in arc.tolist()):
            # Let go of, a piece stays where it lies; but the link that bent at the grip must be straight again.
            node = round((0.5 * (s0 + s1) - world.thread.needle_length) / world.thread.link)
            at = int(np.searchsorted(arc, s0))
            arc = np.insert(arc, at, world.thread.needle_length + node * world.thread.link)
            position = np.insert(position, at, world.nodes[node], axis=0)
    follow(world.thread, world.nodes, arc, position, world.pieces)
    drape.over(world, held)
    if not needle_is_placed(world):
        _trail(world)


def snap(world: World, arc: float, tension_mN: float, time_s: float) -> None:
    """The thread breaks at ``arc``."""
    assert world.thread is not None
    spec = world.task.scene.thread
    assert spec is not None
    world.pieces = break_at(world.thread, world.pieces, arc)
    world.broken = True
    world.emit(Break, time_s, "", arc_mm=arc, tension_mN=tension_mN, limit_mN=spec.strength_mN.value)


def thread_point(world: World, point: Array) -> tuple[float, float]:
    """(distance, arc) in mm of the thread's point nearest to ``point`` (3,)."""
    assert world.thread is not None
    held = constraints(world)
    return closest(world.thread, world.nodes, held.arc, held.position, world.pieces, point)


def stretch(world: World) -> float:
    """The largest relative error of a link's length."""
    if world.thread is None:
        return 0.0
    held = constraints(world)
    return length_error(world.thread, world.nodes, held.arc, held.position, world.pieces)


def tail_mm(world: World) -> float:
    """Thread left before the first hole it went through; 0 when it is in none."""
    if world.thread is None or world.needle is None:
        return 0.0
    arcs = [h.arc for h in world.open_holes() if h.arc > world.needle.length]
    return world.thread.end - max(arcs) if arcs else 0.0


def _towards_needle(held: Constraints, row: int) -> Array:
    """Unit direction (3,) in which the thread leaves a hole towards the needle; zero where it is slack there."""
    if row == 0:
        return np.zeros(3)
    way = held.position[row - 1] - held.position[row]
    size = length(way)
    return way / size if size > 1e-9 else np.zeros(3)


def _trail(world: World) -> None:
    """A rigid needle at the head of a pulled thread: its tip follows its rear end, as one long link would."""
    assert world.needle is not None
    rear = world.nodes[0]
    in_needle = needle_point(world.needle, world.needle.length)
    chord = world.needle_pose.rotate(in_needle)
    pulled = rear - world.needle_pose.position
    axis = cross(chord, pulled)
    sine, cosine = length(axis), float(chord @ pulled)
    q = world.needle_pose.quaternion
    if sine > 1e-12:
        q = quaternion_multiply(quaternion_from_axis_angle(axis, math.atan2(sine, cosine)), q)
        q = q / np.linalg.norm(q)
    world.needle_pose = Rigid(rear - Rigid(np.zeros(3), q).rotate(in_needle), q)
