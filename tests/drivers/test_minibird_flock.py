"""The simulated flock keeps the manual's table of commands, and the conversation with it says what is wrong."""

from __future__ import annotations

import math
import os
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.drivers import minibird_commands as commands
from trainer.drivers import minibird_flock
from trainer.drivers.minibird_record import POSITION_MM, decode
from trainer.geometry import Rigid, quaternion_from_axis_angle, quaternion_from_euler_deg
from trainer.profile import Bird, MinibirdSpec
from trainer.simulators.flock import ARGUMENTS, CHANGEABLE, DEFAULTS, Flock

POSE = Rigid(np.array([100.0, -20.0, 3.0]), quaternion_from_euler_deg((10.0, 20.0, 30.0)))


def flock(*addresses: int, pose: Rigid = POSE) -> Flock:
    return Flock(addresses or (1, 2), lambda address: pose)


def configured(*addresses: int, pose: Rigid = POSE) -> Flock:
    f = flock(*addresses, pose=pose)
    f.receive(1, commands.change(commands.AUTO_CONFIGURATION, bytes((len(addresses) or 2,))), 1.0)
    assert f.configured
    return f


def test_an_unconfigured_flock_answers_but_gives_no_record() -> None:
    f = flock()
    assert f.receive(1, b"B", 1.0) == b""
    assert f.receive(1, commands.examine(commands.ERROR), 1.1) == b"\x09"
    assert f.receive(1, commands.examine(commands.ERROR), 1.2) == b"\x00"  # reading clears it
    status = f.receive(1, commands.examine(commands.FLOCK_STATUS), 1.3)
    assert [commands.BirdStatus.read(b).accessible for b in status] == [True, True] + [False] * 12


def test_configuration_wants_silence_and_all_its_units() -> None:
    f = flock()
    f.receive(1, b"?", 1.0)
    f.receive(1, b"P\x32\x02", 1.3)
    assert not f.configured
    f.receive(1, b"P\x32\x02", 2.0)
    assert f.configured
    alone = flock(1)
    alone.receive(1, b"P\x32\x02", 1.0)
    assert not alone.configured
    assert alone.receive(1, b"O\x0a", 2.0) == bytes((13,))


def test_commands_for_the_master_are_refused_by_another_unit() -> None:
    f = configured()
    f.receive(2, b"F", 2.0)
    assert f.receive(2, b"O\x0a", 2.0) == b"\x07"
    f.receive(1, b"\xf2F", 2.0)
    assert f.receive(1, b"\xf2O\x0a", 2.0) == b"\x07"


@pytest.mark.parametrize("code", sorted(ARGUMENTS))
def test_a_command_is_carried_out_when_its_last_argument_has_come_and_not_before(code: int) -> None:
    """A complete command leaves the unit ready: the status word answers. One byte short, it waits for one more."""
    arguments = b"\x23\x00" if code == ord("P") else bytes(ARGUMENTS[code])
    f = configured()
    f.receive(1, bytes((code,)) + arguments[:-1] if arguments else b"", 2.0)
    if arguments:
        assert f.units[1].command
        f.receive(1, arguments[-1:], 2.0)
    else:
        f.receive(1, bytes((code,)), 2.0)
    assert not f.units[1].command
    assert len(f.receive(1, b"O\x00", 2.0)) == 2


def test_values_are_kept_by_their_lengths() -> None:
    f = configured()
    for parameter in CHANGEABLE - {commands.TRANSMITTER_MODE, commands.GROUP_MODE}:
        data = bytes(range(1, 1 + len(DEFAULTS[parameter])))
        f.receive(1, commands.change(parameter, data), 2.0)
        assert f.receive(1, commands.examine(parameter), 2.0) == data
    assert f.receive(1, commands.examine(10), 2.0) == b"\x00"


def test_records_are_of_the_format_that_was_asked_for() -> None:
    """Angles are those of R = Rz Ry Rx: 30° azimuth, 20° elevation, 10° roll; a word is 180°/32768, cut to four."""
    f = configured()
    sizes = {b"V": 6, b"W": 6, b"X": 18, b"Y": 12, b"Z": 24, b"\\": 8, b"]": 14}
    for command, size in sizes.items():
        assert len(f.receive(1, command + b"B", 2.0)) == size
    angles = np.array(decode(f.receive(1, b"WB", 2.0))) * 180 / 32768
    np.testing.assert_allclose(angles, [30, 20, 10], rtol=0, atol=4 * 180 / 32768)
    matrix = np.array(decode(f.receive(1, b"XB", 2.0))).reshape(3, 3) / 32768
    np.testing.assert_allclose(matrix, POSE.matrix, rtol=0, atol=4 / 32768)
    position = np.array(decode(f.receive(1, b"VB", 2.0))) * POSITION_MM
    np.testing.assert_allclose(position, POSE.position, rtol=0, atol=2.001 * POSITION_MM)


def test_group_mode_sends_all_birds_with_their_addresses() -> None:
    f = configured()
    f.receive(1, b"]\xf2]" + commands.change(commands.GROUP_MODE, b"\x01") + b"@", 2.0)
    sent = f.cycle()
    assert set(sent) == {1}
    assert [sent[1][14], sent[1][29]] == [1, 2]
    f.receive(1, b"?", 2.0)
    assert f.cycle() == {}


def test_positions_stick_at_full_scale_and_change_sign_beyond_the_hemisphere() -> None:
    far = configured(pose=Rigid(np.array([2000.0, 0.0, 0.0]), POSE.quaternion))
    assert decode(far.receive(1, b"VB", 2.0))[0] == 32764
    behind = configured(pose=Rigid(np.array([-100.0, 20.0, -3.0]), POSE.quaternion))
    forward = decode(configured().receive(1, b"VB", 2.0))
    assert decode(behind.receive(1, b"VB", 2.0)) == forward
    behind.receive(1, commands.hemisphere("aft"), 2.0)
    assert decode(behind.receive(1, b"VB", 2.0)) == [-w for w in forward]


def test_a_power_cycle_forgets_everything() -> None:
    f = configured()
    f.receive(1, b"P\x23\x01@O", 2.0)
    f.power_cycle()
    assert not f.configured
    assert not f.group
    assert not f.units[1].command
    assert f.cycle() == {}


def test_transmitter_mode_0_is_never_said() -> None:
    with pytest.raises(ValueError, match="damages"):
        commands.change(commands.TRANSMITTER_MODE, b"\x00")
    f = configured()
    f.receive(1, b"P\x12\x00", 2.0)
    assert f.damaged


def test_every_error_code_has_words() -> None:
    assert all(commands.error_text(code) != "unknown" for code in range(1, 36))


@given(st.lists(st.binary(max_size=20), max_size=30), st.booleans())
def test_no_command_bytes_raise_or_pile_up(pieces: list[bytes], ready: bool) -> None:
    """The longest command is CHANGE VALUE of 14 bytes behind a prefix of two."""
    f = configured() if ready else flock()
    for k, piece in enumerate(pieces):
        f.receive(1 + k % 2, piece, 0.1 * k)
        f.cycle()
        assert all(len(unit.command) <= 18 for unit in f.units.values())


def test_random_commands_for_as_long_as_asked() -> None:
    """TRAINER_FUZZ_S seconds; 10 by default."""
    rng = np.random.default_rng(23)
    f = configured()
    ends = time.monotonic() + float(os.environ.get("TRAINER_FUZZ_S", "10"))
    table = np.frombuffer(bytes(ARGUMENTS) + b"\xf1\xf2\xa0", dtype=np.uint8)
    now = 2.0
    while time.monotonic() < ends:
        now += float(rng.exponential(0.3))
        data = rng.choice(table, 40) if rng.random() < 0.5 else rng.integers(0, 256, 40, dtype=np.uint8)
        f.receive(int(rng.integers(1, 3)), data.astype(np.uint8).tobytes(), now)
        f.cycle()
        assert all(len(unit.command) <= 18 for unit in f.units.values())


def test_a_quaternion_s_words_turn_by_less_than_a_hundredth_of_a_degree_and_a_half() -> None:
    """Each of four words is off by at most d = 2/32768: |dq| <= 2 d, the angle at most 2 |dq| = 0.014°."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        pose = Rigid(np.array([100.0, 0.0, 0.0]), quaternion_from_axis_angle(rng.normal(size=3), rng.uniform(0, 3)))
        q = np.array(decode(configured(pose=pose).receive(1, b"\\B", 2.0))) / 32768
        q /= np.linalg.norm(q)
        cross = np.linalg.norm(np.outer(q, pose.quaternion) - np.outer(pose.quaternion, q)) / math.sqrt(2)
        assert math.degrees(2 * math.asin(min(1.0, cross))) <= 0.0141


class Port:
    """The port of a simulated flock's first unit; bytes go over it at once."""

    def __init__(self, flock: Flock) -> None:
        self._flock = flock
        self._waiting = b""

    def write(self, data: bytes) -> None:
        self._waiting += self._flock.receive(1, data, time.monotonic())

    def read(self, count: int) -> bytes:
        out, self._waiting = self._waiting[:count], self._waiting[count:]
        return out

    @property
    def in_waiting(self) -> int:
        return len(self._waiting)

    def close(self) -> None:
        """Nothing stays open."""


def connected(f: Flock, monkeypatch: pytest.MonkeyPatch, *addresses: int) -> minibird_flock.Flock:
    """A conversation with a flock whose silences are short, for a profile with birds of these addresses."""
    f._silence_s = 0.001
    monkeypatch.setattr(minibird_flock, "open_port", lambda url, baud: Port(f))
    birds = tuple(Bird(address=a, tool=t) for a, t in zip(addresses, ("left", "right"), strict=False))
    silences = minibird_flock.Silences(0.0, 0.0, 0.01, 0.001, 0.2)
    found = minibird_flock.Flock(MinibirdSpec(port="x", bird=birds), silences)
    found.connect()
    return found


@pytest.mark.parametrize("addresses", [(2,), (2, 3)])
def test_the_unit_at_the_port_speaks_for_all_also_where_it_moves_nothing(
    monkeypatch: pytest.MonkeyPatch, addresses: tuple[int, ...]
) -> None:
    f = flock(*range(1, addresses[-1] + 1))
    [(_, parser)] = connected(f, monkeypatch, *addresses).begin().values()
    found = [s for _ in range(3) for s in parser.feed(b"".join(f.cycle().values()), 0.0)]
    assert [s.address for s in found] == 3 * list(range(1, addresses[-1] + 1))
    assert f.rate_hz == MinibirdSpec(port="x", bird=(Bird(address=1, tool="left"),)).rate_hz


def test_what_an_earlier_program_left_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every eighth cycle only, and bytes of the buttons and of the field's distortion behind each record."""
    f = configured()
    for prefix in (b"", b"\xf2"):
        f.receive(1, b"".join(prefix + command for command in (b"S", b"M\x01", b"s\x01\x00")), 2.0)
    assert len(f.receive(1, b"]B", 2.0)) == 16
    [(_, parser)] = connected(f, monkeypatch, 1, 2).begin().values()
    found = [s for _ in range(5) for s in parser.feed(b"".join(f.cycle().values()), 0.0)]
    assert [(s.address, s.flaw) for s in found] == 5 * [(1, ""), (2, "")]
