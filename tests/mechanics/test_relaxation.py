"""The paper's step by trial."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from trainer.bench.vessel import Work, prepare
from trainer.mechanics import relaxation
from trainer.mechanics.relaxation import factor_by_trial, relax

TOLERANCE_mN = 1e-3


@pytest.fixture(scope="module")
def work() -> Work:
    return prepare(7, 8, both_ends=True)


def sweeps(work: Work, factor: float, most: int = 10_000) -> tuple[bool, int]:
    x = work.mesh.rest.copy()
    x[work.node] = work.places[-1]
    node = np.array([work.node])
    ended = relax(work.mesh, x, node, tolerance_mN=TOLERANCE_mN, most_sweeps=most, factor=factor)
    return ended.converged, ended.sweeps


def test_the_factor_by_trial_takes_the_fewest_sweeps_and_the_next_does_not(work: Work) -> None:
    x = work.mesh.rest.copy()
    x[work.node] = work.places[-1]
    before = x.copy()
    found = factor_by_trial(work.mesh, x, np.array([work.node]), tolerance_mN=TOLERANCE_mN, most_sweeps=10_000)
    assert np.array_equal(x, before)
    assert found > 1.0
    factors = np.arange(1.0, found + 0.25, relaxation.TRIAL)
    took = [sweeps(work, float(factor)) for factor in factors]
    assert all(converged for converged, _ in took)
    assert all(a > b for (_, a), (_, b) in pairwise(took))
    assert sweeps(work, found + relaxation.TRIAL, took[-1][1] - 1)[0] is False


def test_a_larger_factor_goes_to_the_same_place(work: Work) -> None:
    """What the forces balance does not depend on the step: residuals of 1e-9 mN at links of about 1 mN/mm, soft as a
    thousandth of these, are 1e-6 mm."""
    found = []
    for factor in (1.0, 2.0):
        x = work.mesh.rest.copy()
        x[work.node] = work.places[-1]
        node = np.array([work.node])
        assert relax(work.mesh, x, node, tolerance_mN=1e-9, most_sweeps=20_000, factor=factor).converged
        found.append(x)
    assert np.abs(found[0] - found[1]).max() < 1e-6
    assert np.abs(found[0] - work.answers[-1]).max() < 1e-6


def test_a_trial_that_does_not_end_keeps_the_step_that_needs_none(work: Work) -> None:
    x = work.mesh.rest.copy()
    x[work.node] = work.places[-1]
    assert factor_by_trial(work.mesh, x, np.array([work.node]), tolerance_mN=0.0, most_sweeps=20) == 1.0
