"""Cuts go where the knife goes, tissue springs back, joins hold, and nothing is lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from volume_samples import SPACING, block, check_structure, in_cell, material, random_shape, seeds, worst_violation

from trainer.mechanics.elastic_relaxation import relax
from trainer.mechanics.incision import cut, erase, overstretched, tear
from trainer.mechanics.islands import islands
from trainer.mechanics.joining import join
from trainer.mechanics.occupancy import OccupancyMap, surface_elements
from trainer.mechanics.volume import LINKS, PRESENT, Volume, VolumeState, build, places, start, tack, untack
from trainer.mechanics.volume_drag import drag

ONE = (1.0, 1.0, 1.0)


def cut_across(volume: Volume, state: VolumeState, x: float, wide: float = 100.0):  # type: ignore[no-untyped-def]
    """A knife's edge along y goes down along z at ``x``."""
    return cut(volume, state, [(x, -wide, wide), (x, wide, wide)], [(x, -wide, -wide), (x, wide, -wide)])


def test_a_cut_through_a_bar_breaks_the_links_of_one_cross_section() -> None:
    volume = block((10, 4, 3))
    state = start(volume)
    done = cut_across(volume, state, 4.5 * SPACING[0])
    assert done.links == 12
    assert done.area_mm2 == pytest.approx(12 * SPACING[1] * SPACING[2])
    assert done.volume_mm3 == {1: pytest.approx(24 * volume.element_mm3)}
    np.testing.assert_array_equal(np.unique(np.unravel_index(done.elements, volume.shape)[0]), [4, 5])
    check_structure(volume, state)
    again = cut_across(volume, state, 4.5 * SPACING[0])
    assert (again.links, len(again.elements), again.volume_mm3) == (0, 0, {})
    parts = islands(state, volume)
    assert sorted(len(part) for part in parts) == [60, 60]


def test_a_cut_of_half_the_depth_leaves_one_body() -> None:
    volume = block((10, 4, 3), spacing=ONE)
    state = start(volume)
    done = cut(volume, state, [(4.5, -9, 9), (4.5, 9, 9)], [(4.5, -9, 0.5), (4.5, 9, 0.5)])
    assert done.links == 8
    assert len(islands(state, volume)) == 1


@given(seeds)
def test_a_cut_breaks_what_straddles_its_plane_wherever_tissue_went(seed: int) -> None:
    """For a knife wider than the tissue: exactly the links whose ends are now on different sides of its plane. An
    element within 1e-6 mm of it (seven in 100 000 volumes have one) is on neither by rounding."""
    rng = np.random.default_rng(seed)
    labels = random_shape(seed, (6, 7, 8), 0.2)
    volume = build(labels, SPACING, {1: material()})
    state = start(volume)
    soft = np.flatnonzero(labels)
    for _ in range(3):
        drag(volume, state, rng.choice(soft, 1), rng.normal(size=3) * 3.0)
    everything = np.arange(labels.size, dtype=np.int32)
    at = places(volume, state, everything)
    way, across = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] * 1000.0
    middle = at[soft].mean(axis=0)
    normal = np.cross(way, across)
    before = state.links.copy()
    edge0, edge1 = middle - way, middle + way
    done = cut(volume, state, [edge0 - across, edge0 + across], [edge1 - across, edge1 + across])
    side = (at - middle) @ normal >= 0.0
    assume(np.abs((at[soft] - middle) @ normal).min() > 1e-6 * 1e6)
    count = 0
    for axis in range(3):
        a = np.flatnonzero(before & (1 << 2 * axis))
        b = a + volume.strides[axis]
        through = side[a] != side[b]
        assert np.array_equal((state.links[a] & (1 << 2 * axis)) == 0, through)
        count += np.count_nonzero(through)
    assert done.links == count
    check_structure(volume, state)


def test_cut_tissue_springs_back() -> None:
    """The paper's Fig. 10: a strand between two bones is stretched, tacked and cut; both ends go back to their rest
    places, to what is asleep: STILL over the slowest rate of a strand of 6 with one free end."""
    labels = np.ones((14, 2, 2), np.uint8)
    labels[0] = labels[-1] = 5
    volume = build(labels, ONE, {1: material(stretch=1.5, time_constant_s=0.05)})
    state = start(volume)
    numbers = np.arange(labels.size).reshape(labels.shape)
    held = numbers[7].ravel()
    drag(volume, state, held, (0.0, 3.0, 0.0))
    tack(state, held)
    relax(volume, state, 2.0)
    assert worst_violation(volume, state) < 1.0
    stretched = np.abs(state.u[1, numbers[3].ravel()]).max()
    assert stretched > 0.5
    done = cut_across(volume, state, 5.5)
    assert done.links == 4
    relax(volume, state, 0.1)
    assert np.abs(state.u[1, numbers[3].ravel()]).max() < stretched
    relax(volume, state, 200.0)
    assert state.awake is None
    np.testing.assert_allclose(state.u[1, numbers[1:6].ravel()], 0.0, atol=1e-5 / (0.1175 * (np.pi / 12) ** 2 / 6))
    np.testing.assert_allclose(state.u[1, numbers[6].ravel()], 3.0, atol=0.02)


def test_a_knife_does_not_cut_bone_and_not_where_it_is_not() -> None:
    labels = np.full((6, 6, 6), 5, np.uint8)
    labels[:, :, 3:] = 1
    volume = build(labels, ONE, {1: material()})
    state = start(volume)
    assert cut_across(volume, state, 50.0).links == 0
    done = cut(volume, state, [(2.5, -9, 9), (2.5, 9, 9)], [(2.5, -9, -9), (2.5, 9, -9)])
    assert done.links == 18
    assert done.volume_mm3 == {1: 36.0}
    assert cut(volume, state, [(1.5, 1, 1), (1.5, 2, 1)], [(1.5, 1, 1), (1.5, 2, 1)]).links == 0  # it did not move


def test_tissue_tears_where_it_hangs_on_bone_and_no_earlier_than_its_limit() -> None:
    """A strand of 6 links to bone, each of which gives 0.2 h: a pull below 1.2 h leaves it whole, more does not."""
    for pull, links in ((1.19, 0), (1.25, 1)):
        labels = np.ones((7, 1, 1), np.uint8)
        labels[0] = 5
        volume = build(labels, ONE, {1: material(1.2)})
        state = start(volume)
        tack(state, np.array([6]))
        drag(volume, state, np.array([6]), (pull, 0.0, 0.0))
        done = tear(volume, state)
        assert done.links == links
        assert done.volume_mm3 == ({} if not links else {1: 1.0, 5: 1.0})
        assert not len(overstretched(volume, state))
        check_structure(volume, state)


def test_a_block_pulled_apart_by_two_instruments_tears() -> None:
    volume = block((12, 4, 4), material(1.2))
    state = start(volume)
    numbers = np.arange(volume.labels.size).reshape(volume.shape)
    for held in (numbers[0].ravel(), numbers[-1].ravel()):
        tack(state, held)
    drag(volume, state, numbers[0].ravel(), (-4.0, 0.0, 0.0))
    drag(volume, state, numbers[-1].ravel(), (4.0, 0.0, 0.0))
    done = tear(volume, state)
    assert done.links >= 16
    assert len(islands(state, volume)) >= 2
    assert np.isfinite(state.u).all()
    check_structure(volume, state)


def test_what_moving_neighbours_can_resolve_does_not_tear() -> None:
    """A horseshoe, pulled at one end so that the two fronts meet behind the hole out of step."""
    labels = np.ones((14, 14, 1), np.uint8)
    labels[4:10, :9] = 0
    volume = build(labels, ONE, {1: material(1.1, 0.9, 0.05)})
    state = start(volume)
    drag(volume, state, np.array([0]), (4.0, 3.0, 0.0))
    assert tear(volume, state).links == 0
    assert len(islands(state, volume)) == 1


def test_joining_a_cut_gives_the_old_links_back() -> None:
    volume = block((8, 3, 3), spacing=ONE)
    state = start(volume)
    whole = state.links.copy()
    cut_across(volume, state, 3.5)
    done = join(volume, state, [(3.5, -1.0, 1.0), (3.5, 3.0, 1.0)], 2.0, 1.5)
    assert done.links == 9
    np.testing.assert_array_equal(state.links, whole)
    assert not len(state.seams.ends)
    assert join(volume, state, [(3.5, -1.0, 1.0), (3.5, 3.0, 1.0)], 0.9, 1.5).links == 0


def test_joining_across_a_gap_draws_the_ends_together_and_holds() -> None:
    """Two blocks three lengths apart: seams, whose ends are then one rest length apart; a pull at the one moves the
    other; a cut through the seams lets go."""
    labels = np.ones((13, 2, 2), np.uint8)
    labels[5:8] = 0
    volume = build(labels, ONE, {1: material(1.05, 0.95, 0.05)})
    state = start(volume)
    path = [(6.0, -1.0, 0.5), (6.0, 2.0, 0.5)]
    assert join(volume, state, path, 1.0, 5.0).links == 0  # nobody within reach of the path
    assert join(volume, state, path, 3.0, 2.0).links == 0  # nobody near enough to another
    done = join(volume, state, path, 3.0, 5.0)
    assert done.links == len(state.seams.ends) == 4
    for a, b in state.seams.ends:
        np.testing.assert_allclose(
            np.diff(places(volume, state, np.array([a, b])), axis=0)[0], (1, 0, 0), atol=0.05 + 1e-5
        )
    assert len(islands(state, volume)) == 1
    drag(volume, state, np.array([0]), (-20.0, 0.0, 0.0))
    assert np.all(state.u[0, labels.reshape(-1) == 1] < -5.0)
    assert tear(volume, state).links == 0
    relax(volume, state, 0.5)
    middle = places(volume, state, state.seams.ends.ravel()).mean(axis=0)[0]
    assert cut_across(volume, state, middle).links == 4
    assert not len(state.seams.ends)
    assert len(islands(state, volume)) == 2


def test_erasing_takes_elements_and_their_links_away() -> None:
    volume = block((5, 5, 5), spacing=(0.5, 1.0, 2.0))
    state = start(volume)
    done = erase(volume, state, np.array([62, 62, 63]))
    assert len(done.elements) == 2
    assert done.links == 11
    assert done.volume_mm3 == {1: 2.0}
    assert state.free_count == 123
    check_structure(volume, state)
    assert erase(volume, state, np.array([62])).volume_mm3 == {}
    untack(volume, state, np.array([62]))
    assert state.free_count == 123


def test_tacked_tissue_stays_until_it_is_let_go() -> None:
    volume = block((6, 6, 6))
    state = start(volume)
    tack(state, np.array([7, 7, 8]))
    assert state.free_count == 214
    drag(volume, state, np.array([0]), (9.0, 0.0, 0.0))
    assert not state.u[:, [7, 8]].any()
    untack(volume, state, np.array([7, 8, 8]))
    assert state.free_count == 216
    drag(volume, state, np.array([0]), (10.0, 0.0, 0.0))
    assert np.all(state.u[0, [7, 8]] > 0.0)


def test_labels_that_touch_along_an_edge_only_do_not_hang_together() -> None:
    labels = np.zeros((2, 2, 1), np.uint8)
    labels[0, 0], labels[1, 1] = 1, 2
    volume = build(labels, ONE, {1: material(), 2: material()})
    state = start(volume)
    assert not np.any(state.links & LINKS)
    assert len(islands(state, volume)) == 2
    assert drag(volume, state, np.array([0]), (5.0, 0.0, 0.0)).count == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_instrument_at_no_place_is_refused(bad: float) -> None:
    volume = block((3, 3, 3))
    state = start(volume)
    with pytest.raises(ValueError, match="finite"):
        cut(volume, state, [(bad, 0, 0), (1, 1, 1)], [(0, 0, 0), (1, 1, 0)])
    with pytest.raises(ValueError, match="finite"):
        join(volume, state, [(bad, 0, 0), (1, 1, 1)], 1.0, 1.0)
    assert np.all(state.links & PRESENT)


ACTIONS = ("move", "relax", "cut", "join", "tear", "tack", "untack", "erase")


@settings(max_examples=60)
@given(seeds, st.lists(st.sampled_from(ACTIONS), min_size=1, max_size=14))
def test_whatever_is_done_elements_links_and_cells_add_up(seed: int, actions: list[str]) -> None:
    """Elements are as many as before but for the erased; links are symmetric and within the volume; what is free is
    counted; rigid elements are where they were; and an element is in one cell, the one where it is."""
    rng = np.random.default_rng(seed)
    labels = random_shape(seed, (6, 5, 7), float(rng.uniform(0, 0.4)), 0.1, soft=int(rng.integers(1, 3)))
    volume = build(
        labels, SPACING, {int(v): material(1.1 + 0.3 * v, 0.6, 0.3) for v in np.unique(labels) if v in (1, 2)}
    )
    state = start(volume)
    there = np.count_nonzero(labels)
    everything = np.flatnonzero(labels).astype(np.int32)
    soft = everything[np.isin(labels.reshape(-1)[everything], (1, 2))]
    index = np.stack(np.unravel_index(everything, volume.shape), axis=1)
    cells = OccupancyMap((-9.0,) * 3, (12.0,) * 3, 0.6, [index])
    for action in actions:
        some = rng.choice(soft, size=min(4, len(soft)), replace=False)
        if action == "move":
            here = some[(state.links[some] & PRESENT) != 0]
            if len(here):
                drag(volume, state, here, state.u[:, here].T + rng.normal(size=3))
        elif action == "relax":
            relax(volume, state, 0.05)
        elif action == "cut":
            cut(volume, state, rng.normal(size=(2, 3)) * 4 + 2, rng.normal(size=(2, 3)) * 4 + 2)
        elif action == "join":
            join(volume, state, rng.normal(size=(2, 3)) * 2 + 2, 2.0, 1.5)
        elif action == "tear":
            tear(volume, state)
        elif action == "tack":
            tack(state, some)
        elif action == "untack":
            untack(volume, state, some)
        else:
            there -= len(erase(volume, state, some[:1]).elements)
        check_structure(volume, state)
        assert np.count_nonzero(state.links & PRESENT) == there
        assert not np.any(state.u[:, labels.reshape(-1) == 9])
        assert sum(len(part) for part in islands(state, volume)) == there
        at = places(volume, state, everything)
        cells.update(0, at)
        seen: dict[int, int] = {}
        for cell in {cells.cell_of(s) for s in range(len(everything))} - {-1}:
            for s in in_cell(cells, cell):
                assert s not in seen
                seen[s] = cell
        inside = np.all((at >= -9.0) & (at < 12.0), axis=1)
        assert len(seen) == np.count_nonzero(inside)
        for a, b in state.seams.ends:
            assert state.links[a] & state.links[b] & PRESENT


def test_the_surface_is_what_lacks_a_link() -> None:
    volume = block((5, 5, 5))
    state = start(volume)
    assert len(surface_elements(state)) == 125 - 27
    cut_across(volume, state, 1.5 * SPACING[0])
    assert len(surface_elements(state)) == 125 - 9
