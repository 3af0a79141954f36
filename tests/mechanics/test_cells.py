"""The cells find the pairs of a thread and a surface that are near: all of them and no others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes
from contact_samples import KINDS, all_pairs, chain, margins, sample, samples
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.mechanics.bounding_spheres import SphereSearch, SphereTree
from trainer.mechanics.cells import BLOCK, Cells
from trainer.mechanics.pair_list import FIRST_ROOM
from trainer.mechanics.self_contact import SelfContact

Case = tuple[np.ndarray, np.ndarray, np.ndarray]


def listed(pairs: np.ndarray) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in pairs]


@given(samples, margins)
def test_the_pairs_are_those_of_looking_at_all(case: Case, margin: float) -> None:
    thread, surface, triangles = case
    segments = chain(len(thread))
    cells = Cells(segments, triangles, surface)
    assert listed(cells.near(thread, surface, margin)) == all_pairs(thread, segments, surface, triangles, margin)


@given(samples, samples, margins)
def test_they_are_so_after_the_surface_went_anywhere(case: Case, later: Case, margin: float) -> None:
    """The blocks were made for other places: they may be bad, the pairs may not."""
    _, before, triangles = case
    thread, surface, _ = later
    segments = chain(len(thread))
    cells = Cells(segments, triangles, before)
    assert listed(cells.near(thread, surface, margin)) == all_pairs(thread, segments, surface, triangles, margin)


@given(samples, samples, margins)
def test_the_pairs_on_the_way_are_those_whose_boxes_meet(case: Case, later: Case, margin: float) -> None:
    """The boxes' sides are sums of a coordinate and the margin, rounded once; the law below rounds the same sum."""
    thread, surface, triangles = case
    thread1, surface1, _ = later
    segments = chain(len(thread))
    found = Cells(segments, triangles, surface).on_the_way(thread, thread1, surface, surface1, margin)
    ways = np.concatenate([thread[segments], thread1[segments]], axis=1)
    others = np.concatenate([surface[triangles], surface1[triangles]], axis=1)
    low, high = ways.min(axis=1) - margin, ways.max(axis=1) + margin
    meet = (low[:, None] <= others.max(axis=1)) & (high[:, None] >= others.min(axis=1))
    assert np.array_equal(found, np.argwhere(meet.all(axis=2)))


@given(st.integers(0, 10**6))
def test_many_blocks_are_searched_as_one(seed: int) -> None:
    """A surface of several blocks, the last of them not full, and a thread that is near a part of it."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform(-3.0, 3.0, (5 * BLOCK + 7, 1, 3))
    surface = np.ascontiguousarray((middles + rng.normal(scale=0.05, size=(len(middles), 3, 3))).reshape(-1, 3))
    triangles = np.arange(len(surface), dtype=np.int32).reshape(-1, 3)
    thread = np.cumsum(rng.normal(scale=0.3, size=(40, 3)), axis=0)
    segments = chain(40)
    found = listed(Cells(segments, triangles, surface).near(thread, surface, 0.2))
    assert found == all_pairs(thread, segments, surface, triangles, 0.2)


def test_room_grows_when_there_are_more_pairs_than_ever() -> None:
    """All of 12 · 900 pairs are near, more than there is room at first; afterwards fewer are found as well."""
    thread, surface, triangles = sample("even", 3)
    triangles = np.tile(triangles, (10, 1))
    cells = Cells(chain(13), triangles, surface)
    many = cells.near(thread, surface, 100.0)
    assert len(many) == 12 * 900 > FIRST_ROOM
    assert listed(cells.near(thread, surface, 0.05)) == all_pairs(thread, chain(13), surface, triangles, 0.05)


def test_nothing_is_near_nothing() -> None:
    thread, surface, triangles = sample("even", 0)
    none = np.empty((0, 3))
    assert Cells(chain(13), np.empty((0, 3), dtype=np.int32), none).near(thread, none, 1.0).shape == (0, 2)
    assert Cells(np.empty((0, 2), dtype=np.int32), triangles, surface).near(none, surface, 1.0).shape == (0, 2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e10])
@pytest.mark.parametrize("whose", ["thread", "surface"])
def test_a_place_that_is_none_is_refused_by_name(whose: str, bad: float) -> None:
    thread, surface, triangles = sample("even", 0)
    cells = Cells(chain(13), triangles, surface)
    {"thread": thread, "surface": surface}[whose][7, 1] = bad
    with pytest.raises(ValueError, match=f"{whose}: node 7"):
        cells.near(thread, surface, 0.1)


def test_wrong_shapes_are_refused() -> None:
    thread, surface, triangles = sample("even", 0)
    with pytest.raises(ValueError, match="triangles: expected"):
        Cells(chain(13), triangles[:, :2], surface)
    cells = Cells(chain(13), triangles, surface)
    with pytest.raises(ValueError, match="thread: segments name node 12"):
        cells.near(thread[:5].copy(), surface, 0.1)
    with pytest.raises(ValueError, match="surface: expected a C-ordered"):
        cells.near(thread, surface[:, ::-1], 0.1)
    with pytest.raises(ValueError, match="margin_mm"):
        cells.near(thread, surface, float("nan"))


def test_a_search_allocates_nothing() -> None:
    """What remains are the view of the pairs and a closure, below 2 kB; a search's arrays have 100 kB."""
    thread, surface, triangles = sample("even", 1)
    cells = Cells(chain(13), triangles, surface)
    kept, peak = kept_bytes(lambda: cells.near(thread, surface, 0.3))
    assert kept < ARRAY_HEADER
    assert peak < 2048


SCRIPT = """
import numpy as np
from contact_samples import KINDS, chain, sample
from test_cells import searched
print(np.concatenate([searched(kind, 5) for kind in KINDS]).tobytes().hex())
"""


def searched(kind: str, seed: int) -> np.ndarray:
    """What all three searches find, as one array."""
    thread, surface, triangles = sample(kind, seed)
    segments = chain(len(thread))
    search = SphereSearch(SphereTree(segments, thread), SphereTree(triangles, surface))
    found = [
        Cells(segments, triangles, surface).near(thread, surface, 0.2),
        search.near(0.2),
        SelfContact(segments).near(thread, 0.2),
    ]
    return np.concatenate(found)


def test_uncompiled_kernels_find_the_same() -> None:
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(["tests/mechanics", "."])}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=Path(__file__).parents[2],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    expected = np.concatenate([searched(kind, 5) for kind in KINDS])
    assert len(expected) > 100
    assert done.stdout.strip() == expected.tobytes().hex()


@settings(max_examples=20)
@given(samples)
def test_the_same_search_gives_the_same_bytes(case: Case) -> None:
    thread, surface, triangles = case
    cells = Cells(chain(13), triangles, surface)
    first = cells.near(thread, surface, 0.3).tobytes()
    cells.near(thread + 1.0, surface, 0.1)
    assert cells.near(thread, surface, 0.3).tobytes() == first
