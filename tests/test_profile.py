"""Every shipped device by existing, and what a device's file may not say."""

from __future__ import annotations

import pytest

from trainer import profile
from trainer.config import ConfigError

HAND = 'name = "x"\ndriver = "scripted"\nsummary = "x"\n[hand]\n'
RECORDING = 'name = "x"\ndriver = "recording"\nsummary = "x"\n[recording]\n'
SENSOR = RECORDING + '[[recording.sensor]]\nname = "s"\ntool = "left"\n'


@pytest.mark.parametrize("name", profile.profile_names())
def test_a_shipped_profile_loads(name: str) -> None:
    assert profile.load_profile(name).profile.name == name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HAND + "seed = -1", r"'hand\.seed' must be >= 0"),
        (HAND + f"seed = {2**63}", f"'hand\\.seed' must be >= 0 and <= {2**63 - 1}, found {2**63}$"),
        (HAND + "wander_mm = 50.1", r"'hand\.wander_mm' must be >= 0 and <= 50, found 50\.1"),
        (HAND + "aim_error_mm = 5.1", r"'hand\.aim_error_mm' must be >= 0 and <= 5, found 5\.1"),
        (HAND + "tremor_rms_um = 1e9", r"'hand\.tremor_rms_um' must be >= 0 and <= 5000, found 1e\+09"),
        (HAND + "speed_mm_s = 1e-9", r"'hand\.speed_mm_s' must be >= 0\.01 and <= 1000, found 1e-09"),
        (HAND + "speed_mm_s = 1e9", r"'hand\.speed_mm_s' must be >= 0\.01 and <= 1000, found 1e\+09"),
        (HAND + "hesitation_s = 61", r"'hand\.hesitation_s' must be >= 0 and <= 60, found 61"),
        (HAND + "bite_mm = 101", r"'hand\.bite_mm' must be > 0 and <= 100, found 101"),
        (HAND + "clock_deg = 361", r"'hand\.clock_deg' must be >= -360 and <= 360, found 361"),
        (HAND + "entry_angle_error_deg = 91", r"'hand\.entry_angle_error_deg' must be >= 0 and <= 90, found 91"),
        (RECORDING + "scale = 1e-7", r"'recording\.scale' must be >= 1e-06 and <= 1e\+06, found 1e-07"),
        (RECORDING + "position_mm = [0, 1e300, 0]", r"'recording\.position_mm\[1\]' must be >= -100000 and <= 100000"),
        (SENSOR + "position_mm = [0, 0, -1e6]", r"'recording\.sensor\[0\]\.position_mm\[2\]' must be >= -100000"),
        (SENSOR + "rotation_deg = [0, 0, 1e6]", r"'recording\.sensor\[0\]\.rotation_deg\[2\]' must be >= -360"),
    ],
)
def test_a_number_that_no_device_has_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^d\\.toml: {message}") as caught:
        profile.parse_profile(text, "d.toml")
    assert "\n" not in str(caught.value)


def test_the_largest_seed_is_taken() -> None:
    hand = profile.parse_profile(HAND + f"seed = {2**63 - 1}", "d.toml").hand
    assert hand is not None
    assert hand.seed == 2**63 - 1


FLOCK = 'name = "x"\ndriver = "minibird"\nsummary = "x"\n[minibird]\n'
BIRDS = "".join(f'[[minibird.bird]]\naddress = {a}\ntool = "{t}"\n' for a, t in ((1, "left"), (2, "right")))
CLOSURE = '[closure]\nport = "c"\n[[closure.jaw]]\ntool = "left"\nopen = 100\nclosed = 105\n'
JAWS = CLOSURE.replace("105", "805")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FLOCK + "bird = []", r"a flock needs a table \[\[minibird\.bird\]\]"),
        (FLOCK + BIRDS, "give 'port' for the flock in group mode, or a port to each bird"),
        (FLOCK + 'port = "p"\n' + BIRDS.replace("2", "1"), "two birds have the same address"),
        (FLOCK + 'port = "p"\n' + BIRDS.replace("right", "left"), "two birds have the same tool"),
        (FLOCK + BIRDS + 'port = "p"\n', "either each bird has a port of its own, or none has one"),
        (FLOCK + 'port = "p"\n' + BIRDS.replace("2", "15"), r"'minibird\.bird\[1\]\.address' must be >= 1 and <= 14"),
        (FLOCK + 'port = "p"\nrate_hz = 200\n' + BIRDS, r"'minibird\.rate_hz' must be >= 20 and <= 144, found 200"),
        (FLOCK + 'port = "p"\n' + BIRDS + CLOSURE, "'open' and 'closed' must be at least 10 counts apart"),
        (FLOCK + BIRDS.replace("tool", 'port = "p"\ntool'), "two birds have the same port; in group mode give it to"),
        (FLOCK + 'port = "p"\nrate_hz = nan\n' + BIRDS, "'minibird.rate_hz' "),
        (FLOCK + 'port = "p"\nhemisphere = "-forward"\n' + BIRDS, "'minibird.hemisphere' "),
        (FLOCK + 'port = "p"\nbaud = 300\n' + BIRDS, "'minibird.baud' must be >= 2400"),
        (FLOCK + 'port = "c"\n' + BIRDS + JAWS, "tracker and closure sensor have the same port 'c'"),
        (FLOCK + 'port = "p"\n' + BIRDS + JAWS.replace('"c"', '""'), "'port' is empty; give the board's"),
        (
            FLOCK + 'port = "p"\n' + BIRDS + JAWS + JAWS[JAWS.index("[[") :],
            "one table .* for each tool",
        ),
    ],
)
def test_a_flock_that_cannot_be_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        profile.parse_profile(text, "x.toml")


def test_a_calibration_places_the_sensors_and_the_scene_of_a_flock() -> None:
    measured = """
[calibration]
date = "2026-01-31T12:00:00+00:00"
[calibration.scene]
position_mm = [1.0, 2.0, 3.0]
rotation_deg = [0.0, 0.0, 90.0]
residual_mm = 0.1
points = 4
[[calibration.tip]]
sensor = "bird2"
position_mm = [0.0, 0.0, 42.0]
residual_mm = 0.1
uncertainty_mm = 0.1
poses = 100
"""
    spec = profile.parse_profile(FLOCK + 'port = "p"\n' + BIRDS + measured, "x.toml").minibird
    assert spec is not None
    assert spec.position_mm == (1.0, 2.0, 3.0)
    assert [bird.position_mm for bird in spec.bird] == [(0.0, 0.0, 0.0), (0.0, 0.0, 42.0)]
    with pytest.raises(ConfigError, match="of a sensor 'bird7'"):
        profile.parse_profile(FLOCK + 'port = "p"\n' + BIRDS + measured.replace("bird2", "bird7"), "x.toml")


def of(driver: str, table: str) -> str:
    return f'name = "x"\ndriver = "{driver}"\nsummary = "x"\n[{driver}]\n{table}'


def tracked(table: str, *named: tuple[str, str]) -> str:
    return "".join(f'[[{table}]]\nname = "{name}"\ntool = "{tool}"\n' for name, tool in named)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (of("openigtlink", ""), r"\[openigtlink\]: missing key 'device'"),
        (of("openigtlink", "device = []"), r"a tracker needs a table \[\[openigtlink\.device\]\]"),
        (
            of("openigtlink", tracked("openigtlink.device", ("A", "left"), ("A", "right"))),
            r"two tables \[\[openigtlink\.device\]\] have the same name",
        ),
        (
            of("openigtlink", tracked("openigtlink.device", ("A", "left"), ("B", "left"))),
            r"two tables \[\[openigtlink\.device\]\] have the same tool",
        ),
        (
            of("openigtlink", "port = 65536\n" + tracked("openigtlink.device", ("A", "left"))),
            r"'openigtlink\.port' must be >= 1 and <= 65535, found 65536",
        ),
        (of("ndi", 'tracker = "aurora"\n' + tracked("ndi.sensor", ("A", "left"))), r"an aurora its serial 'port'"),
        (
            of("ndi", 'tracker = "vega"\nhost = "h"\nport = "p"\n' + tracked("ndi.sensor", ("A", "left"))),
            r"a vega needs its 'host'",
        ),
        (
            of("ndi", 'tracker = "polaris"\nport = "p"\n' + tracked("ndi.sensor", ("A", "left"))),
            r"'rom' names a file for each sensor",
        ),
        (of("spacemouse", 'tool = "left"\nopen_button = 0'), r"'close_button' and 'open_button' must differ"),
        (of("spacemouse", 'tool = "left"\nspeed_mm_s = 0'), r"'spacemouse\.speed_mm_s' must be >= 0\.01"),
        (HAND + "[publish]\nport = 0", r"'publish\.port' must be >= 1"),
        (HAND.replace("scripted", "ndi"), r"driver 'ndi' needs a table \[ndi\]"),
    ],
)
def test_a_device_of_a_lab_that_cannot_be_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"^d\.toml: .*{message}") as caught:
        profile.parse_profile(text, "d.toml")
    assert "\n" not in str(caught.value)


CALIBRATION = """
[calibration]
date = "2026-03-04T05:06:07+00:00"
[calibration.scene]
position_mm = [1, 2, 3]
rotation_deg = [0, 0, 90]
residual_mm = 0.1
points = 4
[[calibration.tip]]
sensor = "A"
position_mm = [0, 0, 42]
residual_mm = 0.1
uncertainty_mm = 0.1
poses = 100
"""


@pytest.mark.parametrize("driver", ["openigtlink", "ndi"])
def test_a_calibration_is_in_effect_for_a_lab_s_tracker(driver: str) -> None:
    table = "ndi.sensor" if driver == "ndi" else "openigtlink.device"
    head = 'tracker = "aurora"\nport = "p"\n' if driver == "ndi" else ""
    found = profile.parse_profile(of(driver, head + tracked(table, ("A", "left"), ("B", "right"))) + CALIBRATION, "d")
    spec = found.ndi or found.openigtlink
    assert spec is not None
    assert (spec.position_mm, spec.rotation_deg) == ((1.0, 2.0, 3.0), (0.0, 0.0, 90.0))
    sensors = found.ndi.sensor if found.ndi is not None else spec.device  # type: ignore[union-attr]
    assert [s.position_mm for s in sensors] == [(0.0, 0.0, 42.0), (0.0, 0.0, 0.0)]
    with pytest.raises(ConfigError, match="the calibration is of a sensor 'A', which the profile does not have"):
        profile.parse_profile(of(driver, head + tracked(table, ("B", "right"))) + CALIBRATION, "d")
