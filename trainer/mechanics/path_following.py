"""A jump of an instrument, followed along its way so that the tissue ends on the right branch.

A tissue that has buckled has more than one equilibrium for one place of the instrument; which one it is in depends on
the way there. So nodes that have leapt are taken along the straight line from where they were, in sub-steps, to
equilibrium at each. A sub-step is shorter than any link, or a node could pass through the wall behind it (a quarter of
the shortest one: assumed). It is halved, and begun again from the last equilibrium, when a node has moved more than
``LEAP`` times as far as the instrument, and lengthened when it went well (step control of continuation methods:
Allgower and Georg, Numerical Continuation Methods, section 6.1). A snap that is the tissue's own stays a leap at every
sub-step: below ``SHORTEST`` it is accepted, and counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh
from trainer.mechanics.newton import Outcome, refuse_not_finite

#: The most that a node may move in a sub-step, as a multiple of the instrument's own motion (assumed).
LEAP = 2.0
#: The longest and the shortest sub-step, in the mesh's shortest links (assumed).
LONGEST, SHORTEST = 0.25, 0.01
#: Growth of the sub-step after one that went well.
GROWTH = 1.5


class Follower(Protocol):
    """A method of static equilibrium with a state, as in ``newton``, ``krylov`` and ``sweeps``."""

    mesh: LinkMesh

    @property
    def x(self) -> Array: ...

    def move(self, nodes: np.ndarray, places: Array, *, tolerance_mN: float, load: Array | None = None) -> Outcome: ...


@dataclass(frozen=True)
class Path:
    """How a way was gone. Not converged: the state is the last one before the sub-step that failed."""

    converged: bool
    sub_steps: int  # solved for, those that were taken back included
    snaps: int  # leaps that no shorter sub-step avoids
    share: float  # of the way that was gone
    last: Outcome


def follow(
    method: Follower, nodes: np.ndarray, places: Array, *, tolerance_mN: float, load: Array | None = None
) -> Path:
    """Takes ``nodes`` (k,) along straight lines to ``places`` (k, 3), with ``method`` in equilibrium at each sub-step.

    Raises ValueError when a place or a load is not finite.
    """
    refuse_not_finite(places, load)
    start = method.x[nodes].copy()
    way = places - start
    length = float(np.max(np.linalg.norm(way, axis=1), initial=0.0))
    link = float(np.min(method.mesh.rest_length))
    step = LONGEST * link
    gone, sub_steps, snaps = 0.0, 0, 0
    while True:
        before = method.x.copy()
        share = min(1.0, gone + step / length) if length > 0.0 else 1.0
        ended = method.move(nodes, start + share * way, tolerance_mN=tolerance_mN, load=load)
        sub_steps += 1
        moved = float(np.max(np.linalg.norm(method.x - before, axis=1)))
        leapt = moved > LEAP * max((share - gone) * length, SHORTEST * link)
        if not ended.converged or leapt:
            if step > SHORTEST * link and length > 0.0:
                method.x[:] = before
                step = max(0.5 * step, SHORTEST * link)
                continue
            if not ended.converged:
                method.x[:] = before
                return Path(False, sub_steps, snaps, gone, ended)
            snaps += 1
        gone = share
        if gone >= 1.0:
            return Path(True, sub_steps, snaps, 1.0, ended)
        step = min(GROWTH * step, LONGEST * link)
