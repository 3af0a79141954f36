"""The bench of the thread: its reference is right, its rows are complete, its hard cases hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from trainer.bench import thread
from trainer.geometry import Array
from trainer.mechanics.thread_rod import RodModel


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


def test_rows_say_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every case, method and setting has a row; the rod keeps lengths to 1e-6 and the suture's place to 1 %;

    the chain lengths to 1e-9 and, with 1e-5 a substep, in 0.1 s its place to 1e-4."""
    monkeypatch.setattr(thread, "SECONDS", 0.1)
    rows = thread.measure(True, (50,))
    assert {r.case for r in rows} == {"swing, suture", "swing, bare", "drag, suture", "drag, bare"}
    assert {r.method for r in rows} == {"rod", "chain", "xpbd", "follow-the-leader"}
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
