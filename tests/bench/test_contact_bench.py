"""The bench of contact search measures what it says, and the hard cases hold."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from trainer.bench.contact import (
    MARGIN_MM,
    RADIUS_MM,
    STATES,
    Method,
    chain,
    compare,
    measure,
    own_methods,
    surface_methods,
    surface_truth,
    tangle,
    thread_around,
    vessel,
)
from trainer.bench.hard_contact import cases
from trainer.mechanics.cells import Cells


def test_every_method_that_answers_finds_the_pairs_and_says_so() -> None:
    """FCL iterates to 1e-6 of a length: of some 40 pairs it may judge those at the very margin otherwise."""
    thread = thread_around(60)
    states, triangles = vessel(12, 12)
    truth = surface_truth(thread, states, triangles)
    assert min(len(pairs) for pairs in truth) > 10
    rows = compare("thread", len(triangles), surface_methods(thread, states, triangles, True), truth, 2)
    assert len(rows) == 5
    for row in rows:
        assert row.median_ms > 0.0
        assert (row.residual, row.residual_of) == (0.0, "nothing")
        if row.method in ("cells", "bounding spheres"):
            assert (row.error, row.status) == (0.0, "all pairs")
        elif row.status == "no pairs asked":
            assert (math.isnan(row.error), row.compared_at) == (True, None)
        else:
            assert row.error < 0.1


def test_fcl_finds_the_same_pairs() -> None:
    """Capsules that touch triangles: an answer by other code. It lies between ours for margins less and more by 1e-5.

    FCL's iterations end at 1e-6 of a length; 6e-6 mm were met (tests of rigid contact).
    """
    thread = thread_around(60)
    states, triangles = vessel(12, 12)
    cells = Cells(chain(61), triangles, states[0])
    by_fcl = next(m for m in surface_methods(thread, states, triangles, True) if m.slow and m.answers)
    for state, x in enumerate(states):
        fewer, found, more = (
            {(int(a), int(b)) for a, b in pairs}
            for pairs in (
                cells.near(thread, x, MARGIN_MM - 1e-5).copy(),
                by_fcl.search(state),
                cells.near(thread, x, MARGIN_MM + 1e-5),
            )
        )
        assert len(fewer) > 10
        assert fewer <= found <= more


def test_every_method_finds_how_a_thread_lies_on_itself() -> None:
    threads = [tangle(400, state) for state in range(2)]
    methods = own_methods(threads)
    truth = [{(int(a), int(b)) for a, b in methods[1].search(state)} for state in range(2)]
    assert sum(map(len, truth)) > 0
    rows = compare("own", 400, methods, truth, 2)
    assert [row.error for row in rows] == [0.0, 0.0, 0.0]


def test_a_missed_pair_and_a_wrong_one_are_errors() -> None:
    """Of four pairs one is missed, and one that is none is told: two quarters."""
    truth = [{(0, 0), (0, 1), (1, 1), (2, 2)}]
    told = np.array([[0, 0], [0, 1], [1, 1], [3, 3]], dtype=np.int32)
    row = compare("some", 4, [Method("wrong", "", lambda state: told)], truth, 1)[0]
    assert row.error == 0.5
    assert row.status == "other pairs"


def test_the_work_is_what_it_is_said_to_be() -> None:
    """The vessel is a closed tube with normals outwards in all states; half of the thread is near the wall at rest."""
    states, triangles = vessel(10, 12)
    assert len(states) == STATES
    assert len(triangles) == 2 * 9 * 12
    for x in states:
        a, b, c = (x[triangles[:, k]] for k in range(3))
        outwards = np.einsum("fd,fd->f", np.cross(b - a, c - a), (a + b + c) * [0.0, 1.0, 1.0])
        assert np.all(outwards > 0.0)
    high = np.hypot(*thread_around(300)[:, 1:].T) - RADIUS_MM
    assert 0.4 < np.mean(high < MARGIN_MM) < 0.6


def test_measure_has_a_row_for_each_method_and_case() -> None:
    rows = measure(True, surfaces=((8, 8),))
    assert len(rows) == 5 + 3
    assert {row.size for row in rows} == {2 * 7 * 8, 1000}


@pytest.mark.parametrize(("case", "method", "run"), cases(), ids=lambda value: value if isinstance(value, str) else "")
def test_no_hard_case_breaks_its_law(case: str, method: str, run: Callable[[], str]) -> None:
    told = run()
    assert told.startswith("refused: " if "nan" in case or "inf" in case else "ok: ")
