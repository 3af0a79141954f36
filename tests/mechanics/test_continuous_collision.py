"""When moving bodies meet: against fine samples of time, closed forms, and the symmetries of space."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes
from contact_samples import chain
from hypothesis import example, given
from hypothesis import strategies as st
from numba import njit

from trainer.geometry import matrix_from_quaternion, unit
from trainer.mechanics.cells import Cells
from trainer.mechanics.closest_points import point_triangle, segment_near_triangle, segment_segment
from trainer.mechanics.continuous_collision import (
    EDGE_EDGE,
    MOST_STEPS,
    POINT_TRIANGLE,
    TOUCH_MM,
    SweptContact,
    contact,
    crossing,
)
from trainer.mechanics.coplanarity import coplanar_times, volume_at, volume_coefficients

TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
ONE = np.array([[0, 1, 2]], dtype=np.int32)
SHAPES = ("even", "needle", "collapsed", "parallel", "still", "in one plane")


def motion(shape: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Four points (4, 3) at the start and the end of a tick, ordinary or degenerate."""
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-1.0, 1.0, (2, 4, 3))
    if shape == "needle":
        start[3], end[3] = start[1:3].mean(axis=0) + 1e-9, end[1:3].mean(axis=0)
    elif shape == "collapsed":
        start[1:] = start[1]
        end[1:] = end[1]
    elif shape == "parallel":
        start[3] = start[2] + start[1] - start[0]
        end[3] = end[2] + end[1] - end[0]
    elif shape == "still":
        end[1:] = start[1:]
    elif shape == "in one plane":
        start[:, 2] = end[:, 2] = 0.3
    return start, end


motions = st.builds(motion, st.sampled_from(SHAPES), st.integers(0, 10**6))
kinds = st.sampled_from((POINT_TRIANGLE, EDGE_EDGE))


def meet(kind: int, start: np.ndarray, end: np.ndarray, thickness: float) -> tuple[float, float, float, np.ndarray]:
    normal = np.zeros(3)
    time, u, v = contact(kind, start, end, thickness, 1.0, np.zeros((4, 3)), normal)
    return time, u, v, normal


def cross(kind: int, start: np.ndarray, end: np.ndarray) -> tuple[float, float, float, int, np.ndarray]:
    normal = np.zeros(3)
    time, u, v, side = crossing(kind, start, end, np.zeros((4, 3)), normal, np.zeros(7))
    return time, u, v, side, normal


@njit
def distances(kind, start, end, times):  # type: ignore[no-untyped-def]
    """The distance of the bodies at each of ``times``."""
    out = np.empty(len(times))
    for k in range(len(times)):
        x = (1.0 - times[k]) * start + times[k] * end
        if kind == POINT_TRIANGLE:
            d, _, _ = point_triangle(x[0, 0], x[0, 1], x[0, 2], x, 1, 2, 3)
        else:
            d, _, _ = segment_segment(x, 0, 1, x, 2, 3)
        out[k] = math.sqrt(d)
    return out


@given(kinds, motions, st.sampled_from((0.0, 1e-3, 0.1, 0.5)))
def test_no_sample_of_time_is_within_the_thickness_before_the_contact(
    kind: int, path: tuple[np.ndarray, np.ndarray], thickness: float
) -> None:
    """And at the contact the bodies are as near as promised: TOUCH_MM and the fastest approach over MOST_STEPS.

    The fastest approach is below 4 sqrt(3) mm in a tick, since every coordinate goes from ±1 to ±1. 1e-12 is for the
    rounding of a distance of at most 4 mm, 20 roundings of 1e-15, with the loss of a root at sqrt.
    """
    start, end = path
    time, u, v, normal = meet(kind, start, end, thickness)
    samples = np.linspace(0.0, min(time, 1.0), 1001)
    apart = distances(kind, start, end, samples)
    assert np.all(apart[samples < time] > thickness - 1e-12)
    if time <= 1.0:
        assert apart[-1] <= thickness + TOUCH_MM + 4.0 * math.sqrt(3.0) / MOST_STEPS
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        x = (1.0 - time) * start + time * end
        weights = [1.0, u + v - 1.0, -u, -v] if kind == POINT_TRIANGLE else [1.0 - u, u, v - 1.0, -v]
        between = np.array(weights) @ x
        assert np.linalg.norm(between) == pytest.approx(apart[-1], abs=1e-9)
        assert between @ normal >= -1e-12  # from the second body to the first


@given(kinds, motions)
def test_whatever_crosses_is_found_by_both_methods(kind: int, path: tuple[np.ndarray, np.ndarray]) -> None:
    """Where the volume changes its sign and the bodies are within 1e-9 mm at that time, they have crossed.

    The halving finds that time by itself, from 500 samples; the tolerance is TOUCH_MM, at which both methods stop.
    """
    start, end = path
    b0, b1, b2, b3, rounding = volume_coefficients(start, end)
    times = np.linspace(0.0, 1.0, 501)
    volumes = np.array([volume_at(t, b0, b1, b2, b3) for t in times])
    time, _, _, _, _ = cross(kind, start, end)
    touched, _, _, _ = meet(kind, start, end, 0.0)
    for k in np.flatnonzero(volumes[:-1] * volumes[1:] < 0.0):
        if min(abs(volumes[k]), abs(volumes[k + 1])) <= rounding:
            continue
        low, high = times[k], times[k + 1]
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if volume_at(middle, b0, b1, b2, b3) * volumes[k] > 0.0 else (low, middle)
        if distances(kind, start, end, np.array([high]))[0] < 1e-9:
            assert time <= high + 1e-9
            assert touched <= high
    if time <= 1.0:  # and nothing is found that is not there
        assert distances(kind, start, end, np.array([time]))[0] <= TOUCH_MM


@given(st.lists(st.floats(-2.0, 3.0), min_size=3, max_size=3), st.sampled_from((1.0, -3.0)))
@example([0.5, 0.5, 0.5], 1.0)
@example([0.25, 0.25, 2.0], 1.0)
@example([0.0, 1.0, 0.5], 1.0)
def test_the_roots_of_a_cubic_are_found_where_they_were_put(roots: list[float], leading: float) -> None:
    """(t - r)(t - s)(t - q) in Bernstein form; the coefficients are of order 30 and rounded to 1e-14.

    A root of multiplicity three lies where the cubic is below its rounding: within 1e-14 ** (1/3) / |leading|: 1e-4.
    All roots inside 0..1 must be near a listed time, and at every listed time the cubic is at most its rounding.
    """
    a = leading * np.poly(roots)  # a[0] t³ + a[1] t² + a[2] t + a[3]
    b = [a[3], a[3] + a[2] / 3.0, a[3] + 2.0 * a[2] / 3.0 + a[1] / 3.0, float(a.sum())]
    times = np.zeros(7)
    found = times[: coplanar_times(*b, 1e-13, times)]
    assert np.all(np.diff(found) >= 0.0)
    for root in roots:
        if 1e-4 < root < 1.0 - 1e-4:
            assert np.min(np.abs(found - root), initial=np.inf) < 1e-4
    for t in found:
        slope = abs(3 * a[0] * t * t + 2 * a[1] * t + a[2])
        assert abs(volume_at(t, *b)) <= 1e-12 + 1e-15 * slope


@given(kinds, motions, st.integers(0, 10**6))
def test_the_time_is_the_same_after_a_rigid_motion_and_the_other_way_round(
    kind: int, path: tuple[np.ndarray, np.ndarray], seed: int
) -> None:
    """Another frame, which moves at constant speed, and swapped bodies or corners, change the time by little.

    A contact is told between a gap of 0 and of L / MOST_STEPS, below 1.7e-3 mm, depending on roundings. So the laws are
    of the times of two thicknesses which differ by that: the thicker is met no later.
    """
    start, end = path
    rng = np.random.default_rng(seed)
    turn = matrix_from_quaternion(unit(rng.normal(size=4)))
    shift0, shift1 = rng.normal(size=(2, 3))
    order = [0, 2, 3, 1] if kind == POINT_TRIANGLE else [3, 2, 0, 1]
    start2, end2 = (start @ turn.T + shift0)[order], (end @ turn.T + shift1)[order]
    slack = 4.0 * math.sqrt(3.0) / MOST_STEPS + TOUCH_MM
    plain, _, _, normal = meet(kind, start, end, 0.1)
    thicker, _, _, _ = meet(kind, start2, end2, 0.1 + slack)
    assert thicker <= plain + 1e-9
    other, _, _, turned = meet(kind, start2, end2, 0.1)
    if 0.0 < plain <= 1.0 and abs(other - plain) < 1e-7:
        sense = 1.0 if kind == POINT_TRIANGLE else -1.0
        # The gap of 0.1 mm differs by 1e-6 at times 1e-7 apart, unless two pairs of points are equally near.
        near = distances(kind, start, end, np.array([plain, plain + 1e-5]))
        if shape_is_plain(start, end) and near[1] < near[0]:
            assert turned @ (turn @ normal) * sense > 0.99


def shape_is_plain(start: np.ndarray, end: np.ndarray) -> bool:
    """No two edges are parallel and no corner doubled, so that the nearest points are single."""
    for x in (start, end):
        for sides in ((x[1] - x[0], x[3] - x[2]), (x[2] - x[1], x[3] - x[1])):
            if np.linalg.norm(np.cross(*sides)) < 1e-2:
                return False
    return True


@given(st.floats(0.01, 0.5), st.floats(0.0, 6.28), st.sampled_from((0.0, 0.02)))
def test_a_point_that_grazes_at_two_degrees_meets_at_the_height_over_the_sine(
    height: float, heading: float, thickness: float
) -> None:
    """20 mm at 2 degrees to a large triangle's plane: time = (height - thickness) / (20 sin 2°).

    It is told when TOUCH_MM are left, earlier by TOUCH_MM / (20 sin 2°) = 1.5e-6 at most. Without thickness the normal
    comes from half of TOUCH_MM between places of up to 140 mm, rounded to 3e-14. It never meets if too high.
    """
    down = 20.0 * math.sin(math.radians(2.0))
    start = np.concatenate([[[0.0, 0.0, height + thickness]], 200.0 * TRIANGLE - [60.0, 60.0, 0.0]])
    end = start.copy()
    along = 20.0 * math.cos(math.radians(2.0))
    end[0] += [along * math.cos(heading), along * math.sin(heading), -down]
    time, u, v, normal = meet(POINT_TRIANGLE, start, end, thickness)
    assert height / down - 1.5e-6 - 1e-12 <= time <= height / down + 1e-12
    assert normal == pytest.approx([0.0, 0.0, 1.0], abs=2e-7)
    there = (1.0 - u - v) * start[1] + u * start[2] + v * start[3]
    assert there[:2] == pytest.approx(((1.0 - time) * start[0] + time * end[0])[:2], abs=1e-6)
    if thickness == 0.0:
        crossed, _, _, side, _ = cross(POINT_TRIANGLE, start, end)
        # A quotient of volumes of order 1e4, each rounded to 1e-12 of it.
        assert crossed == pytest.approx(height / down, abs=1e-10)
        assert side == 1
    start[0, 2] = end[0, 2] = 0.75
    end[0, 2] -= 0.7
    assert meet(POINT_TRIANGLE, start, end, thickness)[0] == np.inf


def test_a_jump_of_20_mm_does_not_tunnel_through_a_wall_of_150_micrometres() -> None:
    """Both sides of the wall are met, at the quotient of the ways, by a needle's tip and by its length."""
    wall = np.concatenate([TRIANGLE, TRIANGLE - np.array([0.0, 0.0, 0.15])])
    triangles = np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
    needle0 = np.array([[0.3, 0.3, 1.0], [0.3, 0.3, 6.0]])
    needle1 = needle0 - [0.0, 0.0, 20.0]
    pairs = Cells(chain(2), triangles, wall).on_the_way(needle0, needle1, wall, wall, 0.0)
    assert pairs.tolist() == [[0, 0], [0, 1]]
    found = SweptContact(chain(2), triangles).impacts(pairs, needle0, needle1, wall, wall, 0.0)
    # The approach is straight: one step lands within rounding of the wall, and TOUCH_MM / 20 mm is 5e-8.
    assert found.time == pytest.approx([1.0 / 20.0, 1.15 / 20.0], abs=6e-8)
    assert found.first == pytest.approx([0.0, 0.0])
    assert found.second == pytest.approx(np.array([[0.4, 0.3, 0.3]] * 2))
    assert found.normal == pytest.approx(np.array([[0.0, 0.0, 1.0]] * 2))


def test_two_needles_go_through_one_triangle() -> None:
    """From above and from below, at a third and at a half of the tick, each at its own place."""
    needles0 = np.array([[0.2, 0.2, 1.0], [0.2, 0.2, 4.0], [0.5, 0.3, -2.0], [0.5, 0.3, -5.0]])
    needles1 = needles0 + np.array([-3.0, -3.0, 4.0, 4.0])[:, None] * [0.0, 0.0, 1.0]
    segments = np.array([[0, 1], [2, 3]], dtype=np.int32)
    pairs = Cells(segments, ONE, TRIANGLE).on_the_way(needles0, needles1, TRIANGLE, TRIANGLE, 0.0)
    found = SweptContact(segments, ONE).impacts(pairs, needles0, needles1, TRIANGLE, TRIANGLE, 0.0)
    assert found.time == pytest.approx([1.0 / 3.0, 0.5], abs=1e-6)  # TOUCH_MM over at least 3 mm
    assert found.normal == pytest.approx(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert found.second == pytest.approx(np.array([[0.6, 0.2, 0.2], [0.2, 0.5, 0.3]]))
    for needle, side, time in ((0, 1, 1.0 / 3.0), (2, -1, 0.5)):
        start, end = (np.concatenate([x[needle : needle + 1], TRIANGLE]) for x in (needles0, needles1))
        crossed = cross(POINT_TRIANGLE, start, end)
        assert crossed[0] == pytest.approx(time, abs=1e-14)
        assert crossed[3] == side
        assert crossed[4] == pytest.approx([0.0, 0.0, side])


@pytest.mark.parametrize("down", [1.0, -1.0])
def test_the_normal_of_bodies_that_begin_in_touch_is_against_their_motion(down: float) -> None:
    """Nothing separates them, so their plane and the motion tell; where there is no plane, the motion alone."""
    start = np.concatenate([[[0.3, 0.3, 0.0]], TRIANGLE])
    end = start.copy()
    end[0, 2] -= down
    for kind, points in ((POINT_TRIANGLE, [0, 1, 2, 3]), (POINT_TRIANGLE, [0, 0, 0, 0]), (EDGE_EDGE, [0, 0, 0, 0])):
        still = start[points].copy()
        moved = still.copy()
        moved[: 1 if kind == POINT_TRIANGLE else 2] = end[0]
        time, _, _, normal = meet(kind, still, moved, 0.0)
        assert time == 0.0
        assert normal == pytest.approx([0.0, 0.0, down])
    assert meet(POINT_TRIANGLE, start[[0, 0, 0, 0]], start[[0, 0, 0, 0]], 0.0)[3].tolist() == [0.0, 0.0, 1.0]


def test_two_edges_cross_once() -> None:
    """One falls 2 mm on the other's middle from 1 mm: at a half, or at 0.45 when 0.1 mm of thread are between."""
    start = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 3.0, 0.0]])
    end = start - np.array([2.0, 2.0, 0.0, 0.0])[:, None] * [0.0, 0.0, 1.0]
    time, u, v, side, _ = cross(EDGE_EDGE, start, end)
    assert (time, u, v) == pytest.approx((0.5, 0.5, 0.25), abs=1e-14)
    assert cross(EDGE_EDGE, end, start)[3] == -side
    thick, _, _, normal = meet(EDGE_EDGE, start, end, 0.1)
    assert thick == pytest.approx(0.45, abs=1e-6)
    assert normal == pytest.approx([0.0, 0.0, 1.0])
    assert meet(EDGE_EDGE, end[[2, 3, 0, 1]], start[[2, 3, 0, 1]], 0.1)[3] == pytest.approx([0.0, 0.0, 1.0])


@given(st.integers(0, 10**6), st.sampled_from((0.0, 0.05)))
def test_a_segment_meets_a_triangle_before_any_sample_finds_it_near(seed: int, thickness: float) -> None:
    """Bodies that begin apart: of 201 samples of the way none before the contact is within the thickness.

    1e-9 mm for two ways to a distance; without thickness, what passes between two samples is told as well.
    """
    rng = np.random.default_rng(seed)
    p0, p1 = rng.uniform(-1.0, 1.0, (2, 2, 3))
    x0, x1 = rng.uniform(-1.0, 1.0, (2, 3, 3))
    if segment_near_triangle(p0, 0, 1, x0, 0, 1, 2, thickness + 1e-3):
        return
    pair = np.zeros((1, 2), dtype=np.int32)
    found = SweptContact(chain(2), ONE).impacts(pair, p0, p1, x0, x1, thickness)
    for t in np.linspace(0.0, 1.0, 201):
        p, x = (1.0 - t) * p0 + t * p1, (1.0 - t) * x0 + t * x1
        if t < found.time[0]:
            assert not segment_near_triangle(p, 0, 1, x, 0, 1, 2, thickness - 1e-9 if thickness else 1e-9)
    if found.time[0] <= 1.0:
        t = found.time[0]
        p, x = (1.0 - t) * p0 + t * p1, (1.0 - t) * x0 + t * x1
        gap = (1.0 - found.first[0]) * p[0] + found.first[0] * p[1] - found.second[0] @ x
        assert np.linalg.norm(gap) <= thickness + TOUCH_MM + 4.0 * math.sqrt(3.0) / MOST_STEPS
        assert found.second[0].sum() == pytest.approx(1.0)


def test_bad_input_is_refused_and_nothing_meets_nothing() -> None:
    search = SweptContact(chain(2), ONE)
    p = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    pair = np.zeros((1, 2), dtype=np.int32)
    assert search.impacts(pair[:0], p, p, TRIANGLE, TRIANGLE, 0.1).time.shape == (0,)
    with pytest.raises(ValueError, match="column 1"):
        search.impacts(pair + np.array([0, 1], dtype=np.int32), p, p, TRIANGLE, TRIANGLE, 0.1)
    with pytest.raises(ValueError, match="names node 2"):
        search.impacts(pair, p, p, TRIANGLE[:2].copy(), TRIANGLE, 0.1)
    with pytest.raises(ValueError, match="margin_mm"):
        search.impacts(pair, p, p, TRIANGLE, TRIANGLE, np.nan)
    bad = p.copy()
    bad[1, 2] = np.nan
    with pytest.raises(ValueError, match="segments: node 1"):
        search.impacts(pair, p, bad, TRIANGLE, TRIANGLE, 0.1)


def falling(segments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Candidate pairs of a thread that falls on a strip of triangles, before and after."""
    rng = np.random.default_rng(2)
    thread0 = np.cumsum(rng.normal(scale=0.2, size=(segments + 1, 3)), axis=0)
    pairs = np.stack([np.arange(segments), np.zeros(segments)], axis=1).astype(np.int32)
    return pairs, thread0, thread0 + rng.normal(scale=0.5, size=thread0.shape), 3.0 * TRIANGLE - 1.0


def test_more_pairs_than_ever_find_room_and_then_nothing_is_allocated() -> None:
    """What remains are four views, below 2 kB; the arrays have 30 kB."""
    search = SweptContact(chain(601), ONE)
    pairs, thread0, thread1, x = falling(600)
    assert len(search.impacts(pairs[:5], thread0, thread1, x, x, 0.1).time) == 5
    few = search.impacts(pairs[:5], thread0, thread1, x, x, 0.1).time.copy()
    assert np.array_equal(search.impacts(pairs, thread0, thread1, x, x, 0.1).time[:5], few)
    kept, peak = kept_bytes(lambda: search.impacts(pairs, thread0, thread1, x, x, 0.1))
    assert kept < ARRAY_HEADER
    assert peak < 2048


SCRIPT = "from test_continuous_collision import some; print(some())"


def some() -> str:
    """Contacts of a few pairs of both kinds as bytes."""
    pairs, thread0, thread1, x = falling(4)
    found = SweptContact(chain(5), ONE).impacts(pairs, thread0, thread1, x, x, 0.1)
    out = np.column_stack([found.time, np.where(np.isfinite(found.time), found.first, 0.0)]).tobytes()
    found = SweptContact(chain(5), chain(5)).impacts(pairs[2:], thread0, thread1, thread0, thread1, 0.1)
    out += found.time.tobytes()
    crossed = [cross(kind, *motion("even", seed))[:3] for kind in (0, 1) for seed in range(4)]
    return (out + np.array(crossed).tobytes()).hex()


def test_uncompiled_kernels_find_the_same() -> None:
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(["tests/mechanics", "."])}
    command = [sys.executable, "-c", SCRIPT]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == some()
