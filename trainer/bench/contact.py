"""Contact search: time against pairs that are missed or wrong, of all methods on the same work.

A thread of 300 segments lies around a vessel that deforms, so that half of it is near the wall; and a thread of 1000
segments lies in a tangle. Each method says which pairs are within the margin, and looking at all pairs says which are.
The frames of all methods are run in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter_ns

import fcl
import numpy as np
from numba import njit

from trainer.bench.rows import Row, median_and_p90
from trainer.geometry import Array
from trainer.mechanics.bounding_spheres import SphereSearch, SphereTree
from trainer.mechanics.cells import Cells
from trainer.mechanics.closest_points import segment_near_triangle, segment_segment
from trainer.mechanics.self_contact import SelfContact

#: Layers and nodes around of the vessels: 1 984, 19 800 and 199 712 triangles.
SURFACES = ((32, 32), (100, 100), (317, 316))
SEGMENTS, OWN_SEGMENTS = 300, 1000
#: A pair is near at this distance: the radius of 10-0 thread and as much again for the motion of a tick (assumed).
MARGIN_MM = 0.03
#: The vessel: outer radius and length.
RADIUS_MM, LENGTH_MM = 1.0, 10.0
#: States of the surface that the frames go through, and how often each method runs; those with FCL less often.
STATES = 4
FRAMES, QUICK_FRAMES, FCL_FRAMES = 40, 12, 4
#: Quick leaves out FCL from this number of triangles on: it builds for half a second a frame.
QUICK_FCL_BELOW = 100_000
ERROR_OF = "search: pairs missed or wrong, as a share of the pairs that looking at all of them finds"
NO_ANSWER = "search: none, no pairs are asked for"
#: Methods are compared at this error: every pair and no other.
COMPARED_AT = 0.0

#: What a method does in a frame: the state's number to pairs, (k, 2), in any order.
Search = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Method:
    """One way to find the pairs."""

    name: str
    setting: str
    search: Search
    slow: bool = False
    answers: bool = True  # whether it says which pairs are near
    ms: list[float] = field(default_factory=list)


def chain(nodes: int) -> np.ndarray:
    """The segments (nodes - 1, 2) int32 of one thread."""
    return np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1).astype(np.int32)


def vessel(layers: int, around: int) -> tuple[list[Array], np.ndarray]:
    """A tube's nodes (n, 3) mm in its states, in each bulging elsewhere by 3 % of its radius, and its triangles."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(layers), np.arange(around), indexing="ij"))
    x, clock = i * (LENGTH_MM / (layers - 1)), j * (2.0 * np.pi / around)
    states = []
    for state in range(STATES):
        radius = RADIUS_MM * (1.0 + 0.03 * np.sin(2.0 * x + clock + state))
        states.append(np.ascontiguousarray(np.stack([x, radius * np.cos(clock), radius * np.sin(clock)], axis=1)))
    inner = i < layers - 1
    a, right = (i * around + j)[inner], (i * around + (j + 1) % around)[inner]
    triangles = np.concatenate(
        [np.stack([a, right + around, a + around], axis=1), np.stack([a, right, right + around], axis=1)]
    )
    return states, triangles.astype(np.int32)


def thread_around(segments: int = SEGMENTS) -> Array:
    """A thread (n, 3) mm twice around the vessel; half of it lies within the margin of the wall at rest."""
    s = np.linspace(0.0, 1.0, segments + 1)
    radius = RADIUS_MM + 0.02 + 0.5 * np.maximum(np.sin(6.0 * np.pi * s), 0.0)
    clock = 4.0 * np.pi * s
    return np.stack([2.0 + 6.0 * s, radius * np.cos(clock), radius * np.sin(clock)], axis=1)


def tangle(segments: int = OWN_SEGMENTS, state: int = 0) -> Array:
    """A thread (n, 3) mm of segments of 0.1 mm that turns at random and is drawn back to the middle; seeded."""
    rng = np.random.default_rng(state)
    x, way = np.zeros(3), np.array([1.0, 0.0, 0.0])
    nodes = [x]
    for _ in range(segments):
        way = 0.95 * way + 0.3 * rng.normal(size=3) - 0.06 * x
        way /= np.linalg.norm(way)
        x = x + 0.1 * way
        nodes.append(x)
    return np.array(nodes)


@njit(cache=True, nogil=True, error_model="numpy")
def _all_near(p, segments, x, triangles, margin, found):  # type: ignore[no-untyped-def]
    """Mark every near pair in ``found`` (m, f); boxes are compared before the distance, with a wide margin."""
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        for s in range(segments.shape[0]):
            i, j = segments[s, 0], segments[s, 1]
            found[s, f] = False
            apart = False
            for d in range(3):
                if (
                    max(p[i, d], p[j, d]) + 2.0 * margin < min(min(x[a, d], x[b, d]), x[c, d])
                    or min(p[i, d], p[j, d]) - 2.0 * margin > max(max(x[a, d], x[b, d]), x[c, d])
                ):  # fmt: skip
                    apart = True
                    break
            if not apart:
                found[s, f] = segment_near_triangle(p, i, j, x, a, b, c, margin)


@njit(cache=True, nogil=True, error_model="numpy")
def _all_own(x, segments, margin, pairs):  # type: ignore[no-untyped-def]
    """Look at all pairs of segments but neighbours; returns how many are near, written as far as there is room."""
    count = 0
    for s in range(segments.shape[0]):
        for o in range(s + 2, segments.shape[0]):
            d, _, _ = segment_segment(x, segments[s, 0], segments[s, 1], x, segments[o, 0], segments[o, 1])
            if d <= margin * margin:
                if count < pairs.shape[0]:
                    pairs[count, 0], pairs[count, 1] = s, o
                count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _read(x, triangles):  # type: ignore[no-untyped-def]
    """Read each triangle's corners once and do next to nothing with them."""
    low = np.inf
    for f in range(triangles.shape[0]):
        for c in range(3):
            v = triangles[f, c]
            low = min(low, x[v, 0] + x[v, 1] + x[v, 2])
    return low


def surface_methods(thread: Array, states: list[Array], triangles: np.ndarray, with_fcl: bool) -> list[Method]:
    """All methods on a thread and a surface in its states."""
    segments = chain(len(thread))
    nothing = np.empty((0, 2), dtype=np.int32)
    tree, own = SphereTree(triangles, states[0]), SphereTree(segments, thread)
    spheres = SphereSearch(own, tree)
    cells = Cells(segments, triangles, states[0])

    def refit_and_search(state: int) -> np.ndarray:
        own.refit(thread)
        tree.refit(states[state])
        return spheres.near(MARGIN_MM)

    def read(state: int) -> np.ndarray:
        _read(states[state], triangles)
        return nothing

    methods = [
        Method("bounding spheres", "refitted every frame", refit_and_search),
        Method("cells", "triangles past the thread's cells", lambda k: cells.near(thread, states[k], MARGIN_MM)),
        Method("reading all triangles", "the least that any search must do", read, answers=False),
    ]
    if with_fcl:

        def rebuild(state: int) -> np.ndarray:
            _fcl_mesh(states[state], triangles)
            return nothing

        def rebuild_and_search(state: int) -> np.ndarray:
            mesh = fcl.CollisionObject(_fcl_mesh(states[state], triangles))
            return _fcl_pairs(_fcl_capsules(thread, MARGIN_MM)[1], mesh)

        methods += [
            Method("FCL", "rebuild alone", rebuild, slow=True, answers=False),
            Method("FCL", "rebuild, then a capsule a segment", rebuild_and_search, slow=True),
        ]
    return methods


def own_methods(threads: list[Array]) -> list[Method]:
    """All methods on a thread against itself."""
    segments = chain(len(threads[0]))
    search = SelfContact(segments)
    room = np.zeros((len(segments) * 8, 2), dtype=np.int32)

    def all_pairs(state: int) -> np.ndarray:
        return room[: _all_own(threads[state], segments, MARGIN_MM, room)]

    def by_fcl(state: int) -> np.ndarray:
        shapes, capsules = _fcl_capsules(threads[state], 0.5 * MARGIN_MM)
        manager = fcl.DynamicAABBTreeCollisionManager()
        manager.registerObjects(capsules)
        manager.setup()
        data = fcl.CollisionData(request=fcl.CollisionRequest(num_max_contacts=100_000, enable_contact=True))
        manager.collide(data, fcl.defaultCollisionCallback)
        number = {id(shape): k for k, shape in enumerate(shapes)}
        pairs = np.array([sorted((number[id(c.o1)], number[id(c.o2)])) for c in data.result.contacts], dtype=np.int32)
        return pairs[pairs[:, 1] - pairs[:, 0] > 1]

    return [
        Method("cells", "the thread's own", lambda k: search.near(threads[k], MARGIN_MM)),
        Method("all pairs", "each distance", all_pairs),
        Method("FCL", "a capsule a segment, dynamic tree of boxes", by_fcl, slow=True),
    ]


def _fcl_mesh(x: Array, triangles: np.ndarray) -> fcl.BVHModel:
    mesh = fcl.BVHModel()
    mesh.beginModel(len(x), len(triangles))
    mesh.addSubModel(x, triangles)
    mesh.endModel()
    return mesh


def _fcl_capsules(thread: Array, radius: float) -> tuple[list[fcl.Capsule], list[fcl.CollisionObject]]:
    """A capsule about each segment, and the same in its place."""
    way = np.diff(thread, axis=0)
    length = np.linalg.norm(way, axis=1)
    # The rotation that turns z to the segment by half the angle: (1 + cos, z × way), scaled.
    turn = np.stack([1.0 + way[:, 2] / length, -way[:, 1] / length, way[:, 0] / length, np.zeros(len(way))], axis=1)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    middle = thread[:-1] + 0.5 * way
    shapes = [fcl.Capsule(radius, side) for side in length]
    placed = [fcl.CollisionObject(shapes[k], fcl.Transform(turn[k], middle[k])) for k in range(len(way))]
    return shapes, placed


def _fcl_pairs(capsules: list[fcl.CollisionObject], mesh: fcl.CollisionObject) -> np.ndarray:
    """Which capsules touch which triangles of the mesh."""
    request = fcl.CollisionRequest(num_max_contacts=100_000, enable_contact=True)
    pairs = []
    for s, capsule in enumerate(capsules):
        result = fcl.CollisionResult()
        if fcl.collide(mesh, capsule, request, result):
            pairs += [(s, contact.b1) for contact in result.contacts]
    return np.array(pairs, dtype=np.int32).reshape(-1, 2)


def compare(case: str, size: int, methods: list[Method], truth: list[set[tuple[int, int]]], frames: int) -> list[Row]:
    """Run all methods in turn for ``frames`` frames; ``truth`` holds the near pairs of each state."""
    error = {id(m): 0.0 for m in methods}
    for method in methods:
        for state in range(len(truth)):  # the first frames compile and make room; these are not timed
            found = {(int(a), int(b)) for a, b in method.search(state)}
            share = len(found ^ truth[state]) / max(len(truth[state]), 1)
            error[id(method)] = max(error[id(method)], share)
            if method.slow:
                break
    for frame in range(frames):
        turn = frame % len(methods)  # who comes after a method with large arrays finds its own displaced
        for method in methods[turn:] + methods[:turn]:
            if method.slow and len(method.ms) >= FCL_FRAMES:
                continue
            begun = perf_counter_ns()
            method.search(frame % len(truth))
            method.ms.append((perf_counter_ns() - begun) * 1e-6)
    rows = []
    for method in methods:
        median, p90 = median_and_p90(method.ms)
        off = error[id(method)] if method.answers else math.nan
        status = ("all pairs" if off == 0.0 else "other pairs") if method.answers else "no pairs asked"
        rows.append(
            Row(
                case, size, method.name, method.setting, len(method.ms), median, p90, off,
                ERROR_OF if method.answers else NO_ANSWER, 0.0, status, "nothing",
                COMPARED_AT if method.answers else None,
            )
        )  # fmt: skip
    return rows


def surface_truth(thread: Array, states: list[Array], triangles: np.ndarray) -> list[set[tuple[int, int]]]:
    """The near pairs of each state, by looking at all pairs."""
    segments = chain(len(thread))
    found = np.zeros((len(segments), len(triangles)), dtype=np.bool_)
    out = []
    for x in states:
        _all_near(thread, segments, x, triangles, MARGIN_MM, found)
        out.append({(int(a), int(b)) for a, b in np.argwhere(found)})
    return out


def measure(quick: bool, surfaces: tuple[tuple[int, int], ...] = SURFACES) -> list[Row]:
    """All rows. Kernels are compiled before."""
    frames = QUICK_FRAMES if quick else FRAMES
    thread = thread_around()
    rows = []
    for layers, around in surfaces:
        states, triangles = vessel(layers, around)
        with_fcl = not quick or len(triangles) < QUICK_FCL_BELOW
        methods = surface_methods(thread, states, triangles, with_fcl)
        truth = surface_truth(thread, states, triangles)
        case = f"contact: {SEGMENTS} segments of thread, deforming vessel"
        rows += compare(case, len(triangles), methods, truth, frames)
    threads = [tangle(OWN_SEGMENTS, state) for state in range(STATES)]
    methods = own_methods(threads)
    everything = next(m for m in methods if m.name == "all pairs")
    truth = [{(int(a), int(b)) for a, b in everything.search(state)} for state in range(STATES)]
    return rows + compare("contact: thread against itself", OWN_SEGMENTS, methods, truth, frames)
