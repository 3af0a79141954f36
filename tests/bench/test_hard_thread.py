"""Hard cases of the thread hold, and the laws by which they are judged find what breaks them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from trainer import scene
from trainer.bench import hard_draped, hard_thread
from trainer.bench.thread import bare, straight, suture
from trainer.bench.thread_laws import ERROR, LENGTH, Beads, Chain, Leader, Rod, Watch, ended, energy
from trainer.curriculum import load_task
from trainer.geometry import Array

CASES = [(case, method, run) for case, method, run in hard_thread.cases() if method != Beads.name]


@pytest.mark.parametrize(("case", "method", "run"), CASES, ids=lambda value: value if isinstance(value, str) else "")
def test_hard_cases_hold(case: str, method: str, run: Callable[[], str]) -> None:
    """Of the program's own methods each comes right or refuses; the rival takes too long to be run here."""
    assert run().startswith(("ok: ", "refused: ")), f"{case}, {method}"


class Spoilt(Rod):
    """A rod that does something else beside: ``spoil`` changes its state after each tick."""

    spoil: Callable[[Rod], None] = staticmethod(lambda rod: None)

    def go(self, tick_s: float) -> None:
        super().go(tick_s)
        self.spoil(self)


def watched(spoil: Callable[[Rod], None], ticks: int = 5) -> Watch:
    model = suture(50)
    thread = Spoilt(model, straight(model), [0])
    thread.spoil = spoil  # type: ignore[method-assign]
    watch = Watch(thread)
    for _ in range(ticks):
        watch.tick(0.01)
    return watch


def stretch(rod: Rod) -> None:
    rod.x[-1] += 2.0 * LENGTH * (rod.x[-1] - rod.x[-2])


def hurry(rod: Rod) -> None:
    """Kinetic energy of what lifts it by a twentieth of its length: ½ m v² = m g L / 20, at the free half."""
    rod.v[25:, 1] += math.sqrt(2.0 * 9810.0 * rod.model.length / 20.0)


def lose(rod: Rod) -> None:
    rod.x[3, 1] = math.nan


def test_what_breaks_a_law_of_the_thread_is_found() -> None:
    """Undisturbed nothing is found; a link that is too long by 2e-6, energy from nowhere and a NaN each are."""
    sound = watched(lambda rod: None)
    assert sound.broken() == ""
    assert sound.beyond <= 1e-9
    assert "off its length" in watched(stretch).broken()
    assert "gained" in watched(hurry).broken()
    with pytest.raises(AssertionError, match="a place is not finite"):
        watched(lose)
    with pytest.raises(AssertionError, match="off its length"):
        ended(watched(stretch))


def test_a_method_that_cannot_tell_is_said_not_to_have_converged() -> None:
    """1000 links are too many for a sweep each 10 µs: the end of the chain does not yet feel the hold."""
    model = suture(1000)
    watch = Watch(Beads(model, straight(model), [0]))
    watch.thread.held.target[0, 2] = 20.0
    for _ in range(2):
        watch.tick(0.01)
    assert ended(watch).startswith("not converged: 1000 links, a link is off its length by ")


def test_a_leader_that_is_overtaken_is_found() -> None:
    model = suture(50)
    thread = Leader(model, straight(model), [0])
    watch = Watch(thread)
    thread.held.target[0, 0] = 1.0
    watch.tick(0.01)
    assert watch.furthest == pytest.approx(1.0, abs=1e-12)
    thread.places[10:, 1] += 5.0  # its next tick draws them back by more than it goes
    with pytest.raises(AssertionError, match="too far"):
        watch.tick(0.01)


def test_energy_is_kept_in_the_frame_of_a_hold_that_goes_uniformly() -> None:
    """A swing seen from a carriage: all nodes begin at its speed, and the hold goes along.

    Galilei: places and energy are those of the swing at rest. Two runs of Newton to 1e-9 of the length in 20 ticks
    differ by no more than 1e-6 of it, and energies by ten times that of weight times length.
    """
    model = bare(50)
    w = np.array([300.0, 0.0, 200.0])
    rods = [Rod(model, straight(model), [0]) for _ in range(2)]
    rods[1].state.v[:] = rods[1].state._v_before[:] = w
    watches = [Watch(rod) for rod in rods]
    for k in range(1, 21):
        rods[1].held.target[0] = 0.01 * k * w
        for watch in watches:
            watch.tick(0.01)
    moved = rods[1].x - 0.2 * w
    assert np.max(np.abs(moved - rods[0].x)) <= 1e-6 * model.length
    rest, seen = energy(model, rods[0].x, rods[0].v, np.zeros(3)), energy(model, moved, rods[1].v, w)
    weight = model.mass * model.length * 9810.0 * model.length
    assert abs(seen - rest) <= 1e-5 * weight
    assert abs(energy(model, moved, rods[1].v, np.zeros(3)) - rest) > ERROR * weight, "the frame makes no difference"
    assert abs(watches[1].gained - watches[0].gained) <= 1e-5


def test_a_chain_on_rest_keeps_its_energy_and_is_watched_only_there() -> None:
    """Its hold goes along a cubic, on which it does work: counted are the ticks after it has come to rest."""
    model = bare(50)
    watch = Watch(Chain(model, straight(model), [0]))
    for k in range(10):
        if k == 2:
            watch.thread.held.target[0] = [12.0, 16.0, 0.0]
        watch.tick(0.01)
    assert watch.gained <= 1e-6


# ---- on vessels ----------------------------------------------------------------------------------------------------


def square_tube() -> tuple[Array, np.ndarray]:
    """One side of a tube of four, 2 mm wide, at z = 1, and its neighbour at y = 1; 2 mm long."""
    x = np.array([[0.0, -1, 1], [2, -1, 1], [2, 1, 1], [0, 1, 1], [0, 1, -1], [2, 1, -1]])
    return x, np.array([[0, 1, 2], [0, 2, 3], [3, 2, 5], [3, 5, 4]])


def test_a_gap_to_a_tube_is_negative_inside_and_positive_round_an_edge() -> None:
    surface, triangles = square_tube()
    every = np.array([[0, f] for f in range(4)])
    outside = np.array([[1.0, 0.9, 1.2], [1.0, 1.3, 0.9]])
    assert hard_draped.gap(outside, surface, triangles, every) == pytest.approx(0.2, abs=1e-12)
    inside = np.array([[1.0, 0.9, 1.2], [1.0, 0.9, 0.7]])
    assert hard_draped.gap(inside, surface, triangles, every) == pytest.approx(-0.1, abs=1e-12)
    assert hard_draped.gap(outside, surface, triangles, every[:0]) == math.inf


def test_how_deep_a_point_lies_in_a_wall() -> None:
    """Vessel A from x = -0.3 on to -2.3, walls from 0.35 to 0.5 mm between facets of 24 sides: apothem 0.9914 of it."""
    s = scene.build(load_task("anastomosis/single-stitch").task)
    flat = math.cos(math.pi / 24)
    middle = math.pi / 24  # of a facet
    points = np.array(
        [
            [-1.0, 0.45 * math.cos(middle), 0.45 * math.sin(middle)],
            [-1.0, 0.6, 0.0],
            [-1.0, 0.1, 0.0],
            [-0.31, 0.42, 0.0],
            [0.0, 0.42, 0.0],
        ]
    )
    expected = [0.5 * flat - 0.45, 0.5 * flat - 0.6 * flat, 0.1 * flat - 0.35 * flat, 0.01, -0.3]
    assert hard_draped.in_wall(s, points) == pytest.approx(expected, abs=1e-12)
