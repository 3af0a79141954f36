"""The bench of time integration measures what it says, and the hard cases catch a method that breaks their law."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trainer.bench import hard_integrators, integrators
from trainer.bench.rows import Row, plain
from trainer.mechanics.dynamics import Model, State
from trainer.mechanics.integrators import RK4, Explicit


@pytest.fixture(scope="module")
def work() -> integrators.Work:
    return integrators.prepare(4, 8, "soft", frames=1, parts=(1, 2))


@pytest.fixture(scope="module")
def rows(work: integrators.Work) -> list[Row]:
    return integrators.compare(work, quick=False)


def errors(rows: list[Row], method: str) -> list[float]:
    return [row.error for row in rows if row.method == method]


def test_every_method_swings_for_all_frames(rows: list[Row], work: integrators.Work) -> None:
    assert {row.method for row in rows} == set(hard_integrators.makers())
    for row in rows:
        assert (row.frames, row.size) == (len(work.answers), 64)
        assert row.median_ms > 0.0
        assert 0.0 < row.error < 2.0
        assert row.status in {"stable", "converged", "one linear step"}
    json.dumps([plain(row) for row in rows], allow_nan=False)


def test_errors_fall_as_the_orders_say(rows: list[Row]) -> None:
    """Half the step: 2, 4 and 16 times less of an error; the reference, a quarter, has 1/16 of RK4's best itself.

    The fastest modes, at the limit of stability, are damped by other factors: half of each ratio is asked for.
    Ten times the steps of backward Euler: ten times less, where the step resolves the swing; a fifth is asked for.
    """
    for method, order in (("forward Euler", 1), ("RK2 midpoint", 2), ("RK4", 4)):
        whole, half = errors(rows, method)
        assert whole / half > 0.5 * 2**order
    for method in ("linear backward Euler", "backward Euler"):
        *_, coarse, fine = errors(rows, method)
        assert coarse / fine > 5.0


def test_the_vessel_is_let_go_from_balance(work: integrators.Work) -> None:
    """At the beginning only the nodes that were drawn feel a force: the others are balanced to the tolerance."""
    free = Explicit(work.model, RK4, work.held)
    state = work.begin()
    free.step(state, 1e-9)
    gained = np.linalg.norm(state.v, axis=1) * work.model.mass / 1e-9
    drawn = np.zeros(len(gained), dtype=bool)
    drawn[:16] = True  # the first layer
    assert np.linalg.norm(gained[~drawn]) < 2.0 * work.tolerance_mN
    assert np.linalg.norm(gained[drawn]) > 100.0 * work.tolerance_mN


def test_who_would_take_too_long_is_left_out() -> None:
    stiff = integrators.prepare(4, 8, "stiff", frames=1, parts=(1,))
    assert "forward Euler" not in {swing.name for swing in integrators.candidates(stiff, quick=True)}


@pytest.mark.parametrize(
    ("case", "run"),
    [
        pytest.param(case, run, id=f"{case}, {method}")
        for case, method, run in hard_integrators.cases()
        if method in {"RK4", "linear backward Euler", "backward Euler", "all"}
    ],
)
def test_hard_cases(case: str, run: hard_integrators.Callable[[], str]) -> None:
    """Each ends well or is refused in a line; what is not finite is refused."""
    answer = run()
    assert answer.startswith(("ok: ", "refused: "))
    assert "\n" not in answer
    if "position of" in case:
        assert answer.startswith("refused: ")


class Careless(Explicit):
    """RK4 without its substeps."""

    def step(self, state: State, duration: float) -> int:
        self.method.advance(self.model, state, self._stages, duration, 1)
        return 1


def test_a_method_that_explodes_is_caught() -> None:
    def make(made: Model, held: np.ndarray) -> Explicit:
        return Careless(made, RK4, held)

    with pytest.raises(AssertionError, match=r"energy grew|not finite"):
        hard_integrators.swing(hard_integrators.stiff_and_soft, make, 50e-3, 2)
