"""Hard cases of the thread for the report on stability: each breaks a law loudly or says what it measured."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from trainer.bench.thread import bare, forceps, straight, suture
from trainer.geometry import Array
from trainer.mechanics.thread_chain import ChainTaut, begin_chain, step_chain
from trainer.mechanics.thread_contact import clear, touch_itself, touch_triangles
from trainer.mechanics.thread_rod import RodModel, RodStalled, RodState, begin, holds, no_contacts, settle, step

TICK_S = 0.01
METHOD, CHAIN = "rod", "chain"


def _stretch(model: RodModel, state: RodState) -> float:
    """The largest relative error of a length, beyond what the link's own tension makes of it."""
    sizes = np.linalg.norm(np.diff(state.x, axis=0), axis=1)
    return float(np.max(np.abs(sizes / model.link - 1.0 - state.tension[1:] / model.axial)))


def _sound(model: RodModel, state: RodState) -> float:
    error = _stretch(model, state)
    assert np.isfinite(state.x).all(), "a place is not finite"
    assert error <= 1e-6, f"a link's length is off by {error:.1e}"
    return error


def over_taut() -> str:
    """Ends drawn apart to 1.5 lengths: the tension grows to the hold's limit and stays; the nodes stay between."""
    model = suture(200)
    state = begin(model, straight(model))
    held = holds(model, [0, 200], straight(model)[[0, 200]], 150.0)
    last, furthest = 0.0, 0.0
    for k in range(1, 501):
        held.target[1, 0] = 100.0 + 0.1 * k
        before = state.x.copy()
        step(state, held, TICK_S)
        _sound(model, state)
        tension = float(state.tension.max())
        assert tension >= last - 0.2, "the tension fell"
        assert tension <= 150.0 * 1.002, "the tension is above the limit"
        last, furthest = tension, max(furthest, float(np.max(np.abs(state.x - before))))
    assert furthest <= 1.0, f"a leap of {furthest:.1f} mm"
    return f"ok: {last:.1f} mN at a limit of 150 mN, no node moved more than {furthest:.2f} mm a tick"


def jump() -> str:
    """The held end leaps 20 mm in one tick."""
    worst = 0.0
    for links in (50, 200, 1000):
        model = suture(links)
        state = begin(model, straight(model))
        held = holds(model, [0], [[0, 0, 0]])
        for k in range(30):
            if k == 10:
                held.target[0] = [12.0, 16.0, 0.0]
            step(state, held, TICK_S)
            worst = max(worst, _sound(model, state))
            assert np.max(np.linalg.norm(state.x - held.target[0], axis=1)) <= model.length * 1.0001
    return f"ok: 50, 200 and 1000 links, lengths to {worst:.0e}"


def heap() -> str:
    """1000 links fall in a coil on a floor, touching it and one another."""
    links, radius = 1000, 0.1
    model = RodModel(links + 1, 0.5, 1e-8, 1e-3, 1e4, 1e-7)
    turns = np.arange(links + 1) * 0.1
    x = np.stack([5.0 * np.cos(turns), 5.0 * np.sin(turns), 1.0 + 0.3 * turns / (2.0 * math.pi)], axis=1)
    state = begin(model, x)
    floor = np.array([[-100.0, -100.0, 0.0], [100.0, -100.0, 0.0], [0.0, 150.0, 0.0]])
    one = np.array([[0, 1, 2]], dtype=np.int32)
    down = np.stack([np.arange(links), np.zeros(links, dtype=int)], axis=1).astype(np.int32)
    contacts, nothing = no_contacts(20_000), holds(model, [], np.zeros((0, 3)))
    worst, most = 0.0, 0
    for _ in range(10):
        middle = 0.5 * (state.x[1:] + state.x[:-1])
        near = np.sum((middle[:, None] - middle[None]) ** 2, axis=2) < 1.5**2
        i, j = np.nonzero(np.triu(near, 3))
        clear(contacts)
        touch_triangles(contacts, state.x, radius, floor, floor, one, down, 0.3, 1.0)
        touch_itself(contacts, state.x, radius, np.stack([i, j], axis=1).astype(np.int32), 0.3, 0.1)
        most = max(most, int(contacts.used[0]))
        stalled = ""
        try:
            step(state, nothing, 2e-3, 0.0, contacts)
        except RodStalled as error:  # said, and the rod is where it was: a thousand contacts are at the edge of it
            stalled = str(error)
        worst = max(worst, _sound(model, state))
        assert state.x[:, 2].min() > 0.0, "a node is below the floor"
        if stalled:
            return f"not converged: {stalled} ({most} contacts)"
    return (
        f"ok: up to {most} contacts, lowest node {state.x[:, 2].min():.2f} mm above the floor, lengths to {worst:.0e}"
    )


def stiffness() -> str:
    """Bending stiffness of a suture times 0, 1e-3, 1e3, 1e6: a swing and a rest."""
    worst = 0.0
    for factor in (0.0, 1e-3, 1e3, 1e6):
        nylon = suture(100)
        model = RodModel(101, 1.0, nylon.mass, factor * nylon.bending, 1e6, nylon.drag)
        state = begin(model, straight(model))
        held = holds(model, [0, 1], straight(model)[:2])
        for _ in range(50):
            step(state, held, TICK_S)
            worst = max(worst, _sound(model, state))
        settle(state, held)
        worst = max(worst, _sound(model, state))
        assert state.x[:, 2].max() <= 1e-6, "a node rests above the clamp"
    return f"ok: EI from 0 to 1e6 of nylon's, lengths to {worst:.0e}"


def ticks() -> str:
    """The same swing in ticks of 1 ms and of 50 ms."""
    worst, ends = 0.0, []
    for tick in (1e-3, 5e-2):
        model = suture(200)
        state = begin(model, straight(model))
        held = holds(model, [0], [[0, 0, 0]])
        for _ in range(round(1.0 / tick)):
            step(state, held, tick)
            worst = max(worst, _sound(model, state))
        ends.append(state.x.copy())
    apart = float(np.max(np.linalg.norm(ends[0] - ends[1], axis=1))) / 100.0
    assert apart <= 5e-3, f"1 ms and 50 ms end {apart:.1e} lengths apart"
    return f"ok: after 1 s they are {apart:.0e} lengths apart, lengths to {worst:.0e}"


def not_a_number() -> str:
    """A target that is no number, or infinite, is refused and moves nothing; a denormal is a place like any other."""
    model = suture(50)
    state = begin(model, straight(model))
    held = holds(model, [0], [[0, 0, 0]])
    message = ""
    for bad in (math.nan, math.inf):
        held.target[0, 0] = bad
        before = state.x.copy()
        try:
            step(state, held, TICK_S)
        except ValueError as error:
            message = str(error)
        else:
            raise AssertionError(f"{bad} was taken")
        assert np.array_equal(before, state.x), "a refused tick moved the thread"
    held.target[0] = 5e-324
    step(state, held, TICK_S)
    _sound(model, state)
    return f"refused: {message}"


def bad_starts() -> str:
    """All nodes in one point; all links folded back on one another."""
    worst = 0.0
    model = suture(50)
    for x in (np.zeros((51, 3)), np.outer(np.arange(51) % 2, [2.0, 0.0, 0.0])):
        state = begin(model, x)
        held = holds(model, [0, 50], [[0, 0, 0], [60, 0, 0]])
        for _ in range(30):
            step(state, held, TICK_S)
            worst = max(worst, _sound(model, state))
        assert np.allclose(state.x[50], [60.0, 0.0, 0.0])
    return f"ok: a point and a fold are drawn to 60 mm, lengths to {worst:.0e}"


def chain_over_taut() -> str:
    """A rigid chain's ends drawn apart: the pull grows to the hold's limit, where a tick is refused."""
    model, refusal = bare(200), ""
    half = np.arange(model.count)
    x = model.link * np.stack([0.6 * half, 0.0 * half, -0.8 * np.minimum(half, 200 - half)], axis=1)
    state = begin_chain(model, x)
    held = holds(model, [0, 200], x[[0, 200]], 150.0)
    furthest = 0.0
    while not refusal:
        held.target[1, 0] += 2.0
        before = state.x.copy()
        try:
            step_chain(model, state, held, TICK_S)
        except ChainTaut as error:
            refusal = str(error)
        furthest = max(furthest, float(np.max(np.abs(state.x - before))))
        _level(state.x, model.link)
    assert np.array_equal(before, state.x), "a refused tick moved the chain"
    assert held.target[1, 0] <= model.length + 2.0
    return f"refused: {refusal}; no node had moved more than {furthest:.0f} mm a tick"


def _level(x: Array, link: float) -> float:
    """The largest relative error of a rigid link's length."""
    error = float(np.max(np.abs(np.linalg.norm(np.diff(x, axis=0), axis=1) / link - 1.0)))
    assert error <= 1e-9, f"a link's length is off by {error:.1e}"
    return error


def chain_moves() -> str:
    """A chain's held end leaps 200 mm in one tick; a loop of the forceps in ticks of 1 ms and of 50 ms."""
    worst = 0.0
    for links in (50, 200):
        model = bare(links)
        state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
        for k in range(30):
            if k == 10:
                held.target[0] = [120.0, 160.0, 0.0]
            step_chain(model, state, held, TICK_S)
            worst = max(worst, _level(state.x, model.link))
    for tick in (1e-3, 5e-2):
        model = bare(100)
        state, held = begin_chain(model, straight(model)), holds(model, [0], [[0, 0, 0]])
        for k in range(1, round(1.0 / tick) + 1):
            held.target[0] = forceps(model, k * tick)
            step_chain(model, state, held, tick)
            worst = max(worst, _level(state.x, model.link))
    return f"ok: lengths to {worst:.0e}"


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """(case, method, what runs it): "ok: ..." or "refused: ..." with a number, or AssertionError where a law breaks."""
    return [
        ("thread pulled to 1.5 times its length", METHOD, over_taut),
        ("held end leaps 20 mm in one tick", METHOD, jump),
        ("1000 links fall in a heap", METHOD, heap),
        ("bending stiffness from 0 to 1e6 of nylon's", METHOD, stiffness),
        ("ticks of 1 ms and of 50 ms", METHOD, ticks),
        ("a pose that is not a number, infinite or denormal", METHOD, not_a_number),
        ("zero-length and folded links at the start", METHOD, bad_starts),
        ("chain pulled straight", CHAIN, chain_over_taut),
        ("chain whose end leaps 200 mm; ticks of 1 ms and of 50 ms", CHAIN, chain_moves),
    ]
