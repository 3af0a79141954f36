"""Volumes for the tests: blocks, random shapes, and what must hold of them."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from trainer.mechanics.occupancy import OccupancyMap
from trainer.mechanics.volume import FREE, LINKS, PRESENT, Material, Volume, VolumeState, build

SPACING = (0.5, 0.6, 0.8)


def material(
    stretch: float = 1.2, compression: float = 0.8, shear: float = 0.25, name: str = "tissue", **elastic: float
) -> Material:
    """One that is alike along all axes."""
    constants = {"young_kPa": 100.0, "shear_kPa": 40.0, "time_constant_s": 0.1} | elastic
    return Material(name, (stretch,) * 3, (compression,) * 3, (shear,) * 3, **constants)


def block(
    shape: tuple[int, int, int], of: Material | None = None, spacing: tuple[float, float, float] = SPACING
) -> Volume:
    return build(np.ones(shape, np.uint8), spacing, {1: of or material()})


def random_shape(seed: int, shape: tuple[int, int, int], void: float, rigid: float = 0.0, soft: int = 1) -> np.ndarray:
    """Labels (nx, ny, nz): 1 … ``soft`` may move, 9 is rigid, 0 is void."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(1, soft + 1, size=shape).astype(np.uint8)
    dice = rng.random(shape)
    labels[dice < void] = 0
    labels[(dice >= void) & (dice < void + rigid)] = 9
    labels.reshape(-1)[:soft] = np.arange(1, soft + 1)
    return labels


def in_cell(where: OccupancyMap, cell: int) -> list[int]:
    """The entries of a cell of the map."""
    entries, s = [], int(where._head[cell])
    while s >= 0:
        entries.append(s)
        s = int(where._after[s])
    return entries


def cut_some(volume: Volume, state: VolumeState, seed: int, share: float) -> None:
    """Break a share of all links, both ways."""
    rng = np.random.default_rng(seed)
    for axis in range(3):
        step = volume.strides[axis]
        linked = np.flatnonzero(state.links & (1 << 2 * axis))
        gone = linked[rng.random(len(linked)) < share]
        state.links[gone] &= np.uint8(0xFF ^ (1 << 2 * axis))
        state.links[gone + step] &= np.uint8(0xFF ^ (2 << 2 * axis))


def worst_violation(volume: Volume, state: VolumeState, only_free: bool = False) -> float:
    """How far the worst link is beyond its limits, mm; negative is within. In float64, link by link."""
    worst = -np.inf
    labels = volume.labels.reshape(-1)
    for axis in range(3):
        step = volume.strides[axis]
        a = np.flatnonzero(state.links & (1 << 2 * axis))
        ma, mb = volume.material_of[labels[a]], volume.material_of[labels[a + step]]
        soft = (ma >= 0) & (mb >= 0)
        if only_free:
            soft &= ((state.links[a] & FREE) != 0) & ((state.links[a + step] & FREE) != 0)
        a, ma, mb = a[soft], ma[soft], mb[soft]
        if not len(a):
            continue
        apart = (state.u[:, a + step].astype(np.float64) - state.u[:, a]).T
        low, high = volume.low[ma, mb, 2 * axis], volume.high[ma, mb, 2 * axis]
        worst = max(worst, float(np.max(np.maximum(low - apart, apart - high))))
    return worst


def check_structure(volume: Volume, state: VolumeState) -> None:
    """Links are symmetric, lead to elements that are there, and what is free is there."""
    links = state.links.reshape(volume.shape)
    for d in range(6):
        axis = d // 2
        here = [slice(None)] * 3
        there = [slice(None)] * 3
        here[axis], there[axis] = (slice(None, -1), slice(1, None)) if d % 2 == 0 else (slice(1, None), slice(None, -1))
        forward = (links[tuple(here)] >> d) & 1
        backward = (links[tuple(there)] >> (d ^ 1)) & 1
        assert np.array_equal(forward, backward), f"direction {d}"
        edge = [slice(None)] * 3
        edge[axis] = slice(-1, None) if d % 2 == 0 else slice(0, 1)
        assert not np.any((links[tuple(edge)] >> d) & 1), "a link leads out of the volume"
    present = (state.links & PRESENT) != 0
    assert not np.any(state.links[~present] & (LINKS | FREE))
    assert np.count_nonzero(state.links & FREE) == state.free_count
    assert np.isfinite(state.u).all()


seeds = st.integers(0, 2**32 - 1)
