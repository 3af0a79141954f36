"""A stored session as plain data: what metrics, reports, exports and replays read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from trainer.events import Event, TrackingLost
from trainer.geometry import Array
from trainer.poses import ToolPoses

#: The key of ``SessionHeader.versions`` that holds the force, mN, at which the tissue counted as in equilibrium. It was
#: chosen by measurements that may change, so a replay takes it from here.
TOLERANCE = "tolerance_mN"
#: The keys that hold the knee that was practised in, a name or a folder, and what its fingerprint was then.
ANATOMY, ANATOMY_SHA256 = "anatomy", "anatomy_sha256"


def anatomy_name(versions: Mapping[str, str]) -> str:
    """What a reader calls the knee of a session: an imported one as its folder; "" where there is none."""
    reference = versions.get(ANATOMY, "")
    name = Path(reference).name
    return f"built-in {name}" if name and name == reference else name


@dataclass(frozen=True)
class SessionHeader:
    """All that is needed to run a session again, and to say who did it when."""

    id: str
    trainee: str  # name as given; the log keeps names in a table of their own
    task: str  # family/task or path
    task_toml: str
    task_sha256: str
    device: str  # as given to --device
    device_toml: str
    device_sha256: str
    seed: int
    tick_hz: float
    tools: tuple[str, ...]
    started_at: str  # UTC, ISO 8601
    versions: dict[str, str]  # trainer, python, numpy, numba, machine; the keys above where the scene has such
    recording: str | None  # path of the .rrd

    @property
    def anatomy(self) -> str:
        """What the knee is called that was practised in; "" where the task has none."""
        return anatomy_name(self.versions)

    @property
    def anatomy_sha256(self) -> str:
        """Which knee it was, wherever its folder lies; "" where the task has none."""
        return self.versions.get(ANATOMY_SHA256, "")


@dataclass(frozen=True)
class SessionRecord:
    """A session with its events and tool poses, as the log holds them."""

    header: SessionHeader
    status: str  # running, ended or aborted
    outcome: str  # completed, failed, aborted or timeout; "" while running
    ticks: int
    duration_s: float
    events: tuple[Event, ...]  # ordered by (tick, seq)
    first_tick: int
    position: Array  # (n, k, 3) mm, one row per tick
    quaternion: Array  # (n, k, 4) wxyz
    closure: Array  # (n, k)
    valid: np.ndarray  # (n, k) bool

    def poses(self, row: int) -> ToolPoses:
        """What the device gave at the stored tick ``row``, with the reasons that went into events."""
        tick = self.first_tick + row
        reason = tuple(self._why_lost.get((tick, tool), "") for tool in self.header.tools)
        return ToolPoses(self.position[row], self.quaternion[row], self.closure[row], self.valid[row], reason)

    @cached_property
    def _why_lost(self) -> dict[tuple[int, str], str]:
        return {(e.tick, e.tool): e.reason for e in self.events if isinstance(e, TrackingLost)}


@dataclass(frozen=True)
class Metric:
    """One measured value with all that a reader needs to judge it."""

    name: str
    value: float | None  # None: the session gave nothing to measure
    unit: str
    target_low: float | None
    target_high: float | None
    source: str  # of the target band
    version: str  # changes when the definition does
