"""The bench of the thread: its reference is right, its rows are complete, its hard cases hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from trainer.bench import thread
from trainer.bench.rows import Row, plain
from trainer.geometry import Array
from trainer.mechanics.thread_rod import Holds, RodModel, holds


def angle_answer(model: RodModel, seconds: float) -> Array:
    """Places (n, 3) mm after a swing, from Lagrange's equations in the links' angles, where no length can err.

    With J = dx / d angle: (JᵀMJ) a'' = Jᵀ (f - c x' - M J' a') - d/da of (EI / d) sum (1 - cos(a_i+1 - a_i)).
    """
    links, d = model.count - 1, model.link
    mass, drag = (s * model.node_lengths()[1:] for s in (model.mass, model.drag))
    below = np.tril(np.ones((links, links)))
    inertia = d * d * below.T @ (mass[:, None] * below)

    def rates(_: float, y: Array) -> Array:
        angle, spin = y[:links], y[links:]
        cosine, sine = np.cos(angle), np.sin(angle)
        fx = d * (drag * (below @ (sine * spin)) + mass * (below @ (cosine * spin**2)))
        fz = d * (-drag * (below @ (cosine * spin)) + mass * (below @ (sine * spin**2))) - mass * 9810.0
        torque = d * (-sine * (below.T @ fx) + cosine * (below.T @ fz))
        bend = model.bending / d * np.sin(np.diff(angle))
        torque[:-1] += bend
        torque[1:] -= bend
        matrix = inertia * np.cos(angle[:, None] - angle[None, :])
        return np.concatenate([spin, np.linalg.solve(matrix, torque)])

    solved = solve_ivp(rates, (0.0, seconds), np.zeros(2 * links), "Radau", rtol=1e-8, atol=1e-10)
    angle = solved.y[:links, -1]
    steps = d * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def test_the_reference_agrees_with_one_in_other_unknowns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cartesian places with tensions against angles without: two programs of one law, each converged to 1e-6 L."""
    monkeypatch.setattr(thread, "SECONDS", 0.2)
    for model in (thread.suture(8), thread.bare(8)):
        found = thread.answers(model, thread.still, 1e-5)[-1]
        assert np.max(np.abs(found - angle_answer(model, 0.2))) <= 1e-5 * model.length


def drag(model: RodModel, methods: list[thread.Method], h: float) -> list[Row]:
    return thread.run("drag", model, thread.forceps, methods, thread.answers(model, thread.forceps, h), "itself")


def held_end(model: RodModel) -> Holds:
    return holds(model, [0], [[0, 0, 0]])


def test_the_drag_s_error_falls_with_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rod is of second order: a step of a half has a quarter of the error; a half is asked for.

    A way of which a method is told less than the reference goes has an error of its own, which no step makes smaller:
    told once a frame the last two stay at 6e-4.
    """
    monkeypatch.setattr(thread, "SECONDS", 0.3)
    model = thread.suture(50)
    rows = drag(model, [thread.Rod(model, held_end(model), h, False) for h in (2e-3, 1e-3, 5e-4)], 2e-5)
    coarse, half, quarter = (row.error for row in rows)
    assert coarse > 2.0 * half > 4.0 * quarter


def test_what_is_not_told_of_the_way_no_tolerance_brings_back() -> None:
    """Told of its held end's way the bare chain is right to 1e-4 of its length, as tolerances of 1e-4 and 1e-6 of it

    a substep promise; told once a frame it is off by more than ten times as much with either (a hundredth was met).
    """
    model = thread.bare(50)
    kinds = (thread.Chain, thread.Untold)
    methods: list[thread.Method] = [
        kind(model, held_end(model), t * model.length) for kind in kinds for t in (1e-4, 1e-6)
    ]
    *told, loose, tight = (row.error for row in drag(model, methods, thread.reference_step(model)))
    assert max(told) < 1e-4
    assert tight > 10.0 * max(told)
    assert tight > 0.5 * loose


def test_a_thread_is_lost_by_its_place_or_by_its_lengths() -> None:
    """A method that is where it should be, but for one: a node that is off by 0.2 of the thread, a link of 1.2."""
    model = thread.bare(10)
    there = thread.straight(model)
    off, long = there.copy(), there.copy()
    off[:, 1] += 0.2 * model.length
    long[-1, 0] += 0.2 * model.link

    @dataclass
    class Fixed:
        name: str
        x: Array
        setting: str = ""

        def frame(self, places: Array) -> Array:
            return self.x

    methods: list[thread.Method] = [Fixed("right", there), Fixed("off", off), Fixed("long", long)]
    methods.append(Fixed("not a number", np.full_like(there, math.nan)))
    rows = thread.run("stands", model, thread.still, methods, np.array([there, there]), "itself")
    found = {row.method: row for row in rows}
    assert {name: row.status for name, row in found.items()} == {
        "right": "done, lengths within 0e+00",
        "off": "lost, lengths within 0e+00",
        "long": "lost, lengths within 2e-01",
        "not a number": "lost, lengths within inf",
    }
    assert (plain(found["not a number"])["error"], found["off"].error) == (None, pytest.approx(0.2))


def test_rows_say_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every case, method and setting has a row; the rod keeps lengths to 1e-6 and the suture's place to 1 %;

    the chain lengths to 1e-9 and, with 1e-5 a substep, in 0.1 s its place to 1e-4."""
    monkeypatch.setattr(thread, "SECONDS", 0.1)
    rows = thread.measure(True, (50,))
    assert {r.case for r in rows} == {"swing, suture", "swing, bare", "drag, suture", "drag, bare"}
    assert {r.method for r in rows} == {"rod", "chain", "chain, told once a frame", "xpbd", "follow-the-leader"}
    assert len({(r.case, r.size, r.method, r.setting) for r in rows}) == len(rows)
    for row in rows:
        assert row.frames == 10
        assert 0.0 < row.median_ms <= row.p90_ms
        if row.method == "rod":
            assert row.residual <= 1e-6
            assert math.isfinite(row.error)
            assert "bare" in row.case or row.error <= 1e-2
        if row.method == "chain":
            assert row.residual <= 1e-9
            assert row.error <= 1e-4
