"""XPBD against what it must share with the rod: free fall, rest, and the same motion when its steps are small."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.geometry import Array
from trainer.mechanics.thread_rod import RodModel, begin, holds, monofilament, settle, step
from trainer.mechanics.thread_xpbd import begin_xpbd, step_xpbd


def straight(model: RodModel) -> Array:
    x = np.zeros((model.count, 3))
    x[:, 0] = model.link * np.arange(model.count)
    return x


def test_without_holds_it_falls_as_a_body() -> None:
    """Symplectic Euler: z = -g h² k (k + 1) / 2 after k substeps, and no constraint does anything."""
    model = RodModel(11, 1.0, 1e-6, 1e-3, 1e6)
    state = begin_xpbd(model, straight(model))
    step_xpbd(model, state, holds(model, [], np.zeros((0, 3))), 0.1, 100)
    assert state.x[:, 2] == pytest.approx(np.full(11, -9810.0 * 1e-6 * 100 * 101 / 2), rel=1e-9)
    assert state.x[:, 0] == pytest.approx(np.arange(11.0), abs=1e-9)


def test_it_hangs_at_rest_where_the_rod_does() -> None:
    """With compliance the rest state of XPBD is that of the same energy, whatever the step: both sag alike, to 1 %.

    A sweep a substep follows bending waves, 4 sqrt(EI / rho) / d² = 2e3 rad/s, where the substep is 5e-5 s.
    """
    model = monofilament(0.022, 1.14e-6, 2.5e6, 40.0, 11)
    held = holds(model, [0, 1], straight(model)[:2])
    rod = begin(model, straight(model))
    settle(rod, held)
    beads = begin_xpbd(model, straight(model))
    for _ in range(100):
        step_xpbd(model, beads, held, 0.01, 200)
    assert rod.x[-1, 2] < -0.01
    assert beads.x[-1, 2] == pytest.approx(rod.x[-1, 2], rel=1e-2)


def test_smaller_steps_come_nearer_to_the_rod() -> None:
    """XPBD is of order one: the distance to the rod's converged swing falls with the substep."""
    model = RodModel(21, 5.0, 1e-6, 0.0, 1e6)
    held = holds(model, [0], [[0, 0, 0]])
    rod = begin(model, straight(model))
    for _ in range(200):
        step(rod, held, 5e-4)
    errors = []
    for substeps in (10, 100, 1000):
        beads = begin_xpbd(model, straight(model))
        for _ in range(10):
            step_xpbd(model, beads, held, 0.01, substeps)
        errors.append(float(np.max(np.linalg.norm(beads.x - rod.x, axis=1))))
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2]
    assert errors[2] < 1.0


def test_bad_input_is_refused() -> None:
    model = RodModel(5, 1.0, 1e-6, 0.0, 1e6)
    with pytest.raises(ValueError, match="finite"):
        begin_xpbd(model, np.full((5, 3), np.nan))
    state, held = begin_xpbd(model, straight(model)), holds(model, [0], [[0, 0, 0]])
    with pytest.raises(ValueError, match="more than 0"):
        step_xpbd(model, state, held, 0.0, 10)
    held.target[0, 0] = np.inf
    with pytest.raises(ValueError, match="finite"):
        step_xpbd(model, state, held, 0.01, 10)
