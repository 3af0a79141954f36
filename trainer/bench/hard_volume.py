"""Hard cases of volumes of tissue.

The law in all of them: displacements are finite, links are symmetric and lead to what is there, what is free is
counted, no element is lost but by erasing, and what is rigid stays. After a pull along one axis no link is beyond its
limits by more than rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from trainer import scene
from trainer.anatomy.structures import structures
from trainer.bench.volume import FIRM, TISSUE, beyond_limits, block
from trainer.curriculum import load_task
from trainer.mechanics.elastic_relaxation import relax
from trainer.mechanics.incision import cut, erase, tear
from trainer.mechanics.islands import islands
from trainer.mechanics.joining import join
from trainer.mechanics.volume import (
    FREE,
    LINKS,
    PRESENT,
    Indices,
    Material,
    Volume,
    VolumeError,
    VolumeState,
    build,
    places,
    start,
    tack,
)
from trainer.mechanics.volume_drag import drag
from trainer.poses import ToolPoses

Run = Callable[[], str]
#: Sums of float32 along a way of n links: two ways to one link each err by n half units in the last place.
EPS = float(np.finfo(np.float32).eps)
#: How far elements are pulled in one tick, in their lengths.
FAR_LENGTHS = 100.0
#: Displacements, mm, at which relaxed tissue counts as back at its rest: it sleeps below a hundredth of it a sweep.
AT_REST_MM = 1e-2


def cases() -> list[tuple[str, str, Run]]:
    """(case, method, run). ``run`` answers "ok: …" or "refused: …"; AssertionError says that a law is broken."""
    one, two = (TISSUE,), (TISSUE, FIRM)
    far: list[tuple[str, tuple[int, int, int], tuple[Material, ...], str]] = [
        ("block", (12, 12, 12), one, "lists"),
        ("block", (12, 12, 12), one, "scan"),
        ("block of two materials", (12, 12, 12), two, "corrected"),
        ("block of two materials", (12, 12, 12), two, "largest first"),
        ("sheet one element thick", (40, 40, 1), one, "lists"),
        ("sheet one element thick", (40, 1, 40), one, "scan"),
        ("single strand", (80, 1, 1), one, "lists"),
        ("single strand of two materials", (1, 1, 80), two, "corrected"),
        ("single element", (1, 1, 1), one, "lists"),
    ]
    return [
        *((f"{what} pulled by {FAR_LENGTHS:g} element lengths in one tick", f"ChainMail, {method}",
           partial(pull_far, shape, of, method)) for what, shape, of, method in far),
        ("pull to a place that is nan", "ChainMail", pull_nowhere),
        ("least length of a link above its greatest", "material", limits_exchanged),
        ("labels that touch along an edge only", "ChainMail", along_an_edge),
        ("island after a cut", "ChainMail and relaxation", island),
        ("cut through the whole ligament, which was pulled", "incision and relaxation", through_the_ligament),
        ("cut twice in the same place", "incision", twice),
        ("join across a gap", "joining", across_a_gap),
        ("join where nobody is near", "joining", join_nobody),
        ("neighbours held and drawn ten lengths apart", "tearing", pulled_apart),
        ("all of it erased", "erasing", all_erased),
        ("instrument that starts inside bone", "scene", starts_in_bone),
    ]  # fmt: skip


def lawful(volume: Volume, state: VolumeState, there: int) -> None:
    """Raises AssertionError unless ``there`` elements are there and all is in order."""
    assert np.isfinite(state.u).all(), "a displacement is not finite"
    present = (state.links & PRESENT) != 0
    assert np.count_nonzero(present) == there, f"{np.count_nonzero(present)} elements of {there}"
    assert np.count_nonzero(state.links & FREE) == state.free_count, "what is free is miscounted"
    assert not np.any(state.links[~present] & (LINKS | FREE)), "what is not there has links"
    rigid = volume.material_of[volume.labels.reshape(-1)] < 0
    assert not state.u[:, rigid].any(), "a rigid element moved"
    for axis, step in enumerate(volume.strides):
        ahead = np.flatnonzero(state.links & (1 << 2 * axis)) + step
        back = np.flatnonzero(state.links & (2 << 2 * axis))
        assert np.array_equal(ahead, back), f"links along {'xyz'[axis]} are not symmetric"


def _middle(volume: Volume) -> Indices:
    i, j, k = (n // 2 for n in volume.shape)
    return np.array([np.ravel_multi_index((i, j, k), volume.shape)], dtype=np.int32)


def _box(shape: tuple[int, int, int], materials: tuple[Material, ...]) -> Volume:
    """A block of elements of 1 mm, in layers of the materials along z."""
    labels = np.ones(shape, dtype=np.uint8)
    for m in range(1, len(materials)):
        labels[:, :, m :: len(materials)] = m + 1
    return build(labels, (1.0, 1.0, 1.0), {m + 1: of for m, of in enumerate(materials)})


def pull_far(shape: tuple[int, int, int], materials: tuple[Material, ...], method: str) -> str:
    """Along one axis, there and back and there; in between it relaxes for a second."""
    volume = _box(shape, materials)
    state, held = start(volume), _middle(volume)
    worst = 0.0
    for way in (FAR_LENGTHS, -FAR_LENGTHS, FAR_LENGTHS):
        moved = drag(volume, state, held, (way, 0.0, 0.0), method)
        lawful(volume, state, volume.labels.size)
        worst = max(worst, beyond_limits(volume, state))
        assert np.all(state.u[0, held] == np.float32(way)), "what is held is not where it was put"
        relax(volume, state, 1.0)
        lawful(volume, state, volume.labels.size)
    # A way of links, each with a rounding of the pull; corrected asks nobody for less than a millionth of it.
    allowed = FAR_LENGTHS * (sum(shape) * EPS + 1e-6)
    assert worst <= allowed, f"a link is {worst:.1e} mm beyond its limits"
    return f"ok: {moved.count} moved, worst link {worst:.0e} mm beyond its limits"


def pull_nowhere() -> str:
    volume = block(3)
    state = start(volume)
    answer = _refused(lambda: drag(volume, state, _middle(volume), (np.nan, 0.0, 0.0)))
    assert not state.u.any(), "something moved"
    return answer


def limits_exchanged() -> str:
    return _refused(
        lambda: Material("tissue", (0.8,) * 3, (1.2,) * 3, (0.2,) * 3, young_kPa=1.0, shear_kPa=1.0, time_constant_s=1)
    )


def along_an_edge() -> str:
    """Two bodies, and a pull at the one does not move the other."""
    labels = np.zeros((4, 4, 2), np.uint8)
    labels[:2, :2], labels[2:, 2:] = 1, 2
    volume = build(labels, (1.0, 1.0, 1.0), {1: TISSUE, 2: FIRM})
    state = start(volume)
    parts = islands(state, volume)
    assert [len(part) for part in parts] == [8, 8], f"bodies of {[len(part) for part in parts]} elements"
    drag(volume, state, parts[0][:1], (FAR_LENGTHS, 0.0, 0.0))
    lawful(volume, state, 16)
    assert not state.u[:, parts[1]].any(), "the other body moved"
    return "ok: two bodies, only the one that is pulled moves"


def _knife(volume: Volume, state: VolumeState, x: float) -> tuple[int, float]:
    """A wide knife goes down along z at ``x`` mm: how many links it cuts, and their faces, mm²."""
    done = cut(volume, state, [(x, -99.0, 99.0), (x, 99.0, 99.0)], [(x, -99.0, -99.0), (x, 99.0, -99.0)])
    return done.links, done.area_mm2


def island() -> str:
    """What was cut off stays where it is when the rest is pulled far, and relaxes on its own."""
    volume = _box((12, 6, 6), (TISSUE,))
    state = start(volume)
    links, _ = _knife(volume, state, 5.5)
    parts = islands(state, volume)
    assert (links, [len(part) for part in parts]) == (36, [216, 216]), f"{links} links cut, {len(parts)} bodies"
    drag(volume, state, parts[1][-1:], (FAR_LENGTHS, FAR_LENGTHS, 0.0))
    relax(volume, state, 5.0)
    lawful(volume, state, 432)
    assert not state.u[:, parts[0]].any(), "what was cut off moved"
    assert state.u[0, parts[1]].min() > 0.0, "what is pulled does not follow"
    return "ok: two bodies of 216, one moved, one did not"


def through_the_ligament() -> str:
    """Between two bones, pulled aside at its middle and let go when it is cut: both ends go back to their rest."""
    labels = np.ones((20, 4, 4), np.uint8)
    labels[:2] = labels[-2:] = 2
    volume = build(labels, (1.0, 1.0, 1.0), {1: TISSUE})
    state = start(volume)
    drag(volume, state, _middle(volume), (0.0, 3.0, 0.0))
    relax(volume, state, 0.05)
    links, area = _knife(volume, state, 9.5)
    assert links == 16, f"{links} links cut of 16"
    parts = islands(state, volume)
    assert len(parts) == 2, f"{len(parts)} bodies"
    relax(volume, state, 300.0)
    lawful(volume, state, 320)
    left = float(np.abs(state.u).max())
    assert left <= AT_REST_MM, f"an end stays {left:.1e} mm off"
    return f"ok: 16 links, {area:g} mm2, two bodies; both ends back to {left:.0e} mm"


def twice() -> str:
    volume = _box((10, 4, 4), (TISSUE,))
    state = start(volume)
    first, second = _knife(volume, state, 4.5)[0], _knife(volume, state, 4.5)[0]
    lawful(volume, state, 160)
    assert (first, second) == (16, 0), f"{first} links at first, {second} then"
    return "ok: 16 links at first, none then"


def _gap() -> tuple[Volume, VolumeState]:
    """Two blocks, four lengths apart."""
    labels = np.ones((13, 3, 3), np.uint8)
    labels[5:8] = 0
    volume = build(labels, (1.0, 1.0, 1.0), {1: TISSUE})
    return volume, start(volume)


def across_a_gap() -> str:
    """The facing elements are drawn to one rest length, within limits; then a pull at the one takes the other along."""
    volume, state = _gap()
    done = join(volume, state, [(6.0, -1.0, 1.0), (6.0, 3.0, 1.0)], 3.0, 5.0)
    lawful(volume, state, 90)
    assert done.links == 9 == len(state.seams.ends), f"{done.links} links made of 9"
    one, other = (places(volume, state, state.seams.ends[:, end]) for end in range(2))
    off = float(np.abs(np.linalg.norm(other - one, axis=1) - 1.0).max())
    assert off <= 0.2 + 1e-5, f"an end is {off:.2g} mm off its rest length"
    drag(volume, state, np.array([0], np.int32), (-FAR_LENGTHS, 0.0, 0.0))
    lawful(volume, state, 90)
    assert state.u[0, volume.labels.reshape(-1) == 1].max() < 0.0, "the joined body stays behind"
    return f"ok: 9 links across 4 mm, ends off their rest length by up to {off:.2g} mm; both bodies follow a pull"


def join_nobody() -> str:
    volume, state = _gap()
    done = join(volume, state, [(60.0, -1.0, 1.0), (60.0, 3.0, 1.0)], 3.0, 5.0)
    assert done.links == 0, f"{done.links} links made"
    assert not state.u.any(), "something moved"
    lawful(volume, state, 90)
    return "ok: nothing joined, nothing moved"


def pulled_apart() -> str:
    """Jaws hold two neighbours and draw them ten lengths apart: their link tears, all others are within limits."""
    volume = _box((10, 1, 1), (TISSUE,))
    state, held = start(volume), np.array([4, 5], np.int32)
    tack(state, held)
    drag(volume, state, held, [(-5.0, 0.0, 0.0), (5.0, 0.0, 0.0)])
    torn = tear(volume, state)
    lawful(volume, state, 10)
    sizes = [len(part) for part in islands(state, volume)]
    assert (torn.links, sizes) == (1, [5, 5]), f"{torn.links} links torn, bodies of {sizes}"
    apart = np.diff(state.u[0])[(state.links[:-1] & 1) != 0]
    assert np.all(np.abs(apart) <= 0.2 + 10.0 * EPS * FAR_LENGTHS), "a link is beyond its limits"
    return "ok: 1 link torn, two bodies of 5"


def all_erased() -> str:
    """Nothing is left to be moved, cut, joined or relaxed, and a pull at what is gone is refused."""
    volume = _box((4, 4, 4), (TISSUE,))
    state = start(volume)
    erase(volume, state, np.arange(64, dtype=np.int32))
    lawful(volume, state, 0)
    _knife(volume, state, 1.5)
    join(volume, state, [(1.0, 0.0, 0.0), (1.0, 3.0, 0.0)], 3.0, 5.0)
    relax(volume, state, 1.0)
    lawful(volume, state, 0)
    return _refused(lambda: drag(volume, state, _middle(volume), (1.0, 0.0, 0.0)))


def starts_in_bone() -> str:
    """The grasper begins in the tibia, is told to be there, and nothing moves; then it closes, and holds nothing."""
    s = scene.build(load_task("arthroscopy/ligament-2d").task)
    region = s.world.region
    assert region is not None
    bone = np.flatnonzero(region.volume.labels.reshape(-1) == structures()["tibia"].number)
    middle = region.rest(bone.astype(np.int32)).mean(axis=0)
    at = s.world.place_in_world(middle)
    position = s.home.position.copy()
    position[0] = at
    kinds = []
    for closure in (0.0, 0.0, 0.5, 1.0, 1.0):
        jaws = s.home.closure.copy()
        jaws[0] = closure
        kinds += [e.kind for e in s.step(ToolPoses(position, s.home.quaternion, jaws, np.ones(2, dtype=bool)))]
        lawful(region.volume, region.state, int(np.count_nonzero(region.volume.labels)))
        assert not region.state.u.any(), "tissue moved"
    assert "probe" in kinds, f"it is not told; events: {', '.join(kinds)}"
    assert "grasp" not in kinds, "it holds bone"
    return f"ok: {kinds.count('probe')} probe, nothing held, nothing moved"


def _refused(run: Callable[[], object]) -> str:
    try:
        run()
    except VolumeError as error:
        return f"refused: {error}"
    raise AssertionError("it was accepted")
