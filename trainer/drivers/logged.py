"""A session of our own log as a device: the poses that were stored, tick by tick, unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trainer.config import ConfigError
from trainer.log import reader
from trainer.poses import ToolPoses


class LoggedSession:
    """Driver that gives back the stored rows exactly, so that the same events happen again."""

    def __init__(self, db: Path, session: str, tools: Sequence[str], tick_hz: float) -> None:
        """``tools`` are the task's instruments in their order. Raises ConfigError, LogError."""
        with reader.open_log(db) as log:
            record = reader.load(log, session)
        header = record.header
        name = f"{db}: session {header.id}"
        missing = [tool for tool in tools if tool not in header.tools]
        if missing:
            raise ConfigError(f"{name} has no instrument '{missing[0]}'; it has {', '.join(header.tools)}")
        if header.tick_hz != tick_hz:
            raise ConfigError(f"{name} ticks at {header.tick_hz:g} Hz, the task at {tick_hz:g} Hz")
        if len(record.position) == 0:
            raise ConfigError(f"{name} holds no tool poses")
        self._record = record
        # Where the input of a session ended before its task did, a last row holds the poses but was never stepped.
        self._frames = min(len(record.position), record.ticks) if record.status == "ended" else len(record.position)
        self._path = f"{db}#{header.id}"
        self._columns = [header.tools.index(tool) for tool in tools]
        self._consumed = 0

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        record = self._record
        row = tick - record.first_tick
        if not 0 <= row < self._frames:
            return None
        self._consumed = row + 1
        k, seen = self._columns, record.poses(row)
        reason = tuple(seen.reason[c] for c in k)
        return ToolPoses(seen.position[k], seen.quaternion[k], seen.closure[k], seen.valid[k], reason)

    def summary(self) -> dict[str, object]:
        """The file's and session's name, how many of its ticks were played, and how long it lasted."""
        return {
            "driver": "recording",
            "path": self._path,
            "frames": self._frames,
            "frames_consumed": self._consumed,
            "duration_s": (self._frames - 1) / self._record.header.tick_hz,
        }

    def close(self) -> None:
        """Nothing stays open."""
