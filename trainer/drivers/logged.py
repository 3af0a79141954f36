"""A session of our own log as a device: the poses that were stored, tick by tick, unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trainer.config import ConfigError
from trainer.poses import ToolPoses


class LoggedSession:
    """Driver that gives back the stored rows exactly, so that the same events happen again."""

    def __init__(self, db: Path, session: str, tools: Sequence[str], tick_hz: float) -> None:
        """``tools`` are the task's instruments in their order. Raises ConfigError."""
        from trainer.log import reader

        if not db.is_file():
            raise ConfigError(f"{db}: no such file")
        self._record = reader.load(db, session)
        header = self._record.header
        name = f"{db}: session {session}"
        missing = [tool for tool in tools if tool not in header.tools]
        if missing:
            raise ConfigError(f"{name} has no instrument '{missing[0]}'; it has {', '.join(header.tools)}")
        if header.tick_hz != tick_hz:
            raise ConfigError(f"{name} ticks at {header.tick_hz:g} Hz, the task at {tick_hz:g} Hz")
        if len(self._record.position) == 0:
            raise ConfigError(f"{name} holds no tool poses")
        self._path = f"{db}#{session}"
        self._columns = [header.tools.index(tool) for tool in tools]
        self._consumed = 0

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        record = self._record
        row = max(tick - record.first_tick, 0)
        if row >= len(record.position):
            return None
        self._consumed = row + 1
        k = self._columns
        return ToolPoses(record.position[row, k], record.quaternion[row, k], record.closure[row, k], record.valid[row, k])

    def summary(self) -> dict[str, object]:
        frames = len(self._record.position)
        return {
            "driver": "recording",
            "path": self._path,
            "frames": frames,
            "frames_consumed": self._consumed,
            "duration_s": (frames - 1) / self._record.header.tick_hz,
        }

    def close(self) -> None:
        """Nothing stays open."""
