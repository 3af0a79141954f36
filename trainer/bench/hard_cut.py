"""A vessel is slit while jaws draw at it, as in a session, tick by tick in real time.

Jaws hold a triangle beside the slit and go to and fro, before the cut and after it; the links are cut before a tick's
solve, and nothing else changes. The solves are a scene's, with as few iterations. The law: no position that is not
finite, and no node that flies; once the jaws rest, the energy of what is left and of their springs does not rise, and
the forces are in equilibrium again, as a mesh measures them that never had the links. Told are the ticks up to three
factors after the cut, cut and solve together, and those before it: the median of all; that tick in which they took
longest, by the median of the rounds; and the longest of all, in which another program may have had the core: beside it
the most that a tick's own thread worked. And the tick after the cut in which the tissue was in equilibrium again. A
stall would be a tick that is longer than the ten milliseconds which the clock gives it; nothing here fails by the
clock.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from time import perf_counter, sleep, thread_time

import numpy as np

from trainer.anatomy.slit import slit_links
from trainer.anatomy.vessel import Vessel, build
from trainer.config import Sourced
from trainer.curriculum import VesselSpec
from trainer.interactions.holding import HOLD, MOST_ITERATIONS, TOLERANCE_MN
from trainer.mechanics.attachments import Anchors
from trainer.mechanics.compliance import LAG
from trainer.mechanics.equilibrium import Equilibrium, Result
from trainer.mechanics.links import LinkMesh, energy, forces, link_mesh

#: A tick of the tasks, s.
TICK_S = 0.01
#: What jaws hold this wall with in a scene, mN/mm: interactions.holding.
JAWS = HOLD * 500.0 * 0.15
#: Ticks before the cut, and after it.
BEFORE, AFTER = 3 * LAG, 3 * LAG
#: How often each case is run.
ROUNDS = 3
#: Links that are cut.
COUNTS = (1, 20, 100)
#: How far the jaws draw, and go to and fro, mm. A node that is further from rest than the vessel is long has flown.
WAY, SWAY, FLOWN = 0.3, 0.1, 2.0
#: Rounding of the energy of thousands of links.
ROUNDING = 1e-9


@cache
def _vessel() -> Vessel:
    """The task single-stitch's, with twice the nodes."""
    given = Sourced(500.0, "assumed: as in the task single-stitch")
    spec = VesselSpec(
        name="A", cut_edge_mm=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), outer_diameter_mm=1.0, wall_mm=0.15,
        length_mm=2.0, layers=31, around=32, modulus_kPa=given, puncture_outer_mN=given, puncture_inner_mN=given,
        tear_mN=given,
    )  # fmt: skip
    return build(spec)


def _slit(count: int) -> np.ndarray:
    """So many links of a slit, from the cut edge inwards."""
    vessel = _vessel()
    across = slit_links(vessel, ("outer", "inner"), (0.0, 0.0), vessel.spec.length_mm)
    along = vessel.axial_mm[vessel.mesh.links[across]].sum(axis=1)
    return across[np.argsort(along, kind="stable")][:count]


def _ring() -> np.ndarray:
    """All links from one layer to the next: what jaws hold of the vessel comes off."""
    vessel = _vessel()
    near = np.arange(len(vessel.mesh.rest)) < 2 * vessel.spec.around * (vessel.spec.layers // 2)
    i, j = vessel.mesh.links.T
    return np.flatnonzero(near[i] != near[j])


class _Drawn:
    """A vessel of which jaws hold a triangle near its cut edge."""

    def __init__(self) -> None:
        vessel = _vessel()
        self.nodes = [vessel.node(6, 1), vessel.node(7, 1), vessel.node(6, 2)]
        self.state = Equilibrium(vessel.mesh, (vessel.elimination,))
        self.slots = np.array([self.state.hold(np.full(3, node), np.array([1.0, 0.0, 0.0])) for node in self.nodes])
        self.stiffness = np.repeat(JAWS * np.eye(3)[None], len(self.nodes), axis=0)
        self.places = vessel.mesh.rest[self.nodes]

    def to(self, out_mm: float, aside_mm: float) -> Result:
        """The jaws so far from where they took hold, and a solve."""
        vessel = _vessel()
        self.places = vessel.mesh.rest[self.nodes] + out_mm * vessel.twelve + aside_mm * vessel.three
        held = Anchors(self.slots, self.places, self.stiffness)
        return self.state.solve(held, tolerance_mN=TOLERANCE_MN, max_iterations=MOST_ITERATIONS)

    def energy_and_rest(self, left: LinkMesh) -> tuple[float, float]:
        """Energy, mN mm, of the mesh ``left`` and the jaws' springs, and the forces that are not balanced, mN."""
        x, unbalanced = self.state.x, forces(left, self.state.x)
        off = self.places - x[self.nodes]
        unbalanced[self.nodes] += JAWS * off
        whole = energy(left, x) + 0.5 * JAWS * float(np.sum(off**2))
        return whole, float(np.linalg.norm(unbalanced[~left.fixed]))


def _round(links: np.ndarray, tick_s: float) -> tuple[list[tuple[float, float]], int]:
    """Milliseconds of each tick, and those that its thread had a core; and the tick after the cut in which the tissue
    was in equilibrium again, or 0."""
    drawn, mesh = _Drawn(), _vessel().mesh
    ms: list[tuple[float, float]] = []
    again = 0
    for k in range(BEFORE + AFTER):
        begun, own = perf_counter(), thread_time()
        if k == BEFORE:
            drawn.state.cut(links)
        ended = drawn.to(WAY * min(1.0, (k + 1) / LAG), SWAY * np.sin(0.3 * max(0, k - LAG)))
        ms.append(((perf_counter() - begun) * 1e3, (thread_time() - own) * 1e3))
        assert np.isfinite(drawn.state.x).all(), "a position is not finite"
        assert np.abs(drawn.state.x - mesh.rest).max() < FLOWN, "a node has flown off"
        if k >= BEFORE and ended.converged and not again:
            again = k - BEFORE + 1
        sleep(max(0.0, tick_s - (perf_counter() - begun)))
    kept = np.setdiff1d(np.arange(len(mesh.links)), links)
    left = link_mesh(mesh.rest, mesh.links[kept], mesh.stiffness[kept], mesh.fixed)
    before = np.inf
    for _ in range(AFTER):
        ended = drawn.to(WAY, 0.0)
        now, rest = drawn.energy_and_rest(left)
        assert now <= before * (1.0 + ROUNDING), f"the energy rose from {before:g} to {now:g} mN mm"
        before = now
        if ended.converged:
            assert rest <= TOLERANCE_MN * (1.0 + ROUNDING), f"residual {rest:.1e} mN, and it says that it converged"
            return ms, again
    raise AssertionError(f"{AFTER} ticks after the jaws came to rest there are {rest:.1e} mN left")


def outcome(links: np.ndarray, tick_s: float = TICK_S, rounds: int = ROUNDS) -> str:
    """What became of a cut. Raises AssertionError where a law is broken."""
    runs = [_round(links, tick_s) for _ in range(rounds)]
    ms = np.array([ticks for ticks, _ in runs])
    before, after = (
        f"median {np.median(part[..., 0]):.2g} ms, longest {np.median(part[..., 0], axis=0).max():.2g} ms, "
        f"of all {part[..., 0].max():.2g} ms (own work {part[..., 1].max():.2g} ms)"
        for part in (ms[:, LAG + 1 : BEFORE], ms[:, BEFORE:])
    )
    again = f"in tick {runs[0][1]}" if runs[0][1] else "once the jaws rest"  # the same bits in each round
    return f"ok: ticks {after}; before it {before}; in equilibrium {again}"


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """Case, method, and a function that tells the outcome."""
    nodes = f"of {len(_vessel().mesh.rest)} nodes"
    slits = [(f"slit of {count} link{'s' * (count > 1)} in a vessel {nodes}", _slit(count)) for count in COUNTS]
    named = [*slits, (f"a vessel {nodes} cut through", _ring())]
    return [(case, "kept factor", partial(outcome, links)) for case, links in named]
