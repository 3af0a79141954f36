"""Laws of the thread: exact length, the paper's rule, its symmetries, pieces, and the queries on it."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.geometry import Array, Rigid, quaternion_from_axis_angle
from trainer.mechanics.thread import ThreadModel, break_at, closest, follow, length_error, polyline, slide

# The gap of a span closes to 1e-11 links and a span within 1e-10 of taut is laid straight, so 1e-9 links
# leaves a factor of ten for the rounding of coordinates of some hundred mm (1e-13 mm).
EXACT = 1e-9
LN, D = 4.0, 0.5


def straight(model: ThreadModel) -> Array:
    x = np.zeros((model.count, 3))
    x[:, 0] = model.arcs() - model.needle_length
    return x


def held_at_ends(model: ThreadModel) -> Array:
    return np.array([model.needle_length, model.end])


def wavy(model: ThreadModel, seed: int = 0) -> Array:
    """A thread of exact links whose direction wanders smoothly."""
    rng = np.random.default_rng(seed)
    turn = np.cumsum(np.cumsum(rng.normal(0.0, 0.02, (model.count - 1, 3)), axis=0), axis=0) + np.array([1.0, 0.0, 0.0])
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(model.link * turn, axis=0)])


# ---- length ----


@pytest.mark.parametrize("seed", range(4))
def test_length_is_kept_over_a_thousand_ticks_of_any_motion(seed: int) -> None:
    """Six constraints, soft and hard, walk at random, now and then jump; every link keeps its length."""
    rng = np.random.default_rng(seed)
    model = ThreadModel(LN, D, 100)
    x, pieces = straight(model), model.whole()
    arcs = np.array([LN, 9.1, 17.0, 17.2, 30.03, 41.7])
    hard = np.array([True, False, False, False, False, seed % 2 == 0])
    home = x[[0, 10, 25, 26, 40, 55]]
    points = home.copy()
    ticks = 0
    for tick in range(1500):
        spread = 5.0 if tick % 97 == 0 else 0.1
        moved = points + rng.normal(0.0, spread, (6, 3)) - 0.02 * (points - 0.5 * home)
        slid = slide(model, arcs, moved, hard, pieces)
        if slid.shortage.any() or slid.pulled_out.any():
            continue  # too far apart for this thread: the hands do not go there
        points, arcs, ticks = moved, slid.arc, ticks + 1
        assert not follow(model, x, arcs, points, pieces).any()
        assert length_error(model, x, arcs, points, pieces) <= EXACT
    assert ticks >= 1000


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    count=st.integers(2, 30),
    part=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    tautness=st.one_of(
        st.floats(0.0, 1.0), st.sampled_from([0.0, 1e-12, 1.0, 1.0 - 1e-15, 1.0 - 1e-10, 1.0 - 3e-10, 1.0 - 1e-7])
    ),
    start=st.sampled_from(["random", "collinear", "coincident", "folded"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_feasible_span_closes_exactly(
    count: int, part: tuple[float, float], tautness: float, start: str, seed: int
) -> None:
    """Any old shape, degenerate ones included, any two arcs and any distance up to the thread between them."""
    rng = np.random.default_rng(seed)
    model = ThreadModel(LN, D, count)
    arcs = np.sort(LN + np.array(part) * (model.end - LN))
    old = {
        "random": rng.normal(0.0, 3.0, (count, 3)),
        "collinear": straight(model),
        "coincident": np.ones((count, 3)),
        "folded": straight(model) * (-1.0) ** np.arange(count)[:, None],
    }[start]
    direction = rng.normal(size=3) if seed % 2 else np.array([1.0, 0.0, 0.0])
    points = np.zeros((2, 3))
    points[1] = tautness * (arcs[1] - arcs[0]) * direction / np.linalg.norm(direction)
    lacking = follow(model, old, arcs, points, model.whole())
    assert not lacking.any()
    assert length_error(model, old, arcs, points, model.whole()) <= EXACT


def test_taut_thread_is_straight_and_a_stretched_one_says_so() -> None:
    """At distance L the nodes are at A + s (B - A) / L; at 1.01 L each link is 1 % too long, which is reported."""
    model = ThreadModel(LN, D, 41)
    for factor, error in ((1.0, 0.0), (1.01, 0.01)):
        x = wavy(model)
        points = np.array([[1.0, 2.0, 3.0], [1.0, 2.0 + 20.0 * factor, 3.0]])
        lacking = follow(model, x, held_at_ends(model), points, model.whole())
        expected = points[0] + np.linspace(0.0, 1.0, 41)[:, None] * (points[1] - points[0])
        np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(lacking, [20.0 * (factor - 1.0), 0.0], atol=1e-12)
        got = length_error(model, x, held_at_ends(model), points, model.whole())
        assert got == pytest.approx(error, abs=1e-12)


def test_straight_thread_pushed_together_buckles_into_a_circular_arc() -> None:
    """Length L = 2 a R, chord 2 R sin a: the sag is R (1 - cos a), here for chord = 0.9 L along a tilted line.

    Links of the arc turn by 2 a / 80 = 0.02 rad each, so that the polygon differs from its circle by
    (0.02)^2 / 8 of its size: 1e-4 of L, rounded up.
    """
    model = ThreadModel(LN, D, 81)
    along = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    x = straight(model)[:, :1] * along
    length = model.end - LN
    points = np.array([np.zeros(3), 0.9 * length * along])
    follow(model, x, held_at_ends(model), points, model.whole())
    a = 0.7866830  # sin a / a = 0.9
    sag = length / (2.0 * a) * (1.0 - np.cos(a))
    off = x - np.outer(x @ along, along)
    assert np.linalg.norm(off, axis=1).max() == pytest.approx(sag, abs=1e-4 * length)
    assert np.linalg.matrix_rank(off, tol=1e-9) == 1  # in one plane
    assert length_error(model, x, held_at_ends(model), points, model.whole()) <= EXACT


def test_ends_to_and_fro_coincident_and_twenty_millimetres_at_once() -> None:
    """The ends oscillate through one another and through taut, then jump by 20 mm: exact at each tick."""
    model = ThreadModel(LN, D, 60)
    x, pieces, length = straight(model), model.whole(), model.end - LN
    for tick in range(400):
        gap = length * np.cos(0.05 * tick)
        points = np.array([[0.5 * gap, 0.0, 0.0], [-0.5 * gap, 0.0, 0.0]])
        if tick % 50 == 49:
            points[0] = points[1]
        if tick % 60 == 0:
            points += [0.0, 20.0, 0.0]
        assert not follow(model, x, held_at_ends(model), points, pieces).any()
        assert length_error(model, x, held_at_ends(model), points, pieces) <= EXACT


def test_holes_on_one_link_may_come_together() -> None:
    """Two holes 0.2 mm apart on a 0.5 mm link approach: the thread between them folds and keeps its length."""
    model = ThreadModel(LN, D, 20)
    x, pieces = straight(model), model.whole()
    arcs = np.array([LN, LN + 3.1, LN + 3.3])
    for gap in np.linspace(0.2, 0.0, 21):
        points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0 + gap, 0.0, 0.0]])
        assert not follow(model, x, arcs, points, pieces).any()
        assert length_error(model, x, arcs, points, pieces) <= EXACT
    line = polyline(model, x, arcs, points, pieces)[0]
    assert len(line) == 20 + 2 + 1  # nodes, two holes (the swage is a node), and the fold


# ---- the paper's rule ----


def test_nothing_moves_unless_a_constraint_moves() -> None:
    """Both passes are then the identity. 1e-9: rounding of 99 links of some mm, through a well-bent span."""
    model = ThreadModel(LN, D, 100)
    x = wavy(model)
    arcs = np.array([LN, LN + 20 * D, LN + 70 * D])
    before, points = x.copy(), x[[0, 20, 70]]
    for _ in range(50):
        follow(model, x, arcs, points, model.whole())
    np.testing.assert_allclose(x, before, rtol=0.0, atol=1e-9)
    follow(model, x, np.empty(0), np.empty((0, 3)), model.whole())
    np.testing.assert_allclose(x, before, rtol=0.0, atol=1e-9)


def test_thread_pulled_along_its_own_line_translates() -> None:
    """Each node's old place lies on the line through its leader's new one: x_i moves by exactly the pull."""
    model = ThreadModel(LN, D, 50)
    x = straight(model)
    follow(model, x, np.array([LN]), np.array([[-0.3, 0.0, 0.0]]), model.whole())
    np.testing.assert_allclose(x, straight(model) - [0.3, 0.0, 0.0], rtol=0.0, atol=1e-13)


def test_free_ends_follow_the_papers_formula_from_a_grip_inside_a_link() -> None:
    """x_i' = leader + distance * unit(x_i - leader), written out here, to both sides of a grip at 7.3 links."""
    model = ThreadModel(LN, D, 15)
    x = wavy(model, 3)
    grip = 0.7 * x[7] + 0.3 * x[8] + [0.1, -0.2, 0.15]
    expected = x.copy()
    for nodes, first in ((range(8, 15), 0.7 * D), (range(7, -1, -1), 0.3 * D)):
        leader, distance = grip, first
        for i in nodes:
            away = x[i] - leader
            expected[i] = leader + distance * away / np.linalg.norm(away)
            leader, distance = expected[i], D
    follow(model, x, np.array([LN + 7.3 * D]), grip[None], model.whole())
    np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-12)  # rounding of the arc (1e-15) and positions


@pytest.mark.parametrize("steps", [200, 400, 800])
def test_a_node_dragged_sideways_draws_the_tractrix(steps: int) -> None:
    """A link d at angle a to the pull obeys da/dY = -sin(a) / d, so tan(a/2) falls as exp(-Y/d).

    One step of h = e d gives a' = a - e sin a + e^2 sin a cos a + O(e^3), the exact flow e^2/2 of the same
    term; summed along the flow from 90 degrees down, where it contracts, the angle lags by at most
    e/2 * integral of cos a da <= e/2. So the node is off by at most h/2, plus e^2 d of higher terms.
    """
    model = ThreadModel(LN, D, 2)
    x = straight(model)
    pull = 2.0
    h = pull / steps
    for k in range(steps):
        follow(model, x, np.array([LN]), np.array([[0.0, (k + 1) * h, 0.0]]), model.whole())
    exact = np.array([D / np.cosh(pull / D), pull - D * np.tanh(pull / D), 0.0])
    error = np.linalg.norm(x[1] - exact)
    assert error <= 0.5 * h + h * h / D
    assert error >= 0.01 * h  # it is the first-order rule, not something else


def test_between_constraints_the_averaged_directions_turn_by_one_common_vector() -> None:
    """The closure's law (thread_closure): u_j - w_j = (I - w_j w_j^T) m, to second order in m.

    w are the directions of the paper's average, formed here. Normalising w + m leaves at most |m|^2 per
    Newton step, and a second step is a correction of that size: 4 |m|^2 covers both.
    """
    model = ThreadModel(LN, D, 40)
    x = wavy(model, 5)
    points = x[[0, -1]] + np.array([[0.02, -0.03, 0.01], [0.0, 0.02, -0.02]])
    ahead, back = x.copy(), x.copy()
    ahead[0], back[-1] = points
    for i in range(1, 40):
        away = x[i] - ahead[i - 1]
        ahead[i] = ahead[i - 1] + D * away / np.linalg.norm(away)
        away = x[39 - i] - back[40 - i]
        back[39 - i] = back[40 - i] + D * away / np.linalg.norm(away)
    mean = 0.5 * (ahead + back)
    mean[0], mean[-1] = points
    follow(model, x, held_at_ends(model), points, model.whole())
    w, u = (np.diff(p, axis=0) / np.linalg.norm(np.diff(p, axis=0), axis=1)[:, None] for p in (mean, x))
    projectors = np.eye(3) - w[:, :, None] * w[:, None, :]
    m = np.linalg.lstsq(projectors.reshape(-1, 3), (u - w).ravel(), rcond=None)[0]
    assert 1e-5 < np.linalg.norm(m) < 0.1
    assert np.abs(projectors @ m - (u - w)).max() <= 4.0 * float(m @ m)


def test_nodes_do_not_leap() -> None:
    """On a loose thread no node moves more than twice as far as the ends (measured: 1.2 times in 20 000 ticks).

    A regression bound, not a law: a thread that becomes taut must move faster than its ends.
    """
    model = ThreadModel(LN, D, 100)
    x = wavy(model)
    points = x[[0, -1]]
    rng = np.random.default_rng(2)
    velocity = np.zeros((2, 3))
    for _ in range(500):
        velocity = 0.9 * velocity + rng.normal(0.0, 0.02, (2, 3)) - 0.01 * (points - 0.3 * points.mean(axis=0))
        moved = points + velocity
        if np.linalg.norm(moved[1] - moved[0]) > 0.9 * (model.end - LN):
            continue
        before = x.copy()
        follow(model, x, held_at_ends(model), moved, model.whole())
        largest = np.linalg.norm(moved - points, axis=1).max()
        assert np.linalg.norm(x - before, axis=1).max() <= 2.0 * largest
        points = moved


# ---- symmetries ----

_STEP = np.array([[0.1, -0.2, 0.05], [-0.1, 0.15, 0.2], [0.05, 0.1, -0.3]])


def test_the_thread_does_not_know_which_end_is_which() -> None:
    """Nodes, arcs and points reversed give the reversed thread. 1e-8: a gap of 1e-11 links over bent spans."""
    model = ThreadModel(LN, D, 60)
    x = wavy(model, 1)
    arcs, points = LN + D * np.array([5.0, 20.3, 50.0]), x[[5, 20, 50]] + _STEP
    other = x[::-1].copy()
    follow(model, x, arcs, points, model.whole())
    follow(model, other, (LN + model.end - arcs)[::-1], points[::-1], model.whole())
    np.testing.assert_allclose(other[::-1], x, rtol=0.0, atol=1e-8)


def test_moving_the_whole_scene_moves_the_thread() -> None:
    """Moved 1 m and turned: rounding of 1e3 mm is 1e-13 mm, a factor of 1e5 left for bent spans."""
    model = ThreadModel(LN, D, 60)
    x = wavy(model, 1)
    arcs, points = LN + D * np.array([5.0, 20.3, 50.0]), x[[5, 20, 50]] + _STEP
    far = Rigid(np.array([600.0, -700.0, 300.0]), quaternion_from_axis_angle([1.0, 2.0, -0.5], 2.1))
    other = far.apply(x)
    follow(model, x, arcs, points, model.whole())
    follow(model, other, arcs, far.apply(points), model.whole())
    np.testing.assert_allclose(other, far.apply(x), rtol=0.0, atol=1e-8)


# ---- pieces ----


def test_a_break_loses_one_link_and_leaves_two_free_ends() -> None:
    """Each piece then follows its own constraints: the other one does not move at all."""
    model = ThreadModel(LN, D, 30)
    pieces = break_at(model, model.whole(), LN + 10.4 * D)
    np.testing.assert_allclose(pieces, LN + D * np.array([[0.0, 10.0], [11.0, 29.0]]))
    x = wavy(model)
    before = x.copy()
    arcs, points = np.array([LN + 20 * D]), x[[20]] + [0.5, 0.5, 0.0]
    follow(model, x, arcs, points, pieces)
    np.testing.assert_array_equal(x[:11], before[:11])
    assert np.abs(x[11:] - before[11:]).min(axis=0).max() > 0.0
    lines = polyline(model, x, arcs, points, pieces)
    assert [len(line) for line in lines] == [11, 19]
    assert length_error(model, x, arcs, points, pieces) <= EXACT
    pieces = break_at(model, pieces, model.end)  # the last link goes, nothing is left beyond it
    np.testing.assert_allclose(pieces, LN + D * np.array([[0.0, 10.0], [11.0, 28.0]]))
    for nowhere in (LN + 10.4 * D, LN - 1.0, model.end + 1.0):
        with pytest.raises(ValueError, match="no thread at arc"):
            break_at(model, pieces, nowhere)


def test_a_thread_with_nothing_left_is_nowhere() -> None:
    model = ThreadModel(LN, D, 2)
    pieces = break_at(model, model.whole(), LN + 0.1)
    assert pieces.shape == (0, 2)
    distance, arc = closest(model, straight(model), np.empty(0), np.empty((0, 3)), pieces, np.zeros(3))
    assert distance == np.inf
    assert np.isnan(arc)


# ---- queries ----


def test_closest_point_agrees_with_dense_sampling() -> None:
    """Samples 1/200 link apart: the sampled distance exceeds the true one by at most half a spacing."""
    model = ThreadModel(LN, D, 40)
    x = wavy(model, 4)
    arcs, points = LN + D * np.array([3.3, 20.0, 31.4]), x[[3, 20, 31]] + _STEP
    pieces = break_at(model, model.whole(), LN + 35.5 * D)
    follow(model, x, arcs, points, pieces)
    lines = polyline(model, x, arcs, points, pieces)
    parts = np.linspace(0.0, 1.0, 201)[:, None]
    samples = np.concatenate([a + parts * (b - a) for q in lines for a, b in pairwise(q)])
    for query in np.random.default_rng(0).normal(0.0, 8.0, (50, 3)) + np.array([10.0, 0.0, 0.0]):
        distance, arc = closest(model, x, arcs, points, pieces, query)
        sampled = np.linalg.norm(samples - query, axis=1).min()
        assert distance <= sampled + 1e-12
        assert sampled <= distance + 0.5 * D / 200
        assert any(s0 <= arc <= s1 for s0, s1 in pieces)
    for arc, point in zip(arcs, points, strict=True):
        assert closest(model, x, arcs, points, pieces, point) == pytest.approx((0.0, arc), abs=1e-12)


def test_length_error_sees_a_bent_ruler_and_not_a_number() -> None:
    model = ThreadModel(LN, D, 10)
    none = np.empty(0), np.empty((0, 3)), model.whole()
    x = straight(model)
    x[9, 0] += 0.25 * D
    assert length_error(model, x, *none) == pytest.approx(0.25)
    x[4, 1] = np.nan
    assert not length_error(model, x, *none) <= 1.0


def test_bad_input_is_named() -> None:
    model = ThreadModel(LN, D, 10)
    with pytest.raises(ValueError, match="order of their arcs"):
        follow(model, straight(model), np.array([6.0, 5.0]), np.zeros((2, 3)), model.whole())
    with pytest.raises(ValueError, match="positions of shape"):
        follow(model, straight(model), np.array([5.0, 6.0]), np.zeros((3, 3)), model.whole())
    with pytest.raises(ValueError, match="finite"):
        follow(model, straight(model), np.array([np.nan]), np.zeros((1, 3)), model.whole())
    x = straight(model)
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="place is not finite"):
            follow(model, x, np.array([5.0]), np.array([[0.0, bad, 0.0]]), model.whole())
    assert np.array_equal(x, straight(model))
    with pytest.raises(ValueError, match=r"shape \(10, 3\)"):
        follow(model, np.zeros((9, 3)), np.array([5.0]), np.zeros((1, 3)), model.whole())
    for wrong in ((-1.0, D, 10), (LN, 0.0, 10), (LN, np.nan, 10), (LN, D, 1)):
        with pytest.raises(ValueError, match=r"thread|needle"):
            ThreadModel(*wrong)


_SMALL_CASE = """
import numpy as np
from trainer.mechanics.thread import ThreadModel, closest, follow, length_error, slide
model = ThreadModel(4.0, 0.5, 20)
x = np.zeros((20, 3)); x[:, 0] = 0.5 * np.arange(20)
arcs, hard = np.array([4.0, 6.1, 6.3, 11.2]), np.array([True, False, False, False])
for t in range(30):
    points = np.array([[0.1 * t, 0, 0], [2, 0.3 * np.sin(t), 0], [2.1, 0.3 * np.sin(t), 0.05], [5, 0, 0.1 * t]])
    arcs = slide(model, arcs, points, hard, model.whole()).arc
    follow(model, x, arcs, points, model.whole())
print(*x.ravel(), *arcs, *closest(model, x, arcs, points, model.whole(), np.ones(3)))
"""


def test_the_kernels_mean_the_same_as_plain_python() -> None:
    """The same sums in the same order; 1e-10 allows another libm for sine and cosine (1e-16) in 30 ticks."""
    numbers = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        done = subprocess.run(
            [sys.executable, "-c", _SMALL_CASE], env=environment, capture_output=True, text=True, check=True
        )
        numbers.append(np.array(done.stdout.split(), dtype=np.float64))
    assert np.isfinite(numbers[0]).all()
    np.testing.assert_allclose(numbers[0], numbers[1], rtol=0.0, atol=1e-10)
