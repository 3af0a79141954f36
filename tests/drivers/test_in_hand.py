"""The account that drivers of devices in a hand keep of losses and of latency."""

from __future__ import annotations

import time

from trainer.drivers.in_hand import MOST_LOSSES, Latency, Losses


def test_a_loss_is_told_with_its_reasons_while_it_lasts_and_after() -> None:
    """Lost at tick 3, back at tick 7: four ticks of 10 ms. Each instrument has an account of its own."""
    losses = Losses(0.01)
    for tick in range(10):
        losses.note("left", tick, "" if not 3 <= tick < 7 else "nothing comes" if tick < 5 else "the port is gone")
        losses.note("right", tick, "out of sight" if tick >= 8 else "")
    assert losses.summary() == {
        "losses": 2,
        "lost": [
            {"tool": "left", "tick": 3, "lost_s": 0.04, "reason": "nothing comes; the port is gone"},
            {"tool": "right", "tick": 8, "lost_s": 0.02, "reason": "out of sight"},
        ],
    }


def test_a_bad_session_s_account_does_not_grow_without_end() -> None:
    losses = Losses(0.01)
    for tick in range(4 * MOST_LOSSES):
        losses.note("left", tick, f"reason {tick}" if tick % 2 else "")
    summary = losses.summary()
    assert summary["losses"] == 2 * MOST_LOSSES
    assert len(summary["lost"]) == MOST_LOSSES + 1  # type: ignore[arg-type]


def test_latency_counts_what_a_tick_used_and_told_once() -> None:
    latency = Latency()
    latency.used(time.monotonic())
    latency.begin()  # of that one nobody told
    for _ in range(3):
        latency.used(time.monotonic() - 1.0)
        latency.told()
        latency.told()
    summary = latency.summary()
    assert summary["poses"] == 3
    assert summary["p50"] >= 1000.0  # type: ignore[operator]
