"""How late poses became events, counted in bins, so that a session of any length takes no more memory."""

from __future__ import annotations

import math

import numpy as np

BIN_MS = 0.05
BINS = 20_000  # up to a second; what took longer is in the last


class LatencyCount:
    """Counts of latencies, ms. Percentiles are the upper edges of their bins, and at most the longest latency."""

    def __init__(self) -> None:
        self.counts = np.zeros(BINS, dtype=np.int64)
        self.longest_ms = 0.0

    def add(self, ms: float) -> None:
        self.counts[min(max(int(ms / BIN_MS), 0), BINS - 1)] += 1
        self.longest_ms = max(self.longest_ms, ms)

    def merge(self, other: LatencyCount) -> None:
        """Add what another session counted."""
        self.counts += other.counts
        self.longest_ms = max(self.longest_ms, other.longest_ms)

    def percentile_ms(self, fraction: float) -> float:
        """The latency that at least ``fraction`` of all do not exceed; 0 of none."""
        total = int(self.counts.sum())
        if not total:
            return 0.0
        k = int(np.searchsorted(np.cumsum(self.counts), max(1, math.ceil(fraction * total))))
        return min((k + 1) * BIN_MS, self.longest_ms)

    def summary(self) -> dict[str, float]:
        return {
            "poses": int(self.counts.sum()),
            "p50": round(self.percentile_ms(0.5), 3),
            "p99": round(self.percentile_ms(0.99), 3),
            "max": round(self.longest_ms, 3),
        }
