"""The dynamic rod against closed forms and conservation laws; what it must refuse; that it repeats itself."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import j0, jn_zeros

from trainer.geometry import Array
from trainer.mechanics.thread_rod import (
    RodModel,
    RodStalled,
    RodState,
    begin,
    holds,
    monofilament,
    settle,
    step,
)

G = 9810.0
STILL = (0.0, 0.0, 0.0)


def straight(model: RodModel, axis: int = 0) -> Array:
    x = np.zeros((model.count, 3))
    x[:, axis] = model.link * np.arange(model.count)
    return x


def suture(links: int = 50, length: float = 100.0) -> RodModel:
    """A nylon thread as thin as 10-0; the numbers only need to be of its kind here."""
    return monofilament(0.022, 1.14e-6, 2.5e6, length, links + 1)


def bare(links: int, length: float = 100.0, axial: float = 1e8) -> RodModel:
    """A chain without stiffness in a vacuum, 1 mg/mm."""
    return RodModel(links + 1, length / links, 1e-6, 0.0, axial)


def length_error(model: RodModel, x: Array) -> float:
    return float(np.max(np.abs(np.linalg.norm(np.diff(x, axis=0), axis=1) / model.link - 1.0)))


def test_a_hanging_thread_is_a_catenary() -> None:
    """z = a (cosh(x / a) - 1) with 2 a sinh(S / 2 a) = L, horizontal tension rho g a.

    A chain of n links is a catenary to O(1 / n²) of the span: with n = 100 a node is off by about 1e-4 S, and the
    tension by as much; 1e-3 is asked for.
    """
    model, span = bare(100), 60.0
    x = straight(model)
    x[:, 2] = -20.0 * np.sin(np.linspace(0.0, np.pi, model.count))
    state = begin(model, x)
    held = holds(model, [0, 100], [[0, 0, 0], [span, 0, 0]])
    settled = settle(state, held)
    a = brentq(lambda a: 2.0 * a * np.sinh(span / (2.0 * a)) - model.length, 5.0, 100.0, xtol=1e-12)
    expected = a * (np.cosh((state.x[:, 0] - span / 2) / a) - np.cosh(span / 2 / a))
    assert np.max(np.abs(state.x[:, 2] - expected)) <= 1e-3 * span
    assert abs(held.bears[1, 0]) == pytest.approx(1e-6 * G * a, rel=1e-3)
    assert held.bears[:, 2].sum() == pytest.approx(1e-6 * G * model.length, rel=1e-6)
    assert settled.residual <= 1e-12


def test_a_hanging_chain_swings_at_the_first_zero_of_the_bessel_function() -> None:
    """Small transverse motion of a hanging chain is J0(2 w sqrt(z / g)) cos(w t) with 2 w sqrt(L / g) = j01.

    The tip, let go at rest in this mode, crosses the vertical at pi / 2 w. Of 50 links the end masses count half, so
    the discrete frequency is off by O(1 / n²) = 4e-4; BDF2's by (w h)² / 3 = 5e-5 at 1 ms: 1e-3 is asked for.
    """
    model = bare(50)
    w = float(jn_zeros(0, 1)[0]) / 2.0 * np.sqrt(G / model.length)
    x = straight(model, 2) * -1.0
    above = model.length + x[:, 2]  # from the free end
    x[:, 0] = 0.01 * j0(2.0 * w * np.sqrt(np.maximum(above, 0.0) / G))
    x[0, 0] = 0.0
    state = begin(model, x)
    held = holds(model, [0], [[0, 0, 0]])
    t, before = 0.0, float(state.x[-1, 0])
    while True:
        step(state, held, 1e-3)
        t += 1e-3
        now = float(state.x[-1, 0])
        if now <= 0.0:
            break
        before = now
    crossed = t - 1e-3 * now / (now - before)
    assert crossed == pytest.approx(np.pi / (2.0 * w), rel=1e-3)


def test_a_cantilever_under_its_weight_is_the_elastica() -> None:
    """EI theta'' = rho g (S - s) cos(theta), theta from the horizontal; theta(0) = 0 at the clamp, theta'(S) = 0.

    The first link's direction is held, and a link's direction is the curve's at its middle: the clamp is at d / 2. The
    chain then converges as d²: 100 links are within 1e-3 of the length.
    """
    model = suture(100, 40.0)
    state = begin(model, straight(model))
    settle(state, holds(model, [0, 1], straight(model)[:2]))
    free = model.length - 0.5 * model.link
    load = model.mass * G / model.bending

    def slope(s: Array, y: Array) -> Array:
        return np.array([y[1], load * (free - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    def ends(at: Array, to: Array) -> Array:
        return np.array([at[0], to[1], at[2] - 0.5 * model.link, at[3]])

    s = np.linspace(0.0, free, 50)
    solved = solve_bvp(slope, ends, s, np.array([-s / free, -1.0 / free + 0 * s, s, -s]), tol=1e-8)
    assert solved.success
    assert -0.8 * model.length < solved.y[3, -1] < -0.2 * model.length, "a case that bends much"
    expected = solved.sol(np.arange(1, model.count) * model.link - 0.5 * model.link)[2:].T
    assert np.max(np.linalg.norm(state.x[1:, [0, 2]] - expected, axis=1)) <= 1e-3 * model.length


def coil(turned: float) -> tuple[RodModel, Array]:
    """A ring's arc of 60 links whose rest curvature is ``turned`` of its own."""
    links, radius, link = 60, 5.0, 0.4
    half = np.arcsin(link / (2.0 * radius))
    curvature = np.zeros((links + 1, 2))
    curvature[:, 0] = turned * 2.0 * np.sin(half) / link
    angle = 2.0 * half * np.arange(links + 1)
    x = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    return RodModel(links + 1, link, 4.3e-10, 0.03, 950.0, 5e-8, STILL, curvature), x


def test_a_free_coil_stays_a_coil() -> None:
    """At its rest curvature a rod bears no force: second differences equal those at rest to rounding."""
    model, x = coil(1.0)
    state = begin(model, x)
    for _ in range(20):
        step(state, holds(model, [], np.zeros((0, 3))), 0.01)
    assert np.max(np.abs(state.x - x)) <= 1e-9
    assert np.max(np.abs(state.tension)) <= 1e-9


def test_a_straightened_coil_curls_up_to_its_own_radius() -> None:
    """Without load the minimum of the bending energy is zero: every second difference has the rest curvature's size."""
    model, _ = coil(1.0)
    state = begin(model, straight(model), frame=[0, 1, 0])
    settle(state, holds(model, [0, 1], straight(model)[:2]))
    bend = np.linalg.norm(np.diff(state.x, 2, axis=0), axis=1) / model.link**2
    assert bend == pytest.approx(np.full(model.count - 2, float(model.curvature[0, 0])), rel=1e-6)  # type: ignore[index]


def test_turning_a_coil_turns_its_motion() -> None:
    """No direction of space is special without gravity: a turned start gives the turned motion.

    To what Newton's method leaves of a curved rod, where it converges linearly: some of 1e-5 links, 4e-6 mm, a step.
    """
    model, x = coil(0.7)
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    ends = []
    for r in (np.eye(3), turn):
        state = begin(model, x @ r.T)
        for _ in range(10):
            step(state, holds(model, [0], (x @ r.T)[:1]), 0.005)
        ends.append(state.x @ r)
    assert np.max(np.abs(ends[0] - x)) > 0.1
    assert np.max(np.abs(ends[0] - ends[1])) <= 2e-5


def energy(model: RodModel, state: RodState) -> float:
    mass = model.mass * model.node_lengths()
    return float(0.5 * mass @ np.sum(state.v**2, axis=1) + G * mass @ state.x[:, 2])


def test_energy_is_lost_only_to_the_step() -> None:
    """A swing in vacuum keeps its energy; BDF2 loses O(h²) of it and gains none: half the step, a quarter of the loss.

    Before the end whips round (0.15 s of a 100 mm chain) all scales are resolved. The ratio lies between 3 and 5.
    """
    model = bare(20)
    lost = []
    for h in (1e-3, 5e-4, 2.5e-4):
        state = begin(model, straight(model))
        held = holds(model, [0], [[0, 0, 0]])
        for _ in range(round(0.1 / h)):
            step(state, held, h)
        lost.append(-energy(model, state))
    moved = model.mass * G * model.length**2 / 4
    assert 0.0 < lost[2] < lost[1] < lost[0] < 1e-2 * moved
    assert 3.0 < (lost[0] - lost[1]) / (lost[1] - lost[2]) < 5.0


def test_the_error_falls_with_the_square_of_the_step() -> None:
    """Order 2: against steps of 1/8 the distances at h and h/2 stand as (1 - 1/64) : (1/4 - 1/64) = 4.2."""
    model = suture(30)

    def swing(h: float) -> Array:
        state = begin(model, straight(model))
        for _ in range(round(0.4 / h)):
            step(state, holds(model, [0], [[0, 0, 0]]), h)
        return state.x.copy()

    finest = swing(1.25e-3)
    coarse, fine = (float(np.max(np.abs(swing(h) - finest))) for h in (1e-2, 5e-3))
    assert coarse / fine == pytest.approx(4.2, rel=0.1)


def test_a_tolerance_is_kept_by_shorter_steps() -> None:
    """What the estimate allows in a substep is what the sum of the substeps stays within, here over 0.2 s."""
    model = bare(30)
    ends, substeps = [], []
    for tolerance in (1.0, 1e-2, 1e-4):
        state = begin(model, straight(model))
        for _ in range(10):
            step(state, holds(model, [0], [[0, 0, 0]]), 0.01, tolerance)
            substeps.append(state.outcome[0])
        ends.append(state.x.copy())
    assert sum(substeps[:10]) < sum(substeps[10:20]) < sum(substeps[20:])
    first, second = (float(np.max(np.abs(end - ends[2]))) for end in ends[:2])
    assert second < 0.2 * first
    assert second < 1.0


def test_in_air_a_thread_falls_at_the_speed_where_drag_bears_its_weight() -> None:
    """m v' = m g - c v: v = (m g / c)(1 - exp(-c t / m)); after 10 m / c it is terminal to 5e-5."""
    model = suture(10)
    state = begin(model, straight(model))
    time = 10.0 * model.mass / model.drag
    for _ in range(100):
        step(state, holds(model, [], np.zeros((0, 3))), time / 100)
    assert state.v[:, 2] == pytest.approx(np.full(11, -model.mass * G / model.drag), rel=1e-3)


@pytest.mark.parametrize("links", [50, 200])
def test_lengths_hold_throughout(links: int) -> None:
    """A link is as long as T / EA makes it, whatever happens; without stretch, within 1e-6."""
    model = RodModel(links + 1, 100.0 / links, 4.3e-10, 0.03, 1e6, 5e-8)
    state = begin(model, straight(model))
    held = holds(model, [0], [[0, 0, 0]])
    for k in range(40):
        held.target[0] = [5.0 * np.sin(0.5 * k), 5.0 * np.cos(0.5 * k) - 5.0, 0.3 * k]
        step(state, held, 0.01)
        assert length_error(model, state.x) <= 1e-6


def test_pulled_apart_beyond_its_length_it_answers_with_its_tension_up_to_the_limit() -> None:
    """Ends at distance D > L: T = EA (D / L - 1) everywhere, but for the weight (4e-4 mN), until a hold gives way."""
    model = suture()
    state = begin(model, straight(model))
    held = holds(model, [0, 50], straight(model)[[0, 50]], [300.0, 150.0])
    tensions = []
    for k in range(1, 41):
        held.target[1, 0] = 100.0 + k
        step(state, held, 0.01)
        expected = min(model.axial * k / 100.0, 150.0)
        assert state.tension[1:] == pytest.approx(np.full(50, expected), rel=2e-3, abs=2e-3)
        assert held.slips.tolist() == [False, model.axial * k / 100.0 > 150.0]
        assert np.linalg.norm(held.bears[1]) <= 150.0 * 1.001
        assert state.x.min() >= -0.1
        assert state.x.max() <= 100.0 * (1.0 + 150.0 / model.axial) + 0.5
        tensions.append(float(state.tension[25]))
    assert (np.diff(tensions[:15]) > 0.0).all()
    for k in reversed(range(-10, 40)):
        held.target[1, 0] = 100.0 + k
        step(state, held, 0.01)
    assert not held.slips.any()
    assert state.x[50] == pytest.approx([90.0, 0.0, 0.0])


def test_equilibrium_beyond_its_length_is_bounded_by_the_weaker_hold() -> None:
    """At rest one tension runs through a straight thread: that of the hold that slips, to the weight's 4e-4 mN."""
    model = suture()
    state = begin(model, straight(model))
    held = holds(model, [0, 50], [[0, 0, 0], [150, 0, 0]], [200.0, 100.0])
    settle(state, held)
    assert state.tension[1:] == pytest.approx(np.full(50, 100.0), abs=1e-3)
    assert held.slips.tolist() == [False, True]
    assert state.x[50, 0] == pytest.approx(100.0 * (1.0 + 100.0 / model.axial), abs=1e-3)


def test_motion_comes_to_rest_where_the_equilibrium_is() -> None:
    """Air takes the motion's energy: after 4 s, 500 of its time constants m / c = 8 ms, the two differ by rounding.

    The slowest motion is the loop's sag: c L / (m g) = 1.3 s over some (2 pi)²; 4 s leave nothing of 50 mm.
    """
    model = suture()
    held = holds(model, [0, 50], [[0, 0, 0], [40, 0, 0]])
    rest, moving = begin(model, straight(model)), begin(model, straight(model))
    settle(rest, held)
    settle(moving, held)
    held.target[1, 0] = 60.0
    settle(rest, held)
    for _ in range(200):
        step(moving, held, 0.02)
    assert np.max(np.abs(rest.x - moving.x)) <= 5e-3


@pytest.mark.parametrize("shape", ["a point", "a line too short", "a line too long", "folded"])
def test_a_bad_start_is_put_right(shape: str) -> None:
    """Links get their length along what direction they have; the ends come to their holds, and nothing is lost."""
    model = suture(20, 20.0)
    x = straight(model)
    if shape == "a point":
        x[:] = 0.0
    elif shape == "a line too short":
        x *= 0.3
    elif shape == "a line too long":
        x *= 3.0
    else:
        x[:, 0] = model.link * (np.arange(model.count) % 2)
    state = begin(model, x)
    held = holds(model, [0, 20], [[0, 0, 0], [12, 0, 0]])
    for _ in range(30):
        step(state, held, 0.01)
    assert np.isfinite(state.x).all()
    assert length_error(model, state.x) <= np.max(np.abs(state.tension)) / model.axial + 1e-9
    assert state.x[[0, 20]] == pytest.approx(held.target)


@pytest.mark.parametrize("tick", [1e-3, 5e-2])
def test_a_thousand_links_are_stable(tick: float) -> None:
    """A jerk of 20 mm in one tick, then rest: finite, of its length, within reach of its hold, and slowing down."""
    model = suture(1000)
    state = begin(model, straight(model))
    held = holds(model, [0], [[0, 0, 0]])
    for _ in range(5):
        step(state, held, tick)
    held.target[0] = [12.0, 16.0, 0.0]
    for _ in range(10):
        step(state, held, tick)
    assert np.max(np.linalg.norm(state.x - held.target[0], axis=1)) <= model.length * (1.0 + 1e-5)
    assert length_error(model, state.x) <= 1e-5
    assert np.max(np.abs(state.v)) < 100.0 / tick


def test_what_is_not_a_number_is_refused() -> None:
    model = suture()
    x = straight(model)
    state, held = begin(model, x), holds(model, [0], [[0, 0, 0]])
    for bad in (np.nan, np.inf):
        broken = x.copy()
        broken[3, 1] = bad
        with pytest.raises(ValueError, match="not finite"):
            begin(model, broken)
        with pytest.raises(ValueError, match="not finite"):
            holds(model, [0], [[0, bad, 0]])
        held.target[0, 0] = bad
        with pytest.raises(ValueError, match="not finite"):
            step(state, held, 0.01)
        with pytest.raises(ValueError, match="not finite"):
            settle(state, held)
        with pytest.raises(ValueError, match="tick"):
            step(state, holds(model, [0], [[0, 0, 0]]), bad)
        with pytest.raises(ValueError, match="bending"):
            RodModel(10, 1.0, 1e-6, bad, 1.0)
    assert np.array_equal(state.x, x), "a refused step changes nothing"
    for nodes in ([0, 0], [51], [-1]):
        with pytest.raises(ValueError, match="held nodes"):
            holds(model, nodes, np.zeros((len(nodes), 3)))
    with pytest.raises(ValueError, match="limit"):
        holds(model, [0], [[0, 0, 0]], -1.0)
    with pytest.raises(ValueError, match="bend"):
        RodModel(2, 1.0, 1e-6, 0.0, 1.0)


def test_a_rod_that_nothing_holds_has_no_equilibrium() -> None:
    model = suture(10)
    with pytest.raises(RodStalled):
        settle(begin(model, straight(model)), holds(model, [], np.zeros((0, 3))))


def drag_along(links: int, ticks: int) -> Array:
    model = suture(links)
    state = begin(model, straight(model))
    held = holds(model, [0], [[0, 0, 0]])
    for k in range(ticks):
        held.target[0, 1] += 0.4 * np.sin(k)
        step(state, held, 0.01, 0.01)
    return state.x


def test_the_same_again_bit_for_bit() -> None:
    assert np.array_equal(drag_along(100, 20), drag_along(100, 20))


def test_a_step_leaves_nothing_behind() -> None:
    """Numba fills once what it keeps for the calls' arguments (34 kB, at some tick or other); a step adds nothing.

    One array of the 20 nodes a tick would be 300 x 480 bytes in each of three stretches of 300 ticks, what is filled
    once is in one of them: the least counts, and a tenth of that array is left to the interpreter.
    """
    model = suture(20)
    state = begin(model, straight(model))
    held = holds(model, [0], [[0, 0, 0]])
    tracemalloc.start()
    memory = []
    for k in range(1201):
        step(state, held, 0.01, 0.01)
        if k in (300, 600, 900, 1200):
            gc.collect()
            memory.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert np.min(np.diff(memory)) < 14_400


def test_compiled_and_plain_python_agree() -> None:
    """The same sums in the same order; fused multiply-adds may differ in the last bits, which 5 ticks let grow."""
    code = "from test_thread_rod import drag_along; print(drag_along(6, 5).tobytes().hex())"
    here = Path(__file__).parent
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{here}{os.pathsep}{here.parents[1]}"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    plain = np.frombuffer(bytes.fromhex(done.stdout.strip())).reshape(-1, 3)
    assert np.max(np.abs(plain - drag_along(6, 5))) <= 1e-9
