"""A simulated station is its profile's, whatever order the profile's tables have, and sleeps while nothing is due."""

from __future__ import annotations

import math
import select
import tomllib
from pathlib import Path

import pytest

from trainer.config import ConfigError
from trainer.profile import Bird, MinibirdSpec
from trainer.simulators.faults import Faults
from trainer.simulators.hands import open_hands
from trainer.simulators.station import IDLE_S, Station, with_ports

TABLES = (
    '[minibird]\nport = "a"\nanchor = "home"\n',
    '[[minibird.bird]]\naddress = 1\ntool = "left"\n',
    '[closure]  # = the board\nport="b"\n[[closure.jaw]]\ntool = "left"\n',
    "[publish]\nport = 7\n",
)


@pytest.mark.parametrize("tables", [TABLES, TABLES[::-1], (TABLES[2], *TABLES[:2], TABLES[3])])
def test_each_table_gets_its_own_port(tables: tuple[str, ...]) -> None:
    written = tomllib.loads(with_ports("".join(tables), [Path("/flock"), Path("/closure")], in_scene=True))
    assert written["minibird"] == {"port": "/flock", "anchor": "none", "bird": [{"address": 1, "tool": "left"}]}
    assert (written["closure"]["port"], written["publish"]["port"]) == ("/closure", 7)


def test_birds_with_ports_of_their_own_keep_their_order() -> None:
    text = "[publish]\nport = 7\n" + "".join(f'[[minibird.bird]]\naddress = {a}\nport = "x"\n' for a in (2, 1))
    birds = tomllib.loads(with_ports(text, [Path("/b2"), Path("/b1")], in_scene=False))["minibird"]["bird"]
    assert birds == [{"address": 2, "port": "/b2"}, {"address": 1, "port": "/b1"}]


def test_a_station_without_a_board_sleeps_until_its_next_cycle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its loop waits for up to a measurement cycle, 1/103 s, instead of not at all."""
    spec = MinibirdSpec(port="x", bird=(Bird(address=1, tool="left"),))
    station = Station(spec, None, open_hands("", spec), [tmp_path / "flock"], 1.0, Faults(), Faults(), 0)
    waits: list[float] = []
    monkeypatch.setattr(select, "select", lambda lines, out, wrong, seconds: waits.append(seconds))
    station.run(lambda: len(waits) >= 3 and (max(waits) > 0.0 or len(waits) >= 1000))
    assert math.fsum(waits) > 0.0
    assert max(waits) <= IDLE_S


@pytest.mark.parametrize("missing", [1, 99])
def test_a_bird_that_cannot_be_missing_is_told(tmp_path: Path, missing: int) -> None:
    spec = MinibirdSpec(port="x", bird=(Bird(address=1, tool="left"),))
    with pytest.raises(ConfigError, match=f"no-bird={missing}: one of 1"):
        Station(spec, None, open_hands("", spec), [tmp_path / "f"], 1.0, Faults(no_bird=missing), Faults(), 0)
