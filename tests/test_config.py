"""TOML into dataclasses: what is accepted, and that an error names the file, the key and what was expected."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from trainer import config
from trainer.config import Bounds, ConfigError, Sourced


@dataclass(frozen=True)
class Part:
    length_mm: float = field(metadata={"bounds": Bounds(0.0, low_open=True)})
    kind: Literal["soft", "hard"] = "soft"


@dataclass(frozen=True)
class Whole:
    name: str
    count: int = field(metadata={"bounds": Bounds(1, 9)})
    part: tuple[Part, ...] = ()
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    strength_mN: Sourced | None = field(default=None, metadata={"bounds": Bounds(0.0)})
    flag: bool = False
    limits: dict[str, Part] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name == "forbidden":
            raise ValueError("'name' must not be 'forbidden'")


def build(toml: str) -> Whole:
    return config.build(Whole, config.parse_toml(toml, "f.toml"), "f.toml")


def test_every_kind_of_value_arrives_with_its_type() -> None:
    whole = build(
        """
        name = "x"
        count = 3
        point = [1, 2.5, 3]
        strength_mN = { value = 7, source = "assumed" }
        flag = true
        part = [{ length_mm = 2 }, { length_mm = 0.5, kind = "hard" }]
        limits.pull = { length_mm = 1.0 }
        """
    )
    assert whole == Whole(
        name="x",
        count=3,
        point=(1.0, 2.5, 3.0),
        strength_mN=Sourced(7.0, "assumed"),
        flag=True,
        part=(Part(2.0), Part(0.5, "hard")),
        limits={"pull": Part(1.0)},
    )
    assert isinstance(whole.part[0].length_mm, float)


BASE = 'name = "x"\ncount = 3\n'
WRONG = [
    ("count = 3", "f.toml: missing key 'name' (expected a text)"),
    (BASE + "part = [{ length_um = 2 }]", "f.toml: [part[0]]: unknown key 'length_um', did you mean 'length_mm'?"),
    (BASE + "zzz = 1", "f.toml: unknown key 'zzz'; known keys: name, count, part, point, strength_mN, flag, limits"),
    ("name = 3\ncount = 3", "f.toml: 'name' expected a text, found int '3'"),
    ('name = "x"\ncount = 3.5', "f.toml: 'count' expected a whole number, found float '3.5'"),
    ('name = "x"\ncount = true', "f.toml: 'count' expected a whole number, found bool 'True'"),
    (BASE + "flag = 1", "f.toml: 'flag' expected true or false, found int '1'"),
    ('name = "x"\ncount = 10', "f.toml: 'count' must be >= 1 and <= 9, found 10"),
    (BASE + "part = [{ length_mm = 0.0 }]", "f.toml: 'part[0].length_mm' must be > 0, found 0"),
    (BASE + "part = [{ length_mm = nan }]", "f.toml: 'part[0].length_mm' must be finite, found nan"),
    (
        BASE + "part = [{ length_mm = 1" + "0" * 400 + " }]",
        "f.toml: 'part[0].length_mm' must be finite, found a number of 1329 bits",
    ),
    ('name = "x"\ncount = 1' + "0" * 400, "f.toml: 'count' must be finite, found a number of 1329 bits"),
    (BASE + "part = [{ length_mm = inf }]", "f.toml: 'part[0].length_mm' must be finite, found inf"),
    (BASE + 'part = [{ length_mm = "2" }]', "f.toml: 'part[0].length_mm' expected a number, found str '2'"),
    (
        BASE + 'part = [{ length_mm = 1, kind = "wet" }]',
        "f.toml: 'part[0].kind' must be one of 'soft', 'hard', found 'wet'",
    ),
    (BASE + "part = [3]", "f.toml: [part[0]]: expected a table, found int '3'"),
    (BASE + "part = 3", "f.toml: 'part' expected a list, found int '3'"),
    (BASE + "point = [1, 2]", "f.toml: 'point' expected 3 values, found 2"),
    (BASE + "limits = 3", "f.toml: 'limits' expected a table, found int '3'"),
    (BASE + "strength_mN = 3.0", "f.toml: [strength_mN]: expected a table, found float '3.0'"),
    (BASE + "strength_mN = { value = 3.0 }", "f.toml: [strength_mN]: missing key 'source' (expected a text)"),
    (
        BASE + 'strength_mN = { value = 3.0, source = " " }',
        "f.toml: 'strength_mN.source' is empty; name the source or write 'assumed: …'",
    ),
    (BASE + 'strength_mN = { value = -1.0, source = "a" }', "f.toml: 'strength_mN' must be >= 0, found -1"),
    ('name = "forbidden"\ncount = 3', "f.toml: 'name' must not be 'forbidden'"),
]


@pytest.mark.parametrize(("toml", "message"), WRONG, ids=[message for _, message in WRONG])
def test_an_error_is_one_line_that_says_where_and_what(toml: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        build(toml)
    assert str(caught.value) == message


def test_a_file_that_is_no_toml_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^f\.toml: not valid TOML: .*line 2"):
        config.parse_toml("a = 1\nname = ?", "f.toml")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file$"):
        config.read_toml(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match=r"Is a directory$"):
        config.read_toml(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"name = '\xe9'")
    with pytest.raises(ConfigError, match=r"latin\.toml: not UTF-8 text$"):
        config.read_toml(tmp_path / "latin.toml")


@pytest.mark.parametrize(
    ("bounds", "inside", "outside"),
    [
        (Bounds(0.0), 0.0, -1e-300),
        (Bounds(0.0, low_open=True), 1e-300, 0.0),
        (Bounds(1.0, 2.0), 2.0, 2.0000001),
        (Bounds(high=3.0), -1e300, 3.1),
    ],
)
def test_bounds_hold_their_ends_unless_open(bounds: Bounds, inside: float, outside: float) -> None:
    assert bounds.accepts(inside)
    assert not bounds.accepts(outside)


def test_a_mark_of_a_spreadsheet_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes("\ufefftime_s,größe\n".encode())
    assert config.read_text(path) == "time_s,größe\n"
