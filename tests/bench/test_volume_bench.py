"""The bench of volumes measures what it says."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.bench import volume
from trainer.bench.volume import ORDER, Bodies, beyond_limits, block, measure, trials
from trainer.mechanics.volume import start


def test_measure_has_a_row_for_each_method_and_case() -> None:
    rows = measure(True, sizes=(12,))
    cases = [row.case for row in rows]
    assert cases.count("drag of a whole block") == 3
    assert cases.count("growth with the elements that move") == 5
    assert len(rows) == 3 + 3 + 2 + 3 + 5 + 1 + 1
    for row in rows:
        assert row.size == (4 * 12**3 if row.case.startswith("four") else 12**3)
        assert row.frames == 0 or row.median_ms > 0.0
        if row.error_of == ORDER:
            assert row.error == 0.0


def test_an_image_tells_its_pace_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """19 bytes for each of 20 × 20 × 10 elements."""
    monkeypatch.setattr(volume, "IMAGE", (20, 20, 10))
    monkeypatch.setattr(volume, "FREE_PART", 6)
    rows = volume.image(2)
    assert [(row.size, row.setting) for row in rows] == [(4000, "6³ free"), (4000, "all free")]
    for row in rows:
        assert "moves/s; 19 B an element, 0 MB at most" in row.status


def test_lists_and_scan_do_not_differ() -> None:
    row = trials(5, 10)
    assert (row.error, row.residual) == (0.0, 0.0)
    assert row.status == "0 of 5 differ"


def test_a_link_beyond_its_limits_is_an_error() -> None:
    """One element displaced by 1 mm where 0.2 are allowed."""
    cube = block(3)
    state = start(cube)
    assert beyond_limits(cube, state) == 0.0
    state.u[0, 13] = 1.0
    assert abs(beyond_limits(cube, state) - 0.8) < 1e-6


def test_the_four_bodies_do_touch() -> None:
    four = Bodies(8)
    touched = []
    for frame in range(20):
        four.tick(frame)
        touched.append(four.touched)
    assert max(touched) > 0
    assert all(np.isfinite(state.u).all() for state in four.states)
