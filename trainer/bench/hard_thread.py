"""Hard cases of the thread: what each method makes of what no one should ask for.

The laws in all of them, at every tick (``bench.thread_laws`` derives them): places and speeds are finite; no link is
off its length by more than 1e-6, but for what its own tension makes of it, T / EA (both are told); a hold that goes at
one speed gives the thread no energy in the frame that goes with it, but 5e-3 of what lifts it by its length; and where
there is no speed, no node goes further than what leads it. Further laws are those of a case. A method that cannot do
what is asked refuses it and moves nothing, or tells what it lacks. XPBD can do neither: where a law does not hold for
it, its case says that it did not converge.

Threads: *suture*, 100 mm of nylon as thin as 10-0 in air, and for the chain, which does not bend, 1 m without stiffness
in a vacuum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from trainer.bench.thread import bare, forceps, straight, suture
from trainer.bench.thread_laws import Beads, Chain, Leader, Rod, Thread, Watch, ended
from trainer.mechanics.thread_chain import ChainTaut
from trainer.mechanics.thread_rod import RodModel, settle

TICK_S = 0.01
SIZES = (50, 200, 1000)
LIMIT_mN = 150.0
Make = type[Rod] | type[Chain] | type[Beads] | type[Leader]


def model_of(make: Make, links: int) -> RodModel:
    return bare(links) if make is Chain else suture(links)


def at_rest(make: Make, links: int) -> Watch:
    """A straight thread, held at its first node."""
    model = model_of(make, links)
    return Watch(make(model, straight(model), [0]))


def over_taut() -> str:
    """Ends of a straight rod drawn apart to 1.5 lengths by 0.1 mm a tick.

    The tension grows to the hold's limit and stays, to ``SLIPS_AT`` of ``thread_rod_step``, a part in a thousand, and
    twice that with the tick's own; no node goes further than the hold, but for the weight's sag: a tenth.
    """
    model = suture(200)
    thread = Rod(model, straight(model), [0, 200], LIMIT_mN)
    watch, last = Watch(thread), 0.0
    for k in range(1, 501):
        thread.held.target[1, 0] = 100.0 + 0.1 * k
        watch.tick(TICK_S)
        tension = float(thread.state.tension.max())
        assert tension >= last - 2e-3 * LIMIT_mN, "the tension fell"
        assert tension <= 1.002 * LIMIT_mN, "the tension is above the limit"
        last = tension
    assert watch.furthest <= 1.1 * 0.1, f"a leap of {watch.furthest:.2g} mm"
    return ended(
        watch, words=f"{last:.1f} mN at a limit of {LIMIT_mN:g} mN, no node went over {watch.furthest:.3f} mm a tick"
    )


def beads_over_taut() -> str:
    """As the rod, by 1 mm a tick; nothing gives way, so that in the end each link is half as long again."""
    model = suture(200)
    thread = Beads(model, straight(model), [0, 200])
    watch = Watch(thread)
    for k in range(1, 51):
        thread.held.target[1, 0] = 100.0 + k
        watch.tick(TICK_S)
    if watch.furthest > 1.1:
        return f"not converged: a node goes {watch.furthest:.2g} mm in a tick, its hold 1 mm; {watch.broken()}"
    return ended(watch)


def leader_over_taut() -> str:
    """As the rod; what is lacking is told to 1e-9 mm, and the nodes lie straight and evenly."""
    model = suture(200)
    thread = Leader(model, straight(model), [0, 200])
    watch = Watch(thread)
    for k in range(1, 501):
        thread.held.target[1, 0] = 100.0 + 0.1 * k
        watch.tick(TICK_S)
        assert abs(thread.lacking - 0.1 * k) <= 1e-9, f"it lacks {0.1 * k:g} mm and says {thread.lacking:g}"
    assert watch.furthest <= 0.1 + 1e-9, f"a leap of {watch.furthest:.2g} mm"
    return ended(watch, words=f"{thread.lacking:.0f} mm lacking, and said")


def chain_over_taut() -> str:
    """Ends of a chain that hangs drawn apart by 2 mm a tick: its pull grows to the hold's limit, a tick is refused."""
    model, refusal = bare(200), ""
    half = np.arange(model.count)
    x = model.link * np.stack([0.6 * half, 0.0 * half, -0.8 * np.minimum(half, 200 - half)], axis=1)
    thread = Chain(model, x, [0, 200], LIMIT_mN)
    watch = Watch(thread)
    while not refusal:
        thread.held.target[1, 0] += 2.0
        before = thread.x.copy()
        try:
            watch.tick(TICK_S)
        except ChainTaut as error:
            refusal = str(error)
    assert np.array_equal(before, thread.x), "a refused tick moved the chain"
    assert thread.held.target[1, 0] <= model.length + 2.0, "it was longer than it is"
    return f"refused: {refusal}; {ended(watch).removeprefix('ok: ')}"


def jump(make: Make, far: float) -> str:
    """After 10 ticks the held end leaps ``far`` mm in one, and 20 ticks follow. No node is then further from it than
    its arc: so say the lengths."""
    watches = []
    for links in SIZES:
        watch = at_rest(make, links)
        for k in range(30):
            if k == 10:
                watch.thread.held.target[0] = [0.6 * far, 0.8 * far, 0.0]
            watch.tick(TICK_S)
        watches.append(watch)
    return ended(*watches, words=f"{SIZES[0]}, {SIZES[1]} and {SIZES[2]} links")


def stiffness(make: type[Rod] | type[Beads]) -> str:
    """Bending stiffness of a suture times 0, 1e-3, 1e3, 1e6, its first link clamped: a swing of half a second.

    The rod then settles, and no node rests above the clamp, but by the length's error.
    """
    nylon, watches = suture(100), []
    for factor in (0.0, 1e-3, 1e3, 1e6):
        model = RodModel(101, 1.0, nylon.mass, factor * nylon.bending, 1e6, nylon.drag)
        thread = make(model, straight(model), [0, 1])
        watch = Watch(thread)
        for _ in range(50):
            watch.tick(TICK_S)
        if isinstance(thread, Rod):
            settle(thread.state, thread.held)
            assert thread.x[:, 2].max() <= 1e-6 * model.length, "a node rests above the clamp"
        watches.append(watch)
    return ended(*watches, words="EI from 0 to 1e6 of nylon's")


def ticks(make: Make) -> str:
    """A second of the forceps' loop (of a swing, where that is the harder) in ticks of 1 ms and of 50 ms.

    What weighs and is steered ends within 5e-3 of the length (the place error that is asked of it) of the other; the
    others tell how far apart they end: a chain's whip goes other ways, and follow-the-leader has no time, only a path.
    """
    links, ends, watches = 100, [], []
    for tick in (1e-3, 5e-2):
        watch = at_rest(make, links)
        model = watch.thread.model
        for k in range(1, round(1.0 / tick) + 1):
            if make is not Rod:
                watch.thread.held.target[0] = forceps(model, k * tick)
            watch.tick(tick)
        ends.append(watch.thread.x.copy())
        watches.append(watch)
    apart = float(np.max(np.linalg.norm(ends[0] - ends[1], axis=1))) / model.length
    assert make is not Rod or apart <= 5e-3, f"1 ms and 50 ms end {apart:.1e} lengths apart"
    return ended(*watches, words=f"after 1 s they are {apart:.0e} lengths apart")


def not_a_number(make: Make) -> str:
    """A target that is no number, or infinite, is refused and moves nothing; a denormal is a place like any other."""
    watch, message = at_rest(make, 50), ""
    thread = watch.thread
    for bad in (math.nan, math.inf):
        thread.held.target[0, 0] = bad
        before = thread.x.copy()
        try:
            thread.go(TICK_S)
        except ValueError as error:
            message = str(error)
        else:
            raise AssertionError(f"{bad} was taken")
        assert np.array_equal(before, thread.x), "a refused tick moved the thread"
    thread.held.target[0] = 5e-324
    watch.tick(TICK_S)
    return f"refused: {message}; a denormal is taken, {ended(watch).removeprefix('ok: ')}"


def bad_starts(make: Make) -> str:
    """All nodes in one point; all links folded back on one another; then both ends are drawn to 60 mm.

    The ends are where they are held; the chain refuses what has not its lengths.
    """
    model, watches = model_of(make, 50), []
    link = model.link
    for x in (np.zeros((51, 3)), np.outer(np.arange(51) % 2, [link, 0.0, 0.0])):
        try:
            thread: Thread = make(model, x, [0, 50])
        except ValueError as error:
            return f"refused: {error}"
        thread.held.target[1] = [0.6 * model.length, 0.0, 0.0]
        watch = Watch(thread)
        for _ in range(30):
            watch.tick(TICK_S)
        assert np.allclose(thread.x[50], thread.held.target[1], atol=1e-9), "the end is not where it is held"
        watches.append(watch)
    return ended(*watches, words="a point and a fold drawn to 0.6 lengths")


def cases() -> list[tuple[str, str, Callable[[], str]]]:
    """(case, method, what runs it): how it ended with a number, or AssertionError where a law breaks."""
    everyone: tuple[Make, ...] = (Rod, Chain, Beads, Leader)
    taut = ((Rod.name, over_taut), (Beads.name, beads_over_taut), (Leader.name, leader_over_taut))
    found = [("straight thread pulled to 1.5 times its length", name, run) for name, run in taut]
    found.append(("hanging chain pulled straight", Chain.name, chain_over_taut))
    found += [("held end leaps 20 mm in one tick", make.name, partial(jump, make, 20.0)) for make in everyone]
    found.append(("held end leaps 200 mm in one tick", Chain.name, partial(jump, Chain, 200.0)))
    stiff = "bending stiffness from 0 to 1e6 of nylon's"
    found += [(stiff, Rod.name, partial(stiffness, Rod)), (stiff, Beads.name, partial(stiffness, Beads))]
    for what, run in (
        ("ticks of 1 ms and of 50 ms", ticks),
        ("a pose that is not a number, infinite or denormal", not_a_number),
        ("zero-length and folded links at the start", bad_starts),
    ):
        found += [(what, make.name, partial(run, make)) for make in everyone]
    return found
