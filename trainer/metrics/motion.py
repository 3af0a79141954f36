"""How the hands moved: time, path, economy, pauses. Speeds and paths are those of the filtered tracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trainer.events import Cut, Grasp, Pierce, PullThrough, Release, StepDone, Tack, Withdraw
from trainer.metrics.performance import Performance
from trainer.metrics.registry import metric
from trainer.metrics.track import FILTER

#: Below this an instrument rests, mm/s; assumed: a still hand with 50 um of tremor stays below it after the filter.
IDLE_MM_S = 0.5
#: A pause shorter than this is part of a movement, s; assumed.
IDLE_S = 0.5
#: A movement begins above the first and ends below the second speed, mm/s, and lasts at least so long, s; assumed:
#: a reach of 10 mm in 2 s peaks at 9.4 mm/s.
MOVE_ON_MM_S, MOVE_OFF_MM_S, MOVE_S = 2.0, 1.0, 0.2

#: Events that an instrument's way leads to.
AIMS = (Grasp, Release, Pierce, Withdraw, PullThrough, Cut, Tack)


def runs(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Begin and end (exclusive) of each stretch of True in flags (n,): (m, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(len(edges) // 2, 2)


@metric("time_s", "s", better="lower", version=f"1; {FILTER}; motion from {IDLE_MM_S:g} mm/s")
def time(performance: Performance, _: str) -> float | None:
    """Time from the first motion of an instrument to the last step; to the end where steps were left undone."""
    record = performance.record
    starts = []
    for track in performance.tracks.values():
        moving = np.flatnonzero(track.speed_mm_s > IDLE_MM_S)
        if len(moving):
            starts.append(float(track.time_s[moving[0]]))
    if not starts:
        return None
    done = [e.time_s for e in performance.events(StepDone)]
    end = done[-1] if done and record.outcome == "completed" else record.duration_s
    return max(end - min(starts), 0.0)


@metric("path_length_{tool}_mm", "mm", better="lower", version=f"1; {FILTER}")
def path_length(performance: Performance, tool: str) -> float | None:
    """Length of the instrument's way; a gap in tracking counts as its straight line."""
    track = performance.tracks.get(tool)
    return None if track is None else float(np.sum(track.step_mm))


@metric("economy_{tool}", "ratio", better="higher", version=f"1; {FILTER}")
def economy(performance: Performance, tool: str) -> float | None:
    """Straight lines between the places where the instrument did something, over its way between them; 1 is direct.

    The places are where the instrument was at its grasps, releases, piercings, withdrawals, cuts and tacks, from
    the first to the last. Straight lines from target to target, not from start to finish: a task that ends
    where it began would score 0 however well it was done.
    """
    track = performance.tracks.get(tool)
    times = [e.time_s for e in performance.record.events if isinstance(e, AIMS) and e.tool == tool]
    if track is None or len(times) < 2:
        return None
    nodes = np.unique([int(np.argmin(np.abs(track.time_s - t))) for t in times])
    way = float(np.sum(track.step_mm[nodes[0] : nodes[-1]]))
    straight = float(np.sum(np.linalg.norm(np.diff(track.position[nodes], axis=0), axis=1)))
    return min(straight / way, 1.0) if way > 0.0 else None


@metric("idle_s", "s", version=f"1; {FILTER}; below {IDLE_MM_S:g} mm/s for {IDLE_S:g} s")
def idle(performance: Performance, _: str) -> float | None:
    """Time in which all instruments rested, pauses of half a second and more."""
    tracks = performance.tracks.values()
    if len(performance.tracks) < len(performance.task.scene.instrument) or not tracks:
        return None
    start = max(t.time_s[0] for t in tracks)
    end = min(t.time_s[-1] for t in tracks)
    resting = []
    for track in tracks:
        still = (track.speed_mm_s < IDLE_MM_S) & track.seen[:-1] & track.seen[1:]
        resting.append(still[(track.time_s[:-1] >= start) & (track.time_s[1:] <= end)])
    lengths = np.diff(runs(np.logical_and.reduce(resting)), axis=1)[:, 0] / performance.record.header.tick_hz
    return float(np.sum(lengths[lengths >= IDLE_S]))


@metric(
    "movements_{tool}",
    "count",
    better="lower",
    version=f"1; {FILTER}; from {MOVE_ON_MM_S:g} mm/s to {MOVE_OFF_MM_S:g} mm/s, at least {MOVE_S:g} s",
)
def movements(performance: Performance, tool: str) -> float | None:
    """How often the instrument set out: stretches of motion between rests."""
    track = performance.tracks.get(tool)
    if track is None:
        return None
    speed = track.speed_mm_s
    shortest = MOVE_S * performance.record.header.tick_hz
    stretches = runs(speed > MOVE_OFF_MM_S)
    return float(sum(b - a >= shortest and bool(np.any(speed[a:b] > MOVE_ON_MM_S)) for a, b in stretches))
