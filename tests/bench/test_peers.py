"""``trainer bench peers``: medians of rounds, ratios within a round, and what is said of a peer that is missing."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from statistics import median

import pytest
from conftest import CommandLine

from trainer.bench import peers, peers_page, thread
from trainer.bench.peers import Swings
from trainer.bench.rows import Row

ABOUT = {"cpu": "a processor", "cores": 2, "system": "Linux", "load_before": 0.5, "load_after": 1.0, "versions": {}}
NAN = float("nan")


def swings(method: str, ms: tuple[float, ...], error: float, peer: bool) -> Swings:
    row = Row(peers.CASE, 50, method, "-", 100, median(ms) if ms else NAN, 9.0, error, "reference", 0.0, "converged")
    return Swings(row, ms, peer)


OURS = [swings("chain", (1.0, 2.0, 4.0), 1e-3, False), swings("exact chain", (3.0, 3.0, 3.0), 1e-6, False)]
PEER = swings("mujoco", (300.0, 200.0, 800.0), 1e-3, True)
MISSING = swings("elastica", (), NAN, True)


def test_a_ratio_is_that_of_a_round_to_the_fastest_of_no_larger_error() -> None:
    """Ratios of the rounds: 300, 100, 200. At half of the error the other one of ours is compared: 100, 67, 267.

    To a peer that is better than all of ours there is no ratio, nor to one that is missing.
    """
    (ratio,) = peers_page.ratios([*OURS, PEER, MISSING])
    assert (ratio.ours, ratio.median, ratio.least, ratio.most) == (OURS[0], 200.0, 100.0, 300.0)
    exact = replace(PEER, row=replace(PEER.row, error=5e-4))
    (ratio,) = peers_page.ratios([*OURS, exact])
    assert (ratio.ours, ratio.median) == (OURS[1], 100.0)
    assert peers_page.ratios([*OURS, replace(PEER, row=replace(PEER.row, error=1e-9))]) == []


def test_each_round_swings_everything_once_and_missing_peers_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread, "SECONDS", 0.05)
    for name in peers.PEERS:
        monkeypatch.setitem(sys.modules, name, None)
    found = peers.measure(10, rounds=2)
    missing = [s.row.status for s in found if not s.rounds_ms]
    assert missing == ["not measured: mujoco is not installed", "not measured: elastica is not installed"]
    ours = [s for s in found if s.rounds_ms]
    assert {s.row.method for s in ours} == {"rod", "chain"}
    for s in ours:
        assert not s.peer
        assert (len(s.rounds_ms), s.row.frames) == (2, 10)
        assert min(s.rounds_ms) <= s.row.median_ms <= max(s.rounds_ms)


def test_the_page_has_ratios_rounds_and_versions(tmp_path: Path) -> None:
    about = {**ABOUT, "versions": {"mujoco": "4.0.0"}}
    page, numbers = peers_page.write(tmp_path / "new", [*OURS, PEER], about)
    words = page.read_text(encoding="utf-8")
    assert "mujoco 4.0.0" in words
    assert "| mujoco | - | 300 | 1.0e-03 | chain | - | 2 | 1.0e-03 | 200 | 100 to 300 |" in words
    assert "50 links, one second in frames of 10 ms, 3 rounds" in words
    read = json.loads(numbers.read_text(encoding="utf-8"))
    assert [r["rounds_ms"] for r in read["rows"]] == [[1.0, 2.0, 4.0], [3.0, 3.0, 3.0], [300.0, 200.0, 800.0]]
    assert [(r["peer"], r["median"]) for r in read["ratios"]] == [("mujoco", 200.0)]


def test_the_command_writes_a_report_only_where_all_peers_are(
    monkeypatch: pytest.MonkeyPatch, command_line: CommandLine, tmp_path: Path
) -> None:
    nothing = Row(peers.CASE, 50, "elastica", "-", 0, NAN, NAN, NAN, "said", NAN, peers.MISSING.format("elastica"))
    monkeypatch.setattr(peers, "measure", lambda: [*OURS, Swings(nothing, (), True)])
    code, out, err = command_line("bench", "peers", "--json", "--out", tmp_path)
    assert code == 0
    assert [(r["method"], r["median_ms"]) for r in json.loads(out)["rows"]][1:] == [
        ("exact chain", 3.0),
        ("elastica", None),
    ]
    assert "no report is written" in err
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(peers, "measure", lambda: [*OURS, PEER])
    code, out, err = command_line("bench", "peers", "--out", tmp_path)
    assert code == 0
    assert "exact chain" in out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["peers.json", "peers.md"]
