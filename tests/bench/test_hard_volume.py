"""Hard cases of volumes and scans end as they must, and what breaks a law of volumes is found."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from trainer.bench import hard_scan, hard_volume
from trainer.bench.hard_volume import lawful
from trainer.bench.volume import TISSUE
from trainer.mechanics.volume import PRESENT, Volume, VolumeState, build, start

#: What must be refused; everything else must work.
REFUSED = (
    "pull to a place that is nan",
    "least length of a link above its greatest",
    "all of it erased",
    "labels kept as float32, one a half",
    "labels kept as int8, one below 0",
    "spacing that is nan",
    "file cut short",
    "file of four dimensions",
    "label map with femur and tibia exchanged",
    "label map with three labels that are not in the scan",
    "left and right exchanged, the map says which knee",
)


@pytest.mark.parametrize(
    ("case", "method", "run"),
    hard_volume.cases() + hard_scan.cases(),
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_hard_case_of_a_volume_or_scan(case: str, method: str, run: Callable[[], str]) -> None:
    """Its laws are asserted within."""
    assert run().startswith("refused: " if case in REFUSED else "ok: ")


def test_what_must_be_refused_are_cases() -> None:
    assert {case for case, _, _ in hard_volume.cases() + hard_scan.cases()} >= set(REFUSED)


def one_way_link(volume: Volume, state: VolumeState) -> None:
    state.links[0] &= np.uint8(0xFF ^ 1)


def lost(volume: Volume, state: VolumeState) -> None:
    state.links[0] &= np.uint8(0xFF ^ PRESENT)


def moved_bone(volume: Volume, state: VolumeState) -> None:
    state.u[1, np.flatnonzero(volume.labels.reshape(-1) == 2)[0]] = 1e-6


def no_number(volume: Volume, state: VolumeState) -> None:
    state.u[2, 3] = np.nan


def miscounted(volume: Volume, state: VolumeState) -> None:
    state.free_count += 1


@pytest.mark.parametrize(
    ("change", "law"),
    [
        (one_way_link, "not symmetric"),
        (lost, "26 elements of 27"),
        (moved_bone, "rigid"),
        (no_number, "finite"),
        (miscounted, "miscounted"),
    ],
)
def test_what_breaks_a_law_is_found(change: Callable[[Volume, VolumeState], None], law: str) -> None:
    """Without the change nothing is found."""
    labels = np.ones((3, 3, 3), np.uint8)
    labels[2] = 2
    volume = build(labels, (1.0, 1.0, 1.0), {1: TISSUE})
    state = start(volume)
    lawful(volume, state, 27)
    change(volume, state)
    with pytest.raises(AssertionError, match=law):
        lawful(volume, state, 27)
