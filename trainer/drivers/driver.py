"""What every device driver offers the session loop."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from trainer.poses import ToolPoses


class Driver(Protocol):
    """A source of instrument poses, opened for one session."""

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        """Poses at ``tick``, or None when the input has ended.

        ``view`` is what the scene shows a scripted hand; a device that does not look at it ignores it.
        """
        ...

    def summary(self) -> dict[str, object]:
        """What was read so far, ready for JSON."""
        ...

    def close(self) -> None:
        """Give the port or file back."""
        ...


@runtime_checkable
class LiveDriver(Driver, Protocol):
    """A device in a hand: it is a sink as well, and hears when a tick's events are out, to measure its latency."""

    def tick(self, record: object) -> None: ...
