"""ChainMail keeps its limits, in lists and by scan to the same bit, and in closed form where there is one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from volume_samples import SPACING, block, check_structure, cut_some, material, random_shape, seeds, worst_violation

from trainer.mechanics.chainmail import widen
from trainer.mechanics.chainmail_scan import RUN
from trainer.mechanics.volume import FREE, Volume, VolumeError, VolumeState, build, places, start, tack
from trainer.mechanics.volume_drag import drag

#: Displacements are float32: sums of a way of n links err by n half units in the last place of the largest.
EPS = float(np.finfo(np.float32).eps)
METHODS = ("lists", "scan")


def rounding(state: VolumeState, links: int) -> float:
    """What limits may be missed by: each element is placed within one rounding of its sponsor, and the sums along two
    ways of ``links`` links from the moved element to it may round differently in each."""
    return 2.0 * links * EPS * max(float(np.abs(state.u).max()), 1.0)


def middle(volume: Volume) -> int:
    i, j, k = (n // 2 for n in volume.shape)
    return int(np.ravel_multi_index((i, j, k), volume.shape))


@pytest.mark.parametrize("method", METHODS)
def test_a_bar_stretches_link_by_link_to_its_limit(method: str) -> None:
    """A bar of links h, pulled at its end by p along itself: each link gives s = (stretch − 1) h, so element m from
    the end goes p − m s while that is above 0, and no further element moves. Pushed, each gives (1 − compression) h;
    aside, shear h."""
    h, n = SPACING[0], 40
    for displacement, each in (
        ((3.14, 0.0, 0.0), 0.2 * h),
        ((-2.37, 0.0, 0.0), 0.2 * h),
        ((0.0, 1.71, 0.0), 0.25 * h),
        ((0.0, 0.0, -1.13), 0.25 * h),
    ):
        volume = block((n, 1, 1), material(stretch=1.2, compression=0.8, shear=0.25))
        state = start(volume)
        moved = drag(volume, state, np.array([n - 1]), displacement, method)
        axis = int(np.argmax(np.abs(displacement)))
        pull = displacement[axis]
        expected = np.sign(pull) * np.maximum(abs(pull) - each * np.arange(n)[::-1], 0.0)
        np.testing.assert_allclose(state.u[axis], expected, atol=n * EPS * abs(pull))
        assert moved.count == np.count_nonzero(expected)
        assert (moved.lowest[0], moved.highest[0]) == (n - moved.count, n - 1)


@pytest.mark.parametrize("shape", [(7, 1, 49), (50, 48, 49), (1290, 1290, 1290), (2, 2, 2**29 - 1), (1, 2**31 - 1, 1)])
@given(seeds)
def test_the_box_of_what_moved_is_that_of_its_indices(shape: tuple[int, int, int], seed: int) -> None:
    """Also of elements at the ends of rows and planes, up to the largest number that an element may have; and of rows
    and planes of 49, since 49 (1/49) is below 1 in floating point."""
    _, ny, nz = shape
    rng = np.random.default_rng(seed)
    n = int(np.prod(shape, dtype=np.int64))
    ends = rng.integers(1, n // (ny * nz) * ny + 1, 20) * nz
    elements = np.concatenate([rng.integers(0, n, 20), ends - 1, ends % n, [n - 1]]).astype(np.int32)
    rng.shuffle(elements)
    some = elements[: rng.integers(1, len(elements))]
    box = np.array([shape[0], -1, ny, -1, nz, -1])
    widen(some, 0, len(some), np.array([ny * nz, -ny * nz, nz, -nz, 1, -1, *shape]), box)
    index = np.stack(np.unravel_index(some, shape))
    assert np.array_equal(box[0::2], index.min(axis=1))
    assert np.array_equal(box[1::2], index.max(axis=1))


@pytest.mark.parametrize("axis", range(3))
def test_limits_are_each_axis_own(axis: int) -> None:
    """With limits (1.1, 1.2, 1.4) along x, y, z a pull along an axis is taken up by that axis's links."""
    of = material()
    of = type(of)(
        **{**of.__dict__, "stretch": (1.1, 1.2, 1.4), "compression": (0.9, 0.7, 0.5), "shear": (0.0, 0.1, 0.2)}
    )
    shape = [1, 1, 1]
    shape[axis] = 10
    volume = block((shape[0], shape[1], shape[2]), of)
    h = SPACING[axis]
    for pull, each in ((1.0, (of.stretch[axis] - 1.0) * h), (-1.0, (1.0 - of.compression[axis]) * h)):
        state = start(volume)
        displacement = [0.0, 0.0, 0.0]
        displacement[axis] = pull
        drag(volume, state, np.array([9]), displacement)
        expected = np.sign(pull) * np.maximum(abs(pull) - each * np.arange(10)[::-1], 0.0)
        np.testing.assert_allclose(state.u[axis], expected, atol=10 * EPS)


@given(seeds, st.integers(1, 9), st.integers(1, 9), st.integers(1, 24), st.integers(1, 3))
def test_a_block_stays_within_its_limits_and_both_methods_agree(
    seed: int, nx: int, ny: int, nz: int, pulls: int
) -> None:
    """The theorem of Gibson 1997, for any limits and a volume within them: so it is for each pull after the first."""
    rng = np.random.default_rng(seed)
    of = material(float(rng.uniform(1, 1.5)), float(rng.uniform(0.4, 1)), float(rng.uniform(0, 0.5)))
    volume = block((nx, ny, nz), of)
    states = [start(volume), start(volume)]
    for _ in range(pulls):
        held = np.array([rng.integers(0, volume.labels.size)], dtype=np.int32)
        to = states[0].u[:, held[0]] + rng.normal(size=3) * rng.choice([0.1, 1.0, 10.0])
        counts = [drag(volume, state, held, to, method).count for state, method in zip(states, METHODS, strict=True)]
        assert counts[0] == counts[1]
        assert np.array_equal(states[0].u, states[1].u)
        assert worst_violation(volume, states[0]) <= rounding(states[0], nx + ny + nz)


@given(seeds, st.integers(1, 4))
def test_both_methods_agree_in_any_shape(seed: int, held_count: int) -> None:
    """Holes, bone, cuts, tacked elements, several held: the same places to the last bit, the same elements moved."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(1, 12, size=3))
    labels = random_shape(seed, (shape[0], shape[1], shape[2]), float(rng.uniform(0, 0.5)), float(rng.uniform(0, 0.1)))
    volume = build(labels, SPACING, {1: material(shear=float(rng.uniform(0, 0.4)))})
    states = [start(volume), start(volume)]
    soft = np.flatnonzero(labels.reshape(-1) == 1).astype(np.int32)
    for state in states:
        cut_some(volume, state, seed, 0.1)
        tack(state, soft[::17])
    for _ in range(3):
        held = rng.choice(soft, size=min(held_count, len(soft)), replace=False)
        to = states[0].u[:, held].T + rng.normal(size=(len(held), 3))
        done = [drag(volume, state, held, to, method) for state, method in zip(states, METHODS, strict=True)]
        assert done[0].count == done[1].count
        assert np.array_equal(states[0].u, states[1].u)
        assert np.array_equal(states[0].mark, states[1].mark)
        assert np.array_equal(done[0].lowest, done[1].lowest)
        assert np.array_equal(done[0].highest, done[1].highest)
        check_structure(volume, states[0])


@pytest.mark.parametrize("void", [0.0, 0.2])
def test_both_methods_agree_where_a_plane_is_longer_than_a_run(void: float) -> None:
    """A plane of two and a half runs of the scan: whole and with holes, far and near."""
    shape = (4, 80, 128)
    assert 2 * RUN < shape[1] * shape[2] < 3 * RUN
    volume = build(random_shape(0, shape, void), SPACING, {1: material()})
    states = [start(volume), start(volume)]
    held = np.flatnonzero(volume.labels.reshape(-1)).astype(np.int32)[1000:1001]
    for pull in (90.0, 5.0, -1.0):
        for state, method in zip(states, METHODS, strict=True):
            assert drag(volume, state, held, (pull, -0.5 * pull, 0.2), method).method == method
        assert np.array_equal(states[0].u, states[1].u)
        assert np.array_equal(states[0].mark, states[1].mark)


@pytest.mark.parametrize("method", METHODS)
def test_work_grows_no_faster_than_what_moves(method: str) -> None:
    """Only neighbours of what moves are considered, and each once: at most six for each that moved, and of larger pulls
    a smaller share, since they are the surface of the moved: in logarithms considered against moved has a slope below 1
    (and above 2/3, that of a surface)."""
    volume = block((48, 48, 48))
    moved, considered = [], []
    for length in (0.5, 1.0, 2.0, 4.0):
        state = start(volume)
        moved.append(drag(volume, state, np.array([middle(volume)]), length * np.array(SPACING), method).count)
        considered.append(np.count_nonzero(state.mark))
    assert 0 < moved[0] < 30 < 3000 < moved[-1] < volume.labels.size // 4
    assert all(m <= c <= 7 * m for m, c in zip(moved, considered, strict=True))
    slope = np.polyfit(np.log(moved), np.log(considered), 1)[0]
    assert 2.0 / 3.0 < slope < 1.0


def test_the_extent_is_that_of_what_moved() -> None:
    for method in METHODS:
        volume = block((9, 10, 11))
        state = start(volume)
        done = drag(volume, state, np.array([middle(volume)]), (0.3, 0.2, 0.1), method)
        moved = np.argwhere(np.any(state.u != 0.0, axis=0).reshape(volume.shape))
        assert done.count == len(moved)
        np.testing.assert_array_equal(done.lowest, moved.min(axis=0))
        np.testing.assert_array_equal(done.highest, moved.max(axis=0))


@pytest.mark.parametrize("method", METHODS)
def test_a_pull_goes_around_a_hole(method: str) -> None:
    """Two blocks side by side that hang together at the far end only: the second is reached from behind."""
    labels = np.ones((12, 5, 3), np.uint8)
    labels[:10, 2] = 0
    volume = build(labels, SPACING, {1: material(1.0, 1.0, 0.0)})  # nothing gives
    state = start(volume)
    done = drag(volume, state, np.array([0]), (1.0, 2.0, 3.0), method)
    assert done.count == np.count_nonzero(labels) == state.free_count
    np.testing.assert_array_equal(
        state.u[:, labels.reshape(-1) == 1].T, np.tile(np.float32([1, 2, 3]), (done.count, 1))
    )


def test_a_pull_of_a_hundred_lengths_keeps_the_limits() -> None:
    volume = block((20, 20, 20))
    state = start(volume)
    done = drag(volume, state, np.array([middle(volume)]), (100 * SPACING[0], -100 * SPACING[1], 100 * SPACING[2]))
    assert done.count == volume.labels.size
    assert worst_violation(volume, state) <= rounding(state, 60)


def test_bone_stays_where_it_is() -> None:
    labels = np.ones((10, 4, 4), np.uint8)
    labels[0] = 5
    volume = build(labels, SPACING, {1: material()})
    state = start(volume)
    drag(volume, state, np.array([volume.labels.size - 1]), (3.0, 0.0, 0.0))
    assert not np.any(state.u[:, labels.reshape(-1) == 5])
    np.testing.assert_array_equal(places(volume, state, np.array([0])), [[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("shape", [(30, 30, 1), (1, 30, 30), (30, 1, 30), (30, 1, 1)])
def test_a_sheet_and_a_strand_are_volumes_too(shape: tuple[int, int, int]) -> None:
    volume = block(shape)
    state = start(volume)
    drag(volume, state, np.array([middle(volume)]), (1.0, 2.0, 3.0))
    assert worst_violation(volume, state) <= rounding(state, 60)
    assert np.isfinite(state.u).all()


@given(seeds)
def test_the_order_does_not_matter_in_a_block_of_one_material(seed: int) -> None:
    """Every shortest way asks for the same place, so that renaming the axes changes results by rounding only."""
    rng = np.random.default_rng(seed)
    of = material(float(rng.uniform(1, 1.5)), float(rng.uniform(0.4, 1)), float(rng.uniform(0, 0.5)))
    volume = block((5, 6, 7), of)
    turned = block((7, 6, 5), of, SPACING[::-1])
    state, other = start(volume), start(turned)
    for _ in range(2):
        at = tuple(int(rng.integers(0, n)) for n in volume.shape)
        by = rng.normal(size=3)
        drag(volume, state, np.array([np.ravel_multi_index(at, volume.shape)]), by)
        drag(turned, other, np.array([np.ravel_multi_index(at[::-1], turned.shape)]), by[::-1])
    seen = other.u.reshape(3, *turned.shape).transpose(0, 3, 2, 1)[::-1]
    np.testing.assert_allclose(state.u.reshape(3, *volume.shape), seen, atol=rounding(state, 18))


def test_in_a_shape_with_holes_the_order_matters_and_this_much() -> None:
    """Around a hole ways of different limits meet, and the first that comes decides; what the other asks for is left
    over. Its size in a block with 30 % holes, pulled by two element lengths: below the limit of one link, since the
    two ways' ends are neighbours and each was within its own."""
    worst = 0.0
    for seed in range(20):
        labels = random_shape(seed, (12, 12, 12), 0.3)
        volume = build(labels, SPACING, {1: material()})
        state = start(volume)
        soft = np.flatnonzero(labels.reshape(-1) == 1)
        drag(volume, state, soft[len(soft) // 2 : len(soft) // 2 + 1], (2 * SPACING[0], 2 * SPACING[1], 0.0))
        worst = max(worst, worst_violation(volume, state))
    assert 0.0 < worst < max(SPACING)


@pytest.mark.parametrize(
    ("held", "to", "word"),
    [
        ([0], (np.nan, 0, 0), "finite"),
        ([0], (np.inf, 0, 0), "finite"),
        ([], (0, 0, 0), "holds no"),
        ([-1], (0, 0, 0), "not there"),
        ([27], (0, 0, 0), "not there"),
        ([1], (0, 0, 0), "not there"),
        ([2], (0, 0, 0), "rigid"),
        ([0, 0], (0, 0, 0), "twice"),
    ],
)
def test_what_cannot_be_dragged_is_refused(held: list[int], to: tuple[float, ...], word: str) -> None:
    labels = np.ones((3, 3, 3), np.uint8)
    labels[0, 0, 1], labels[0, 0, 2] = 0, 7
    volume = build(labels, SPACING, {1: material()})
    state = start(volume)
    with pytest.raises(VolumeError, match=word):
        drag(volume, state, np.array(held, dtype=np.int32), to)
    assert not state.u.any()


def test_marks_are_wiped_in_time() -> None:
    """After 300 moves of which each touches all, a mark of an old one is never taken for one of the last."""
    volume = block((4, 4, 4), material(1.0, 1.0, 0.0))
    state = start(volume)
    for step in range(300):
        assert drag(volume, state, np.array([step % 64]), (step + 1.0, 0.0, 0.0)).count == 64
    assert np.all(state.u[0] == 300.0)
    assert np.all(state.links & FREE)
