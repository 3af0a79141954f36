"""A calibration's file says exactly what was measured, and a profile goes by the newest one or by the one it names."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer import calibration, config
from trainer.calibration import Calibration, Distortion, Placement, Tip
from trainer.config import ConfigError
from trainer.profile import load_profile, profile_names

PROFILE = """name = "mine"
driver = "recording"
summary = "test"
[recording]
path = "a.csv"
position_mm = [1.0, 2.0, 3.0]
[[recording.sensor]]
name = "Probe"
tool = "right"
[[recording.sensor]]
name = "Stylus"
tool = "left"
position_mm = [0.0, 0.0, 7.0]
"""
PLACE = Placement((10.0, 0.1, -5e-5), (0.0, 30.0, 1.0 / 3.0), 0.04, 12)
TIP = Tip("Probe", (1.0, 2.0, 110.0), 0.1, 0.01, 300)
BENT = Distortion(1, (0.0, 0.0, 0.0), (100.0, 90.0, 80.0), ((0.1, 0.0, 0.0),) * 4, 2.0, 0.3, 144)
DATE = "2026-03-04T05:06:07+00:00"

numbers = st.floats(-1e4, 1e4)
vectors = st.tuples(numbers, numbers, numbers)
degrees = st.floats(-360.0, 360.0)
sizes = st.floats(0.0, 1e4)


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    order = draw(st.integers(1, 4))
    rows = (order + 1) * (order + 2) * (order + 3) // 6
    count = st.integers(3, 10**6)
    place = st.builds(Placement, vectors, st.tuples(degrees, degrees, degrees), sizes, count)
    names = st.text(st.characters(exclude_categories=["Cs"]))
    tips = st.lists(st.builds(Tip, names, vectors, sizes, sizes, count), max_size=2).map(tuple)
    halves = st.tuples(*[st.floats(1e-3, 1e4)] * 3)
    random = Random(draw(st.integers(0, 2**32 - 1)))
    coefficients = tuple((random.gauss(0, 1), random.gauss(0, 1e-9), random.uniform(-1e4, 1e4)) for _ in range(rows))
    bent = st.builds(Distortion, st.just(order), vectors, halves, st.just(coefficients), sizes, sizes, count)
    return Calibration(DATE, draw(st.none() | place), draw(tips), draw(st.none() | bent))


@settings(max_examples=50)
@given(calibrations())
def test_what_is_written_is_read_exactly(made: Calibration) -> None:
    text = calibration.to_toml(made)
    assert config.build(Calibration, config.parse_toml(text, "c")["calibration"], "c", "calibration") == made


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(PROFILE)
    return path


def put(profile: Path, date: str = DATE, **parts: object) -> Path:
    made = Calibration(date, **parts)  # type: ignore[arg-type]
    path = calibration.path_for(profile, made)
    calibration.write(path, made)
    return path


def test_without_a_calibration_a_profile_is_what_it_says(profile: Path) -> None:
    file = load_profile(str(profile))
    assert file.text == PROFILE
    assert file.profile.calibration is None


def test_what_was_measured_takes_the_place_of_what_the_profile_says_and_the_rest_stays(profile: Path) -> None:
    path = put(profile, scene=PLACE, tip=(TIP,), distortion=BENT)
    assert path.name == "mine.calibration-2026-03-04T050607Z.toml"
    file = load_profile(str(profile))
    spec = file.profile.recording
    assert spec is not None
    assert (spec.position_mm, spec.rotation_deg) == (PLACE.position_mm, PLACE.rotation_deg)
    assert [s.position_mm for s in spec.sensor] == [TIP.position_mm, (0.0, 0.0, 7.0)]
    assert spec.distortion == BENT
    assert spec.scale == 1.0
    put(profile, "2026-03-05T00:00:00+00:00", tip=(TIP,))
    spec = load_profile(str(profile)).profile.recording
    assert spec is not None
    assert spec.position_mm == (1.0, 2.0, 3.0)
    assert spec.distortion is None


def test_the_text_that_a_session_stores_says_all(profile: Path) -> None:
    """It holds both files, names the calibration, and gives the same profile again wherever it is read."""
    path = put(profile, scene=PLACE)
    file = load_profile(str(profile))
    assert file.text == f"{PROFILE}\n# {path.name}\n{path.read_text()}"
    elsewhere = profile.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "stored.toml").write_text(file.text)
    assert load_profile(str(elsewhere / "stored.toml")).profile == file.profile


def test_the_newest_is_used_unless_one_is_named_or_none(profile: Path) -> None:
    dates = ["2026-10-01T00:00:00+00:00", "2026-09-30T23:59:59+00:00", "2025-12-31T00:00:00+00:00"]
    paths = [put(profile, date, scene=PLACE) for date in dates]
    put(profile.with_name("mine-too.toml"), "2027-01-01T00:00:00+00:00", scene=PLACE)  # another profile's

    def used() -> str | None:
        found = load_profile(str(profile)).profile.calibration
        return None if found is None else found.date

    assert used() == dates[0]
    profile.write_text(f'calibrated_by = "{paths[2].name}"\n{PROFILE}')
    assert used() == dates[2]
    profile.write_text(f'calibrated_by = "none"\n{PROFILE}')
    assert used() is None
    profile.write_text(f'calibrated_by = "mine.toml"\n{PROFILE}')
    with pytest.raises(ConfigError, match=r"no calibration 'mine\.toml' beside it; known: mine\.calibration-2025"):
        used()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[calibration", "[calibrated", r"\[calibration\]: expected a table"),
        ("points", "punkte", r"\[calibration\.scene\]: unknown key 'punkte', did you mean 'points'\?"),
        ("date = ", "#", r"\[calibration\]: missing key 'date'"),
        ("2026-03", "yesterday", r"'date' expected 2026-01-31T12:00:00\+00:00, found 'yesterday"),
        ("residual_mm = 0.04", "residual_mm = nan", r"'calibration\.scene\.residual_mm' must be finite"),
        ("position_mm", "position_mm = = [", "not valid TOML"),
    ],
)
def test_a_damaged_calibration_is_one_line_that_names_it(profile: Path, old: str, new: str, complaint: str) -> None:
    path = put(profile, scene=PLACE)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=complaint) as caught:
        load_profile(str(profile))
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_calibration_of_a_sensor_that_is_gone_is_told(profile: Path) -> None:
    put(profile, tip=(TIP,))
    profile.write_text(PROFILE.replace('"Probe"', '"Pointer"'))
    with pytest.raises(ConfigError, match="the calibration is of a sensor 'Probe', which the profile does not have"):
        load_profile(str(profile))


def test_a_polynomial_has_as_many_rows_as_its_order() -> None:
    with pytest.raises(ValueError, match="'coefficient_mm' has 4 rows, which order 2 does not have"):
        Distortion(2, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), ((0.0, 0.0, 0.0),) * 4, 1.0, 0.5, 40)


def test_nothing_is_overwritten_and_files_are_no_profiles(profile: Path) -> None:
    path = put(profile, scene=PLACE)
    with pytest.raises(ConfigError, match="exists already; wait a second"):
        put(profile)
    assert calibration.beside(profile) == [path]
    assert not [name for name in profile_names() if "calibration" in name]


def test_the_age_of_a_calibration() -> None:
    now = datetime(2026, 3, 5, 5, 6, 7, tzinfo=UTC)
    assert Calibration(DATE).age_s(now) == timedelta(days=1).total_seconds()
    assert Calibration("2026-03-04T06:06:07+01:00").age_s(now) == timedelta(days=1).total_seconds()
    assert Calibration("2026-03-04T05:06:07").age_s(now) == timedelta(days=1).total_seconds()
