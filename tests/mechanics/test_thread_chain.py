"""The bare chain against closed forms, other unknowns and conservation laws; what it refuses; that it repeats."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from allocations import kept_bytes
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import j0, jn_zeros

from trainer.geometry import Array
from trainer.mechanics.thread_chain import ChainState, ChainTaut, begin_chain, step_chain
from trainer.mechanics.thread_rod import RodModel, holds

G = 9810.0
MASS = 1e-6  # kg/mm


def chain(links: int, length: float = 100.0, drag: float = 0.0, weight: float = G) -> RodModel:
    return RodModel(links + 1, length / links, MASS, 0.0, 1e9, drag, (0.0, 0.0, -weight))


def straight(model: RodModel, axis: int = 0) -> Array:
    x = np.zeros((model.count, 3))
    x[:, axis] = model.link * np.arange(model.count)
    return x


def hanging(model: RodModel, links: int, span: float = 0.0) -> Array:
    """A V of so many links with its ends ``span`` mm apart (0: a right angle), what is left goes straight on."""
    across = 0.5 * span / (0.5 * links * model.link) if span > 0.0 else math.sqrt(0.5)
    i = np.arange(model.count)
    down = math.sqrt(1.0 - across**2) * np.where(i < links, np.minimum(i, links - i), 0)
    along = across * np.minimum(i, links) + np.maximum(i - links, 0)
    return model.link * np.stack([along, 0.0 * i, -down], axis=1)


def energy(model: RodModel, state: ChainState) -> float:
    """mN mm, kinetic and of height."""
    mass = model.mass * model.node_lengths()
    return float(np.sum(mass * (0.5 * np.sum(state.v**2, axis=1) + G * state.x[:, 2])))


def length_error(model: RodModel, state: ChainState) -> float:
    return float(np.max(np.abs(np.linalg.norm(np.diff(state.x, axis=0), axis=1) / model.link - 1.0)))


def test_energy_is_kept_with_the_order_of_the_method() -> None:
    """In a vacuum energy is constant; a method of order 8 loses at least 2⁸ less of it a second at half the step.

    One substep a tick (a tolerance that refuses none, ticks below the bound of the fastest wave). The next order's
    share of the error may show in the ratio: 2⁷ is asked for.
    """
    model = chain(4)
    lost = []
    for tick in (8e-3, 4e-3):
        state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
        before, worst = energy(model, state), 0.0
        for _ in range(round(0.16 / tick)):
            step_chain(model, state, held, tick, 1e3)
            assert state.numbers[1] == 1.0
            worst = max(worst, abs(energy(model, state) - before))
        lost.append(worst)
    assert lost[1] > 1e-13 * model.mass * model.length**2 * G, "an error that is all rounding has no order"
    assert lost[0] / lost[1] >= 2.0**7


def test_energy_is_kept_through_the_crack_of_the_whip() -> None:
    """Each of some 1000 substeps errs by 1e-6 L at most in places; of m g L that is 1e-3 if all went one way."""
    model = chain(50)
    state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    for _ in range(100):
        step_chain(model, state, held, 0.01)
        assert abs(energy(model, state)) <= 1e-3 * model.mass * model.length * G * model.length
        assert length_error(model, state) <= 1e-9


def test_a_hanging_chain_swings_at_the_first_zero_of_the_bessel_function() -> None:
    """Small transverse motion of a hanging chain is J0(2 w sqrt(z / g)) cos(w t) with 2 w sqrt(L / g) = j01.

    The tip, let go at rest in this mode, crosses the vertical at pi / 2 w. Of 50 links the end masses count half, so
    that the discrete frequency is off by O(1 / n²) = 4e-4: 1e-3 is asked for.
    """
    model = chain(50)
    w = float(jn_zeros(0, 1)[0]) / 2.0 * np.sqrt(G / model.length)
    above = model.length - model.link * np.arange(model.count)
    side = 0.01 * j0(2.0 * w * np.sqrt(above / G))
    side[0] = 0.0
    steps = np.diff(side)
    down = np.concatenate([[0.0], np.cumsum(np.sqrt(model.link**2 - steps**2))])
    state = begin_chain(model, np.stack([side, 0.0 * side, -down], axis=1))
    held = holds(model, [0], [[0, 0, 0]])
    t, before = 0.0, float(state.x[-1, 0])
    while True:
        step_chain(model, state, held, 1e-3)
        t += 1e-3
        now = float(state.x[-1, 0])
        if now <= 0.0:
            break
        before = now
    assert t - 1e-3 * now / (now - before) == pytest.approx(np.pi / (2.0 * w), rel=1e-3)


def test_two_links_are_a_double_pendulum() -> None:
    """Lagrange's equations in the angles a, b from the downward vertical, masses m and m / 2 at distances d:

    1.5 a'' + 0.5 b'' cos(a - b) + 0.5 b'² sin(a - b) + 1.5 (g / d) sin a = 0,
    a'' cos(a - b) + b'' - a'² sin(a - b) + (g / d) sin b = 0.
    Both programs are asked for 1e-9 of the length a step; over 0.5 s the motion, not yet chaotic, makes less than 1e3
    of it.
    """
    model = chain(2)
    state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    for _ in range(50):
        step_chain(model, state, held, 0.01, 1e-9 * model.length)

    def rates(_: float, y: Array) -> list[float]:
        a, b, p, q = y
        c, s, f = math.cos(a - b), math.sin(a - b), G / model.link
        p1, q1 = np.linalg.solve(
            [[1.5, 0.5 * c], [c, 1.0]], [-0.5 * q * q * s - 1.5 * f * math.sin(a), p * p * s - f * math.sin(b)]
        )
        return [p, q, float(p1), float(q1)]

    a, b = solve_ivp(rates, (0.0, 0.5), [np.pi / 2, np.pi / 2, 0, 0], "DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    first = model.link * np.array([np.sin(a), 0.0, -np.cos(a)])
    second = first + model.link * np.array([np.sin(b), 0.0, -np.cos(b)])
    assert np.max(np.abs(state.x[1:] - [first, second])) <= 1e-6 * model.length


def test_in_air_it_comes_to_rest_as_a_catenary() -> None:
    """z = a (cosh(x / a) - 1) with 2 a sinh(S / 2 a) = L; the holds bear half the weight each and rho g a across.

    Drag of 20 / s takes the slowest mode (some 20 / s) down by exp(-10 t): 2 s leave 1e-8. A chain of n links is a
    catenary to O(1 / n²): 1e-3 of the span is asked for.
    """
    model, span = chain(50, drag=20.0 * MASS), 60.0
    state, held = begin_chain(model, hanging(model, 50, span)), holds(model, [0, 50], [[0, 0, 0], [span, 0, 0]])
    for _ in range(200):
        step_chain(model, state, held, 0.01)
        assert length_error(model, state) <= 1e-9
    a = brentq(lambda a: 2.0 * a * np.sinh(span / (2.0 * a)) - model.length, 5.0, 100.0, xtol=1e-12)
    expected = a * (np.cosh((state.x[:, 0] - span / 2) / a) - np.cosh(span / 2 / a))
    assert np.max(np.abs(state.x[:, 2] - expected)) <= 1e-3 * span
    assert held.bears[1, 0] == pytest.approx(MASS * G * a, rel=1e-3)
    assert held.bears[:, 2] == pytest.approx(0.5 * MASS * G * model.length, rel=1e-5)
    assert np.max(np.abs(state.v)) <= 1e-3


def test_a_turning_chain_is_drawn_to_its_middle() -> None:
    """Without weight a straight chain that turns at w stays straight; its hold bears w² times the sum of m r."""
    model, w = chain(30, weight=0.0), 20.0
    x = straight(model)
    state, held = (
        begin_chain(model, x, np.stack([0 * x[:, 0], w * x[:, 0], 0 * x[:, 0]], axis=1)),
        holds(model, [0], [[0, 0, 0]]),
    )
    for _ in range(20):
        step_chain(model, state, held, 0.01, 1e-9)
    direction = np.array([math.cos(w * 0.2), math.sin(w * 0.2), 0.0])
    pull = w * w * np.sum(model.mass * model.node_lengths() * x[:, 0])
    assert np.max(np.abs(state.x - np.outer(x[:, 0], direction))) <= 1e-6 * model.length
    assert np.max(np.abs(held.bears[0] + pull * direction)) <= 1e-6 * pull
    assert state.tension[1] == pytest.approx(pull, rel=1e-6)


def test_what_the_holds_bear_is_what_momentum_asks_for() -> None:
    """dP/dt = weight + air + holds, while one hold moves, another in the middle stays, and the chain swings.

    dP/dt by central differences over ticks of h = 0.2 ms. The moving hold's acceleration, like cos(100 t), is made
    up of pieces that do not meet: they are apart by its growth in a tick, 100 h = 2 % of it, half of which shows in a
    difference over two ticks. h² P''' / 6 is (500 / s)² h² / 6 = 2e-3 of P'. 1e-2 of the forces is asked for.
    """
    model = chain(20, drag=2.0 * MASS)
    x = hanging(model, 10)
    state, held = begin_chain(model, x), holds(model, [0, 10], x[[0, 10]])
    mass, momenta, forces = model.mass * model.node_lengths(), [], []
    for k in range(200):
        held.target[0] = [0.5 * (1.0 - math.cos(0.02 * (k + 1))), 0.0, 0.0]
        step_chain(model, state, held, 2e-4, 1e-7)
        momenta.append(mass @ state.v)
        weight = np.array([0.0, 0.0, -G * mass.sum()])
        forces.append(held.bears.sum(axis=0) + weight - 2.0 * momenta[-1])
    rate = (np.array(momenta[2:]) - np.array(momenta[:-2])) / 4e-4
    assert np.max(np.abs(rate)) > 0.1
    assert np.max(np.abs(rate - np.array(forces)[1:-1])[5:]) <= 1e-2 * np.max(np.abs(forces))


def test_ends_drawn_apart_are_refused_at_the_limit_and_leave_the_chain_alone() -> None:
    """The pull grows without a leap as 10 mm/s draw the chain straight; at the limit one line says so."""
    model = chain(50)
    x = hanging(model, 50)
    held = holds(model, [0, 50], x[[0, 50]], 50.0)
    state = begin_chain(model, x)
    furthest, refusal = 0.0, ""
    while not refusal:
        before = state.x.copy()
        held.target[1, 0] += 0.1
        try:
            step_chain(model, state, held, 0.01)
        except ChainTaut as error:
            refusal = str(error)
        else:
            assert np.linalg.norm(held.bears, axis=1).max() <= 50.0
        furthest = max(furthest, float(np.max(np.abs(state.x - before))))
    assert refusal.endswith("mN, of which 50 can be held")
    assert np.array_equal(before, state.x)
    assert held.target[1, 0] < model.length
    assert furthest <= 20.0
    held.target[1, 0] = 1.01 * model.length
    with pytest.raises(ChainTaut, match="cannot be 101 mm apart"):
        step_chain(model, state, held, 0.01)
    assert np.array_equal(before, state.x)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_target_that_is_no_number_is_refused_and_moves_nothing(bad: float) -> None:
    model = chain(10)
    state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    held.target[0, 1] = bad
    with pytest.raises(ValueError, match="not finite"):
        step_chain(model, state, held, 0.01)
    assert np.array_equal(state.x, straight(model))


def test_what_is_no_chain_is_refused() -> None:
    model = chain(10)
    with pytest.raises(ValueError, match="does not bend"):
        begin_chain(RodModel(11, 1.0, 1e-6, 1.0, 1e9), straight(model))
    with pytest.raises(ValueError, match="links must be 10"):
        begin_chain(model, 1.1 * straight(model))
    with pytest.raises(ValueError, match="shape"):
        begin_chain(model, np.zeros((3, 3)))
    state = begin_chain(model, straight(model))
    with pytest.raises(ValueError, match="neighbours"):
        step_chain(model, state, holds(model, [3, 4], straight(model)[3:5]), 0.01)
    for tick, tolerance in ((0.0, 1.0), (math.nan, 1.0), (0.01, 0.0), (0.01, math.inf)):
        with pytest.raises(ValueError, match="cannot"):
            step_chain(model, state, holds(model, [0], [[0, 0, 0]]), tick, tolerance)


def led(links: int, ticks: int) -> Array:
    """Places (n, 3) after a held end has been led along an arc."""
    model = chain(links)
    state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    for k in range(1, ticks + 1):
        held.target[0] = [5.0 * math.sin(0.1 * k), 5.0 - 5.0 * math.cos(0.1 * k), 0.0]
        step_chain(model, state, held, 0.01)
    return state.x


def test_the_same_again_bit_for_bit() -> None:
    assert np.array_equal(led(100, 30), led(100, 30))


def test_a_tick_allocates_no_array() -> None:
    """A tick's peak of memory is below that of one more row (n,) of 8 kB; numba fills once what it keeps for calls."""
    model = chain(1000)
    state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    _, peak = kept_bytes(lambda: step_chain(model, state, held, 1e-4))
    assert peak < 8 * model.count


def test_compiled_and_plain_python_agree() -> None:
    """The same sums in the same order; fused multiply-adds may differ in the last bits, which 5 ticks let grow."""
    code = "from test_thread_chain import led; print(led(6, 5).tobytes().hex())"
    here = Path(__file__).parent
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{here}{os.pathsep}{here.parents[1]}"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    plain = np.frombuffer(bytes.fromhex(done.stdout.strip())).reshape(-1, 3)
    assert np.max(np.abs(plain - led(6, 5))) <= 1e-9
