"""What gives way, and what is told of it."""

from __future__ import annotations

import numpy as np
import pytest
from test_scene import LEFT, close, threaded

from trainer.events import Slip
from trainer.interactions import giving_way, thread_pull
from trainer.interactions.giving_way import Grips
from trainer.mechanics.attachments import Anchors, Cable
from trainer.mechanics.equilibrium import Result


def test_a_slip_tells_the_load_that_was_measured() -> None:
    """A thread drawn through tissue with 650 mN slips from jaws that hold 600: with 650, not with their limit.

    The tension of the equilibrium is given here; nothing of it is computed, so that it comes back exactly.
    """
    s = threaded()
    close(s, LEFT, 0.8)
    world = s.world
    rows = thread_pull.constraints(world)
    ((first, last),) = [(a, b) for a, b in thread_pull.runs(world, rows) if LEFT in (rows.grip[a], rows.grip[b])]
    cable = Cable(np.full(2, -1), rows.position[first : last + 1], 0.0, np.zeros(2, dtype=np.bool_))
    found = Result(True, 1, 0.0, 1.0, np.zeros((0, 3)), np.array([650.0]), 0.0)
    world.events = []
    giving_way.judge(world, Grips(Anchors.none(), ()), rows, [(first, last, cable)], found, 0.0)
    (slip,) = [e for e in world.events if isinstance(e, Slip)]
    assert slip.load_mN == 650.0
    assert slip.limit_mN == pytest.approx(600.0, abs=1e-9)
