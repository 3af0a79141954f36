"""Hard cases of contact search: which pairs are near, and when those that move meet.

The law in all of them: the pairs are those that looking at all of them (or a hand) finds, none missed and none wrong;
a time of impact is right to what a place may be off, 1e-6 mm over the speed, and its normal points to where the body
came from. A place that is not finite is refused. Nothing is simulated here: threads fall and lie on vessels under
*The thread on vessels*, needles go through walls under *Whole exercises*.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from trainer.bench.contact import MARGIN_MM, OWN_SEGMENTS, chain, surface_truth, vessel
from trainer.geometry import Array
from trainer.mechanics.bounding_spheres import SphereSearch, SphereTree
from trainer.mechanics.cells import Cells
from trainer.mechanics.continuous_collision import MOST_STEPS, TOUCH_MM, Impacts, SweptContact
from trainer.mechanics.self_contact import SelfContact

Run = Callable[[], str]
#: From thread and surface to the near pairs (k, 2).
Search = Callable[[Array, np.ndarray, Array, np.ndarray], np.ndarray]

#: A wall of two triangles, 0.15 mm thick, 40 mm wide; normals to +z.
WALL = np.array([[-20.0, -20.0, 0.0], [20.0, -20.0, 0.0], [0.0, 20.0, 0.0]])
WALLS = np.concatenate([WALL, WALL - np.array([0.0, 0.0, 0.15])])
TWO = np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
ONE = TWO[:1]


def cases() -> list[tuple[str, str, Run]]:
    """(case, method, run). ``run`` answers "ok: …" or "refused: …"; AssertionError says that a law is broken."""
    searches: list[tuple[str, Search]] = [("cells", _by_cells), ("bounding spheres", _by_spheres)]
    swept = "cells and continuous collision"
    return [
        ("needle grazing the wall at 2 degrees, 20 mm in a tick", swept, needle_grazes),
        ("two needles through one triangle, when", swept, two_needles),
        ("20 mm jump through a wall of 0.15 mm in a tick", swept, needle_jumps),
        ("20 mm jump of a thread of 1000 links over the vessel in a tick", swept, thread_jumps),
        *(
            (f"{OWN_SEGMENTS} links of a random heap near the vessel", name, partial(heap_on_vessel, s))
            for name, s in searches
        ),
        (f"{OWN_SEGMENTS} links in one place, near themselves", "cells", heap_on_itself),
        *(("triangles without area", name, partial(triangles_without_area, search)) for name, search in searches),
        ("triangle without area, in motion", swept, collapsed_in_motion),
        *(
            (f"a node at {bad}", name, partial(bad_place, s, bad))
            for bad in (math.nan, math.inf)
            for name, s in searches
        ),
        ("a node that goes to nan", swept, bad_way),
        *(("places of 1e-310 mm", name, partial(denormal_places, search)) for name, search in searches),
    ]


def _by_cells(thread: Array, segments: np.ndarray, surface: Array, triangles: np.ndarray) -> np.ndarray:
    made_for = np.where(np.isfinite(surface), surface, 0.0)
    return Cells(segments, triangles, made_for).near(thread, surface, MARGIN_MM)


def _by_spheres(thread: Array, segments: np.ndarray, surface: Array, triangles: np.ndarray) -> np.ndarray:
    return SphereSearch(SphereTree(segments, thread), SphereTree(triangles, surface)).near(MARGIN_MM)


def _impacts(
    segments: np.ndarray, triangles: np.ndarray, p0: Array, p1: Array, x0: Array, x1: Array, thickness: float
) -> tuple[np.ndarray, Impacts]:
    """Candidates from the cells and when they meet."""
    pairs = Cells(segments, triangles, x0).on_the_way(p0, p1, x0, x1, thickness)
    return pairs, SweptContact(segments, triangles).impacts(pairs, p0, p1, x0, x1, thickness)


def needle_grazes() -> str:
    """The tip is 0.3 mm over the wall and goes down by 20 sin 2°: it meets at 0.3 / (20 sin 2°)."""
    down = 20.0 * math.sin(math.radians(2.0))
    needle = np.array([[-10.0, -5.0, 0.3], [-13.0, -5.0, 1.0]])
    moved = needle + np.array([20.0 * math.cos(math.radians(2.0)), 0.0, -down])
    _, found = _impacts(chain(2), ONE, needle, moved, WALL, WALL, 0.0)
    off = abs(float(found.time[0]) - 0.3 / down)
    assert off <= TOUCH_MM / down + 1e-12, f"the time is off by {off:g} of a tick"
    assert found.normal[0, 2] > 1.0 - 1e-9, f"the normal is {found.normal[0].tolist()}"
    return f"ok: time of impact off by {off:.1e} of the tick"


def two_needles() -> str:
    """One comes from above, one from below: times 1/3 and 1/2, normals up and down."""
    needles = np.array([[0.2, 0.2, 1.0], [0.2, 0.2, 4.0], [0.5, 0.3, -2.0], [0.5, 0.3, -5.0]])
    moved = needles + np.array([-3.0, -3.0, 4.0, 4.0])[:, None] * np.array([0.0, 0.0, 1.0])
    segments = np.array([[0, 1], [2, 3]], dtype=np.int32)
    pairs, found = _impacts(segments, ONE, needles, moved, WALL, WALL, 0.0)
    assert pairs.tolist() == [[0, 0], [1, 0]], f"candidates {pairs.tolist()}"
    off = float(np.max(np.abs(found.time - [1.0 / 3.0, 0.5])))
    assert off <= TOUCH_MM / 3.0 + 1e-12, f"a time is off by {off:g} of a tick"
    assert np.array_equal(np.sign(found.normal[:, 2]), [1.0, -1.0]), f"normals {found.normal.tolist()}"
    return f"ok: both met, times off by {off:.1e} of the tick"


def needle_jumps() -> str:
    """From 1 mm above to 19 mm below: both sides of the wall are met, at 1/20 and 1.15/20."""
    needle = np.array([[0.3, 0.3, 1.0], [0.3, 0.3, 6.0]])
    _, found = _impacts(chain(2), TWO, needle, needle - np.array([0.0, 0.0, 20.0]), WALLS, WALLS, 0.0)
    assert len(found.time) == 2, f"{len(found.time)} sides of the wall are candidates"
    off = float(np.max(np.abs(found.time - [1.0 / 20.0, 1.15 / 20.0])))
    assert off <= TOUCH_MM / 20.0 + 1e-12, f"a time is off by {off:g} of a tick"
    return f"ok: both sides met, times off by {off:.1e} of the tick"


def thread_jumps() -> str:
    """A straight thread falls 20 mm past a vessel that lies across: every link above the outer wall must meet it.

    A link is certain to when it is over the vessel's middle; at the time it meets it is as near as is promised.
    """
    surfaces, triangles = vessel(32, 32)
    surface = surfaces[0]
    thread = np.zeros((OWN_SEGMENTS + 1, 3))
    thread[:, 0], thread[:, 1], thread[:, 2] = 5.0, np.linspace(-5.0, 5.0, OWN_SEGMENTS + 1), 10.0
    moved = thread - np.array([0.0, 0.0, 20.0])
    segments = chain(len(thread))
    pairs, found = _impacts(segments, triangles, thread, moved, surface, surface, 0.01)
    time, on_segment, on_triangle = (a.copy() for a in (found.time, found.first, found.second))
    met = np.isfinite(time)
    over = np.flatnonzero(np.abs(thread[:-1, 1]) < 0.9)
    missed = np.setdiff1d(over, pairs[met, 0])
    assert len(missed) == 0, f"{len(missed)} links fell through the vessel"
    t, share = time[met, None], on_segment[met, None]
    s = segments[pairs[met, 0]]
    place = (1.0 - share) * thread[s[:, 0]] + share * thread[s[:, 1]] - t * np.array([0.0, 0.0, 20.0])
    wall = np.einsum("kc,kcd->kd", on_triangle[met], surface[triangles[pairs[met, 1]]])
    off = float(np.max(np.abs(np.linalg.norm(place - wall, axis=1) - 0.01)))
    assert off <= 20.0 / MOST_STEPS + TOUCH_MM, f"a contact is off by {off:g} mm"
    return f"ok: {len(over)} links over the vessel met it, contacts off by up to {off:.1e} mm"


def heap(segments: int) -> Array:
    """A thread (n, 3) mm whose nodes lie about a place of the vessel's wall, 0.1 mm off in each direction; seeded."""
    rng = np.random.default_rng(0)
    x = np.array([5.0, 0.0, 1.0]) + 0.1 * rng.normal(size=(segments + 1, 3))
    return np.ascontiguousarray(x)


def heap_on_vessel(search: Search) -> str:
    surfaces, triangles = vessel(100, 100)
    thread = heap(OWN_SEGMENTS)
    found = search(thread, chain(len(thread)), surfaces[0], triangles)
    truth = surface_truth(thread, surfaces[:1], triangles)[0]
    wrong = len({(int(a), int(b)) for a, b in found} ^ truth)
    assert wrong == 0, f"{wrong} pairs missed or wrong of {len(truth)}"
    return f"ok: {len(found)} pairs, none missed, none wrong"


def heap_on_itself() -> str:
    """All links lie in one place: every pair but neighbours is near."""
    x = 1e-3 * np.random.default_rng(0).normal(size=(OWN_SEGMENTS + 1, 3))
    found = len(SelfContact(chain(len(x))).near(x, MARGIN_MM))
    expected = OWN_SEGMENTS * (OWN_SEGMENTS - 1) // 2 - (OWN_SEGMENTS - 1)
    assert found == expected, f"{found} pairs of {expected}"
    return f"ok: {found} pairs, all there are"


def triangles_without_area(search: Search) -> str:
    """A triangle that is a point, a line, or has doubled corners is near where the segment lies within it."""
    surface = np.array([[0.0, 0.0, 0.02], [1.0, 0.0, 0.02], [0.5, 0.0, 0.02], [0.0, 9.0, 0.0]])
    triangles = np.array([[0, 0, 0], [0, 1, 2], [1, 1, 2], [3, 3, 3]], dtype=np.int32)
    thread = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.0, 0.0], [0.7, 0.0, 0.0]])
    found = {(int(a), int(b)) for a, b in search(thread, chain(4), surface, triangles)}
    assert found == {(0, 0), (0, 1), (1, 1), (2, 1), (2, 2)}, f"pairs {sorted(found)}"
    return f"ok: {len(found)} pairs, as by hand"


def collapsed_in_motion() -> str:
    """A triangle that is a line of 1 mm falls on a segment of no length: 1 mm over, 2 mm in the tick, 0.1 mm thick."""
    line = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
    dot = np.array([[0.3, 0.0, 0.0], [0.3, 0.0, 0.0]])
    _, found = _impacts(chain(2), ONE, dot, dot, line, line - np.array([0.0, 0.0, 2.0]), 0.1)
    off = abs(float(found.time[0]) - 0.45)
    assert off <= TOUCH_MM, f"the time is off by {off:g} of a tick"
    return f"ok: time of impact off by {off:.1e} of the tick"


def bad_place(search: Search, bad: float) -> str:
    surface = WALL.copy()
    surface[1, 2] = bad
    return _refused(lambda: search(np.zeros((2, 3)), chain(2), surface, ONE))


def bad_way() -> str:
    moved = np.array([[0.0, 0.0, 1.0], [0.0, np.nan, 1.0]])
    return _refused(lambda: _impacts(chain(2), ONE, np.ones((2, 3)), moved, WALL, WALL, 0.1))


def denormal_places(search: Search) -> str:
    """A wall and a thread of 1e-310 mm are one place: near, and no division by what is next to nothing."""
    found = search(np.full((2, 3), 1e-310), chain(2), 1e-310 * WALL, ONE)
    assert found.tolist() == [[0, 0]], f"pairs {found.tolist()}"
    return "ok: 1 pair, all there is"


def _refused(run: Callable[[], object]) -> str:
    try:
        run()
    except ValueError as error:
        return f"refused: {error}"
    raise AssertionError("it was accepted")
