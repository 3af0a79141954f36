"""The tree of bounding spheres holds what it bounds, and finds the pairs that are near: all and no others."""

from __future__ import annotations

import numpy as np
import pytest
from allocations import ARRAY_HEADER, kept_bytes
from contact_samples import all_pairs, chain, margins, sample, samples
from hypothesis import given
from hypothesis import strategies as st

from trainer.mechanics.bounding_spheres import SphereSearch, SphereTree

Case = tuple[np.ndarray, np.ndarray, np.ndarray]


def assert_bounded(tree: SphereTree) -> None:
    """Each leaf's sphere holds its element's corners, each inner node's sphere those of its children.

    Up to the rounding that the tree itself states and adds to every margin.
    """
    m = len(tree.elements)
    centre, radius = tree.spheres[:, :3], tree.spheres[:, 3]
    assert sorted(tree.leaf_element) == list(range(m))
    corners = tree.x[tree.elements[tree.leaf_element]]
    far = np.linalg.norm(corners - centre[m - 1 :, None], axis=2).max(axis=1)
    assert np.all(far <= radius[m - 1 :] + tree.rounding_mm)
    for child in range(1, 2 * m - 1):
        parent = (child - 1) // 2
        apart = np.linalg.norm(centre[child] - centre[parent])
        assert apart + radius[child] <= radius[parent] + tree.rounding_mm


@given(samples, samples)
def test_every_sphere_holds_what_is_below_it_before_and_after_a_refit(case: Case, later: Case) -> None:
    thread, surface, triangles = case
    for elements, x, then in ((triangles, surface, later[1]), (chain(13), thread, later[0])):
        tree = SphereTree(elements, x)
        assert_bounded(tree)
        tree.refit(then)
        assert_bounded(tree)


@given(st.integers(1, 70))
def test_a_tree_of_any_size_has_each_element_once(m: int) -> None:
    x = np.random.default_rng(m).normal(size=(m + 1, 3))
    assert_bounded(SphereTree(chain(m + 1), x))


@given(samples, samples, margins)
def test_the_pairs_are_those_of_looking_at_all_after_a_refit(case: Case, later: Case, margin: float) -> None:
    thread, surface, triangles = case
    segments = chain(13)
    first, second = SphereTree(segments, thread), SphereTree(triangles, surface)
    search = SphereSearch(first, second)
    for p, x in ((thread, surface), (later[0], later[1])):
        first.refit(p)
        second.refit(x)
        found = [(int(a), int(b)) for a, b in search.near(margin)]
        assert found == all_pairs(p, segments, x, triangles, margin)


@given(samples, margins)
def test_two_threads_are_compared_as_well(case: Case, margin: float) -> None:
    """A segment is a triangle whose last corners are one; so says the law, and so looks the search at all pairs."""
    thread, surface, _ = case
    segments, others = chain(13), chain(30)
    search = SphereSearch(SphereTree(segments, thread), SphereTree(others, surface))
    found = [(int(a), int(b)) for a, b in search.near(margin)]
    assert found == all_pairs(thread, segments, surface, others[:, [0, 1, 1]], margin)


def test_a_division_puts_neighbours_together() -> None:
    """Of 64 elements in a row the root's children get 32 each, left and right of the middle."""
    x = np.zeros((65, 3))
    x[:, 1] = np.random.default_rng(0).permutation(65)
    x = np.sort(x, axis=0)
    tree = SphereTree(chain(65), x)
    assert tree.spheres[0, 3] == pytest.approx(32.0)
    assert tree.spheres[1:3, 3] == pytest.approx([16.0, 16.0])


def test_bad_input_is_refused() -> None:
    thread, surface, triangles = sample("even", 0)
    tree = SphereTree(triangles, surface)
    with pytest.raises(ValueError, match="segments"):
        SphereSearch(tree, tree)
    with pytest.raises(ValueError, match="margin_mm"):
        SphereSearch(SphereTree(chain(13), thread), tree).near(-1.0)
    with pytest.raises(ValueError, match="name node 29"):
        tree.refit(surface[:29].copy())
    surface[2, 0] = np.nan
    with pytest.raises(ValueError, match="node 2"):
        tree.refit(surface)


def test_nothing_is_near_nothing() -> None:
    thread, _, _ = sample("even", 0)
    none = SphereTree(np.empty((0, 3), dtype=np.int32), np.empty((0, 3)))
    assert SphereSearch(SphereTree(chain(13), thread), none).near(1.0).shape == (0, 2)


def test_refit_and_search_allocate_nothing() -> None:
    """What remains are views and a closure, below 2 kB at any time; the tree's arrays are 6 kB, the pairs' 130 kB."""
    thread, surface, triangles = sample("even", 1)
    first, second = SphereTree(chain(13), thread), SphereTree(triangles, surface)
    search = SphereSearch(first, second)

    def tick() -> None:
        first.refit(thread)
        second.refit(surface)
        search.near(0.3)

    kept, peak = kept_bytes(tick)
    assert kept < ARRAY_HEADER
    assert peak < 2048
