"""What a hand sees of a region: how far a way is free, and by what a cut structure still holds together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.curriculum import load_task
from trainer.interactions import region as regions
from trainer.interactions.region import Region
from trainer.interactions.sight import PAST_MM, free_mm, uncut_at
from trainer.mechanics.islands import islands
from trainer.mechanics.volume import STEPS, grid_strides

TASK = load_task("arthroscopy/ligament-release").task
PCL = "posterior cruciate ligament"


def build() -> Region:
    assert TASK.scene.anatomy is not None
    return regions.build(TASK, TASK.scene.anatomy)


@pytest.fixture(scope="module")
def whole() -> Region:
    return build()


def part(region: Region, elements: np.ndarray, step: int) -> None:
    """Break the links of ``elements`` in one direction, on both sides."""
    linked = elements[(region.state.links[elements] & (1 << step)) != 0]
    others = linked + grid_strides(region.volume)[step]
    region.state.links[linked] &= np.uint8(0xFF ^ (1 << step))
    region.state.links[others] &= np.uint8(0xFF ^ (1 << (step ^ 1)))
    region.opened[PCL] = np.union1d(region.opened.get(PCL, linked), [*linked, *others]).astype(np.int32)


def holds(region: Region) -> bool:
    """Whether something leads through the ligament from one end to the other."""
    heights = [region.rest(np.intersect1d(p, region.elements[PCL]))[:, 1] for p in islands(region.state, region.volume)]
    return any(len(h) and h.min() < -8.0 and h.max() > 12.0 for h in heights)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_strands_between_cuts_at_two_levels_are_all_that_holds(step: int) -> None:
    """Cut on the one side at 5 mm, on the other so much higher, it holds; once all that is told is cut, too, and
    nothing is told any more, it is in two."""
    region = build()
    elements = region.elements[PCL]
    rest = region.rest(elements)
    place = np.array([0.0, 5.0, 0.0])
    assert len(uncut_at(region, PCL, place)) > 20
    up = STEPS.index((0, 1, 0))
    near = rest[:, 2] < 0.0
    level = rest[np.argmin(np.abs(rest[:, 1] - 5.0)), 1]
    part(region, elements[near & (np.abs(rest[:, 1] - level) < 0.1)], up)
    part(region, elements[~near & (np.abs(rest[:, 1] - level - step * region.volume.spacing_mm[1]) < 0.1)], up)
    assert holds(region)
    told = 0
    while len(strands := uncut_at(region, PCL, place)):
        told += len(strands)
        for direction in range(6):
            part(region, strands, direction)
    assert not holds(region)
    assert 0 < told < 0.1 * len(elements)


@given(st.floats(-30.0, 25.0), st.floats(-30.0, 30.0), st.integers(0, 2**32 - 1))
def test_a_free_way_meets_nothing_rigid_and_ends_before_what_is(whole: Region, x: float, y: float, seed: int) -> None:
    """Along it and PAST_MM beside it no place is in bone; where it ends early, something rigid is no further than a
    step of half PAST_MM and PAST_MM to any side."""
    way = np.random.default_rng(seed).normal(size=3)
    way /= np.linalg.norm(way)
    start = np.array([x, y, 0.0])

    def rigid(place: np.ndarray) -> bool:
        return whole.structure_at(place) not in {"", *whole.elements}

    found = free_mm(whole, start, way, 20.0)
    sides = PAST_MM * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    if found > 0.0:
        along = np.arange(0.0, found, 0.5 * PAST_MM)
        assert not any(rigid(start + t * way + side) for t in along for side in 0.98 * sides)
    if found < 20.0:
        ends = [found + k * 0.5 * PAST_MM * 1.01 for k in (0, 1)]
        assert any(rigid(start + t * way + side) for t in ends for side in 1.02 * sides)
