"""Rules of handled tissue, of hands that are told tick by tick."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainer import scene
from trainer.curriculum import load_task
from trainer.events import Cut, Event
from trainer.interactions.tissue_handling import DEAD_BAND
from trainer.poses import ToolPoses

TASK = load_task("arthroscopy/ligament-2d").task
GRASPER, SCISSORS = TASK.scene.instrument
#: The shaft is tilted, so that the blades pass through the layer all the while they close, not at the end alone.
LIGAMENT = replace(TASK, time_limit_s=1e4, scene=replace(TASK.scene, instrument=(
    GRASPER, replace(SCISSORS, home_rotation_deg=(90.0, 8.0, 150.0)))))  # fmt: skip
RIGHT = 1


def snips(closures: list[float], place: tuple[float, float, float] = (-4.0, 0.0, 0.0)) -> list[Cut]:
    """What scissors cut that stay at a ``place`` in the ligament and follow ``closures``, one in each tick."""
    s = scene.build(LIGAMENT)
    events: list[Event] = []
    for closure in [0.0, *closures]:
        now = s.view().poses
        position, jaws = now.position.copy(), now.closure.copy()
        position[RIGHT], jaws[RIGHT] = place, closure
        events += s.step(ToolPoses(position, now.quaternion, jaws, np.ones(2, dtype=bool)))
    return [e for e in events if isinstance(e, Cut)]


#: A snip of a second at a hundred ticks a second, and open again.
SMOOTH = [*np.linspace(0.01, 1.0, 100).tolist(), 0.0]


@pytest.fixture(scope="module")
def whole() -> Cut:
    (cut,) = snips(SMOOTH)
    return cut


TREMBLING = np.clip(np.array(SMOOTH) + np.random.default_rng(1).normal(0.0, 0.005, len(SMOOTH)), 0.0, 1.0).tolist()


@pytest.mark.parametrize(
    "closures",
    [
        [c for c in (*SMOOTH[1::3], 1.0, 0.0) for _ in range(3)],  # a device of 33 Hz
        [round(255 * c / 5) / 255 * 5 for c in SMOOTH],  # fifty counts from open to closed
        [c for k in range(0, 100, 10) for c in (*SMOOTH[k : k + 10], SMOOTH[k + 9] - 0.9 * DEAD_BAND)] + [1.0, 0.0],
        TREMBLING,
    ],
    ids=["each sample held", "coarse counts", "to and fro within the dead band", "trembling"],
)
def test_a_snip_is_one_stroke_however_the_device_tells_it(closures: list[float], whole: Cut) -> None:
    """The blades sweep the same way at the same place, through tissue that nothing has moved: the same elements."""
    (told,) = snips(closures)
    assert (told.volume_mm3, told.point) == (whole.volume_mm3, whole.point)


def test_blades_that_open_by_more_than_the_dead_band_begin_a_stroke_and_cut_nothing_twice(whole: Cut) -> None:
    pieces = snips([*SMOOTH[:65], SMOOTH[64] - 1.1 * DEAD_BAND, *SMOOTH[64:]])
    assert len(pieces) == 2
    assert pieces[0].tick == 66
    # Elements beside where the first stroke ended lose links in both.
    assert whole.volume_mm3 <= sum(p.volume_mm3 for p in pieces) < 1.5 * whole.volume_mm3


def test_scissors_that_tremble_beside_what_they_have_cut_cut_nothing_more() -> None:
    """Open or closed: what trembles by less than the dead band is no stroke."""
    rng = np.random.default_rng(2)
    still = rng.uniform(0.0, 0.9 * DEAD_BAND, 200)
    assert not snips(still.tolist())
    assert len(snips([*SMOOTH[:-1], *(1.0 - still).tolist()])) == 1


def test_blades_that_never_close_quite_write_their_stroke_when_they_open() -> None:
    (cut,) = snips([*SMOOTH[:95], 0.94, 0.93, 0.9, 0.89, 0.5])
    assert cut.tick == 99
