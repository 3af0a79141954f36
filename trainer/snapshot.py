"""What moves in a scene as one array: copied in a tick, and read in the process that writes the recording.

The tick only copies what it has anyway. Where the parts of an instrument are, how the thread runs between what holds
it, and where all of it is in the world, is left to the reader, who has the time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trainer.geometry import Array, Rigid
from trainer.mechanics.thread import ThreadModel, polyline
from trainer.sinks.surface import Frame

if TYPE_CHECKING:  # the reader is in another process, which needs no rule of interaction
    from trainer.interactions.thread_pull import Constraints
    from trainer.interactions.world import World


def copy(world: World, held: Constraints | None, places: tuple[Array, ...]) -> Array:
    """Everything that moves (k,), mm and mN of the scene, as :meth:`Reader.frame` reads it.

    ``held`` is what holds the thread, None without one; ``places`` (n, 3) mm are the elements of what moves in a
    region.
    """
    values: list[Array | list[float]] = [[world.tissue_force_mN, world.tension_mN, len(world.pieces)]]
    for jaw in world.jaws:
        values += jaw.pose.position, jaw.pose.quaternion, [jaw.closure]
    if world.needle is not None:
        values += world.needle_pose.position, world.needle_pose.quaternion
    if world.solver is not None:
        values.append(world.solver.x)
    values += places
    if held is not None:
        values += world.nodes, world.pieces, held.arc, held.position
    return np.concatenate(values, axis=None)


@dataclass(frozen=True)
class Reader:
    """Reads what :func:`copy` has written, in any process: it can be pickled."""

    world_from_scene: Rigid
    part_poses: tuple[Callable[[Rigid, float], tuple[Array, Array]], ...]  # of each instrument: where its parts are
    needle: bool
    vessels: tuple[int, ...]  # how many nodes each has
    clouds: tuple[int, ...]  # how many elements each has
    thread: ThreadModel | None

    def frame(self, values: Array) -> Frame:
        """The scene as it was, in the world."""
        out, rest = self.world_from_scene, values

        def take(*shape: int) -> Array:
            nonlocal rest
            size = int(np.prod(shape))
            taken, rest = rest[:size].reshape(shape), rest[size:]
            return taken

        force_mN, tension_mN, pieces = take(3).tolist()
        parts = []
        for part_poses in self.part_poses:
            tool = out @ Rigid(take(3), take(4))
            parts.append(part_poses(tool, float(take(1)[0])))
        needle = out @ Rigid(take(3), take(4)) if self.needle else None
        return Frame(
            vertices=tuple(out.apply(take(n, 3)) for n in self.vessels),
            part_position=np.concatenate([position for position, _ in parts]),
            part_quaternion=np.concatenate([quaternion for _, quaternion in parts]),
            needle_position=None if needle is None else needle.position,
            needle_quaternion=None if needle is None else needle.quaternion,
            clouds=tuple(out.apply(take(n, 3)) for n in self.clouds),
            thread=tuple(out.apply(line) for line in self._thread(rest, int(pieces))),
            force_mN=force_mN,
            tension_mN=tension_mN,
        )

    def _thread(self, values: Array, pieces: int) -> list[Array]:
        """The thread's pieces as polylines (m, 3) mm of the scene, through its holes and grips."""
        if self.thread is None:
            return []
        nodes, between, held = np.split(values, np.cumsum([3 * self.thread.count, 2 * pieces]))
        arc, position = np.split(held, [len(held) // 4])
        return polyline(self.thread, nodes.reshape(-1, 3), arc, position.reshape(-1, 3), between.reshape(-1, 2))
