"""A thread against itself: the near pairs of segments, all and no others, without neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes
from contact_samples import all_own_pairs, chain, margins, sample, samples
from hypothesis import given
from hypothesis import strategies as st

from trainer.mechanics.self_contact import SelfContact

Case = tuple[np.ndarray, np.ndarray, np.ndarray]


def listed(pairs: np.ndarray) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in pairs]


@given(samples, margins, st.integers(0, 4))
def test_the_pairs_are_those_of_looking_at_all(case: Case, margin: float, neighbours: int) -> None:
    for x in case[:2]:  # the surface's nodes are a longer thread
        segments = chain(len(x))
        found = listed(SelfContact(segments, neighbours).near(x, margin))
        assert found == all_own_pairs(x, segments, np.arange(len(segments)), neighbours, margin)


@given(samples, samples, margins)
def test_the_pairs_on_the_way_hold_all_that_meet_there(case: Case, later: Case, margin: float) -> None:
    """Halves of the way included: whoever is near at some time has boxes that are near."""
    x0, x1 = case[0], later[0]
    search = SelfContact(chain(13))
    on_the_way = set(listed(search.on_the_way(x0, x1, margin)))
    for share in (0.0, 0.3, 0.5, 1.0):
        assert set(listed(search.near((1.0 - share) * x0 + share * x1, 0.999 * margin))) <= on_the_way


def test_the_pairs_on_the_way_are_no_others() -> None:
    """Two straight segments 1 apart stay apart by a box test with margin 0.9, and meet one with margin 1.1."""
    x0 = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    search = SelfContact(np.array([[0, 1], [2, 3]]), neighbours=1)
    x1 = x0 + np.array([3.0, 0.0, 0.0])
    assert len(search.on_the_way(x0, x1, 0.9)) == 0
    assert listed(search.on_the_way(x0, x1, 1.1)) == [(0, 1)]


def test_neighbours_end_where_a_thread_ends() -> None:
    """Two pieces of a cut thread lie on each other: the last segment of one and the first of the next are a pair."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert listed(SelfContact(np.array([[0, 1], [2, 3]]), neighbours=1).near(x, 0.1)) == [(0, 1)]
    assert listed(SelfContact(np.array([[0, 1], [1, 3]]), neighbours=1).near(x, 0.1)) == []


def test_a_heap_of_a_thousand_segments_in_one_place() -> None:
    """All are near one another: m (m - 1) / 2 pairs less the neighbours' m - 1, far more than the first room."""
    x = np.random.default_rng(0).normal(scale=1e-3, size=(1001, 3))
    pairs = SelfContact(chain(1001)).near(x, 1.0)
    assert len(pairs) == 1000 * 999 // 2 - 999
    assert np.array_equal(pairs, np.argwhere(np.triu(np.ones((1000, 1000)), 2)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e10])
def test_a_place_that_is_none_is_refused(bad: float) -> None:
    x, _, _ = sample("even", 0)
    x[4, 2] = bad
    with pytest.raises(ValueError, match="thread: node 4"):
        SelfContact(chain(13)).near(x, 0.1)


def test_wrong_input_is_refused() -> None:
    x, _, _ = sample("even", 0)
    with pytest.raises(ValueError, match="neighbours"):
        SelfContact(chain(13), neighbours=-1)
    with pytest.raises(ValueError, match="name node 12"):
        SelfContact(chain(13)).near(x[:12].copy(), 0.1)
    assert SelfContact(np.empty((0, 2), dtype=np.int32)).near(x, 0.1).shape == (0, 2)


def test_a_search_allocates_nothing() -> None:
    """What remains are the view of the pairs and a closure, below 2 kB; a search's arrays have 160 kB."""
    x, _, _ = sample("even", 1)
    search = SelfContact(chain(13))
    kept, peak = kept_bytes(lambda: search.near(x, 0.3))
    assert kept < ARRAY_HEADER
    assert peak < 2048
