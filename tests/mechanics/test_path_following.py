"""A jump of the instrument ends on the branch to which small steps lead; a jump at once does not."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.bench import hard_vessel
from trainer.bench.vessel import Work, prepare
from trainer.geometry import Array
from trainer.mechanics.krylov import NewtonKrylov
from trainer.mechanics.links import energy
from trainer.mechanics.newton import Newton
from trainer.mechanics.path_following import LONGEST, follow
from trainer.mechanics.sweeps import BlockSweeps

#: Residual, mN, of the answers, and how far, radii, it lets them be off: the vessel gives way by 1 radius under 2 mN.
TOLERANCE_mN, NEAR = 1e-4, 1e-4


@pytest.fixture(scope="module")
def work() -> Work:
    return prepare(13, 12, both_ends=True, frames=1)


def patch(work: Work) -> np.ndarray:
    rest = work.mesh.rest
    outer = np.hypot(rest[:, 1], rest[:, 2]) > 0.95 * work.radius_mm
    return np.flatnonzero(outer & (np.linalg.norm(rest - rest[work.node], axis=1) < 0.2))


def pushed(work: Work, depth: float) -> Array:
    """The patch's places, ``depth`` radii further in."""
    inwards = -(work.places[-1] - work.places[0]) / np.linalg.norm(work.places[-1] - work.places[0])
    return work.mesh.rest[patch(work)] + depth * work.radius_mm * inwards


def in_small_steps(method: NewtonKrylov, nodes: np.ndarray, places: Array) -> None:
    """A hundred steps a radius, none of which a fold could hide in: the reference."""
    start = method.x[nodes].copy()
    steps = max(int(200 * np.max(np.linalg.norm(places - start, axis=1))), 1)
    for k in range(1, steps + 1):
        assert method.move(nodes, start + (places - start) * (k / steps), tolerance_mN=1e-7).converged


def far(work: Work, a: Array, b: Array) -> float:
    return float(np.max(np.linalg.norm(a - b, axis=1))) / work.radius_mm


@pytest.mark.parametrize(
    ("kind", "depth"),  # at 1.2 the wall snaps, which costs Newton with SuperLU seconds
    [(k, d) for k in (BlockSweeps, Newton, NewtonKrylov) for d in (0.5, 0.8, 1.2) if (k, d) != (Newton, 1.2)],
)
def test_a_patch_pushed_in_at_once_is_where_small_steps_lead(
    work: Work, kind: type[BlockSweeps] | type[Newton] | type[NewtonKrylov], depth: float
) -> None:
    """Same energy to second order of the distance, and the same place of every node."""
    nodes = patch(work)
    reference = NewtonKrylov(work.mesh)
    in_small_steps(reference, nodes, pushed(work, depth))
    method = kind(work.mesh)
    path = follow(method, nodes, pushed(work, depth), tolerance_mN=TOLERANCE_mN)
    assert path.converged
    assert path.share == 1.0
    assert far(work, method.x, reference.x) <= NEAR
    # The energy rises with the square of the distance, by a stiffness of at most the stiffest node's.
    stiffest = float(np.max(work.mesh.stiffness)) * 10.0 * len(work.mesh.rest)
    off = NEAR * work.radius_mm
    assert abs(energy(work.mesh, method.x) - energy(work.mesh, reference.x)) <= stiffest * off**2


def test_without_sub_steps_sweeps_end_on_another_branch(work: Work) -> None:
    """Why there are sub-steps: at a tiny residual the nodes are half a radius from where they belong."""
    nodes, places = patch(work), pushed(work, 0.8)
    reference = NewtonKrylov(work.mesh)
    in_small_steps(reference, nodes, places)
    method = BlockSweeps(work.mesh)
    assert method.move(nodes, places, tolerance_mN=1e-8).converged
    assert far(work, method.x, reference.x) > 0.2


def test_a_collapsed_vessel_is_pulled_open_as_by_small_steps(work: Work) -> None:
    nodes = patch(work)
    reference, method = NewtonKrylov(work.mesh), NewtonKrylov(work.mesh)
    for depth in (1.2, 0.0):
        in_small_steps(reference, nodes, pushed(work, depth))
        path = follow(method, nodes, pushed(work, depth), tolerance_mN=TOLERANCE_mN)
        assert path.converged
    assert far(work, method.x, reference.x) <= NEAR


def test_sub_steps_are_chosen_from_the_motion(work: Work) -> None:
    """None is longer than a quarter of the shortest link; a short way is one step; no way at all is one solve."""
    shortest = float(np.min(work.mesh.rest_length))
    for share, steps in ((0.0, 1), (0.9, 1), (3.5, 4)):
        method = NewtonKrylov(work.mesh)
        depth = share * LONGEST * shortest / work.radius_mm
        path = follow(method, patch(work), pushed(work, depth), tolerance_mN=TOLERANCE_mN)
        assert (path.converged, path.sub_steps, path.snaps) == (True, steps, 0)


def test_a_method_that_gives_up_leaves_the_last_equilibrium(work: Work) -> None:
    """It says how far it came, and the state is that of this place."""

    class Failing(NewtonKrylov):
        def move(self, nodes, places, *, tolerance_mN, load=None):  # type: ignore[no-untyped-def, override]
            ended = super().move(nodes, places, tolerance_mN=tolerance_mN, load=load)
            low = float(np.max(np.linalg.norm(places - work.mesh.rest[nodes], axis=1)))
            return ended if low < 0.1 else type(ended)(False, ended.steps, ended.residual_mN, ended.energy)

    method = Failing(work.mesh)
    path = follow(method, patch(work), pushed(work, 0.5), tolerance_mN=TOLERANCE_mN)
    assert not path.converged
    assert path.share == pytest.approx(0.1 / (0.5 * work.radius_mm), abs=0.05)
    assert np.allclose(method.x[patch(work)], pushed(work, 0.5 * path.share))


def test_a_place_that_is_no_number_is_refused(work: Work) -> None:
    with pytest.raises(ValueError, match="not finite"):
        follow(NewtonKrylov(work.mesh), patch(work), pushed(work, np.nan), tolerance_mN=TOLERANCE_mN)


@pytest.mark.parametrize(
    ("case", "method"),
    [(c, "Newton–Krylov") for c in hard_vessel.CASES if c != "stiffness ratio of 1e6"]
    + [("stiffness ratio of 1e6", "block sweeps"), ("stiffness ratio of 1e6", "Newton, SuperLU")],
)
def test_hard_cases(case: str, method: str) -> None:
    """Either right or refused, for the method of big meshes; the stability report has all methods."""
    said = hard_vessel.outcome(case, method)
    refused = case in {"isolated node", "place that is no number", "collinear links"}
    assert said.startswith("refused: " if refused else "ok: ")
