"""The haptic bench: both loops run while what is beside them does, and are told in the same words."""

from __future__ import annotations

import os
import time

import pytest

from trainer.bench.haptics import measure


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT", "0") == "1", reason="the loop must be compiled")
def test_both_loops_are_measured_while_something_runs_beside() -> None:
    seen: list[float] = []

    def beside(seconds: float) -> None:
        seen.append(seconds)
        time.sleep(5.0 * seconds)  # a busy machine lets each loop have a turn by then

    found = measure(beside, 0.2)
    assert seen == [0.2]
    assert found["haptics"].keys() == found["bare"].keys()
    assert found["haptics"]["periods"] > 0
    assert found["bare"]["periods"] > 0
    assert found["p999_ratio"] == found["haptics"]["p999_us"] / found["bare"]["p999_us"]
    assert found["evaluation_us"] > 0.0
