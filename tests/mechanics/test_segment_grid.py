"""The grid of a thread's segments lists each where its box is, and its sums tell whether a range of cells is empty."""

from __future__ import annotations

import numpy as np
from contact_samples import chain, samples
from hypothesis import given
from hypothesis import strategies as st

from trainer.mechanics.segment_grid import MOST_CELLS, SegmentGrid, any_in

Case = tuple[np.ndarray, np.ndarray, np.ndarray]


@given(samples, st.integers(0, 10**6))
def test_a_range_of_cells_is_empty_when_no_cell_of_it_lists_a_segment(case: Case, seed: int) -> None:
    thread = case[0]
    grid = SegmentGrid(chain(len(thread)))
    grid.fill(thread, thread, 0.01)
    assert np.prod(grid.cells) <= MOST_CELLS
    counts = np.diff(grid.begin[: np.prod(grid.cells) + 1]).reshape(grid.cells)
    assert set(grid.listed[: counts.sum()]) == set(range(len(thread) - 1))
    rng = np.random.default_rng(seed)
    for _ in range(20):
        low, high = np.sort(rng.integers(0, grid.cells, (2, 3)), axis=0)
        (i0, j0, k0), (i1, j1, k1) = low, high
        expected = counts[i0 : i1 + 1, j0 : j1 + 1, k0 : k1 + 1].sum() > 0
        assert any_in(grid.sums, grid.cells, i0, i1, j0, j1, k0, k1) == expected
