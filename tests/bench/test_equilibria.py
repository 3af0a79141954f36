"""What the methods are held against: three ways to it that share no code or no way, and agree."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.bench import equilibria
from trainer.bench.vessel import Work, prepare
from trainer.mechanics.links import forces, hessian


@pytest.fixture(scope="module")
def work() -> Work:
    return prepare(7, 8, both_ends=True, frames=3)


@pytest.mark.parametrize(
    ("own", "direct", "quick", "by"),
    [
        (10_000, 10_000, False, equilibria.BY_OWN),
        (10, 10_000, False, equilibria.BY_NEWTON),
        (10, 10_000, True, equilibria.BY_ANOTHER_WAY),
        (10, 10, False, equilibria.BY_ANOTHER_WAY),
    ],
)
def test_every_one_finds_the_same_answers(
    work: Work, own: int, direct: int, quick: bool, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A residual r leaves the nodes within r / λ of the answer, λ the softest stiffness there, to first order; twice

    that for the second order, and for the residuals of both."""
    monkeypatch.setattr(equilibria, "OWN", own)
    monkeypatch.setattr(equilibria, "DIRECT", direct)
    found, said = equilibria.answers(work.mesh, work.node, work.places, work.free, work.first_mN, quick)
    assert said == by
    at = (3 * work.free[:, None] + np.arange(3)).ravel()
    for place, x, answer in zip(work.places, found, work.answers, strict=True):
        assert np.array_equal(x[work.node], place)
        left = np.linalg.norm(forces(work.mesh, x)[work.free]) + equilibria.REFERENCE_mN
        softest = np.linalg.eigvalsh(hessian(work.mesh, answer)[np.ix_(at, at)])[0]
        assert left <= 2.0 * max(equilibria.REFERENCE_SHARE * work.first_mN, equilibria.REFERENCE_mN)
        assert np.max(np.linalg.norm(x - answer, axis=1)) <= 2.0 * left / softest


def test_the_other_way_ends_at_each_place_and_is_elsewhere_between(work: Work) -> None:
    """Beside the line by a quarter of the step, and nearer to the place with each step."""
    ways = equilibria.another_way(work.places)
    assert [len(way) for way in ways] == [1, 3, 3, 3]
    for place, way in zip(work.places, ways, strict=True):
        assert np.array_equal(way[-1], place)
    for before, after, way in zip(work.places[:-1], work.places[1:], ways[1:], strict=True):
        along = (after - before) / np.linalg.norm(after - before)
        for k, place in enumerate(way[:-1], 1):
            share = (place - before) @ along / np.linalg.norm(after - before)
            aside = np.linalg.norm(place - before - ((place - before) @ along) * along)
            assert share == pytest.approx(k / 3)
            assert aside == pytest.approx(0.25 * np.linalg.norm(after - before))


def test_no_answer_is_no_reference(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    """A residual below the rounding of the forces cannot be reached: that is told, not passed over."""
    monkeypatch.setattr(equilibria, "OWN", 10)
    with pytest.raises(ArithmeticError, match="Newton did not converge"):
        equilibria.answers(work.mesh, work.node, work.places, work.free, 0.0)
