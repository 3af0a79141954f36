"""The report of ``trainer bench peers``: a page in Markdown, and the numbers."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trainer.bench import peers
from trainer.bench.machine import in_words
from trainer.bench.page import ms
from trainer.bench.peers import Swings


@dataclass(frozen=True)
class Ratio:
    """A peer's time over that of the fastest of ours whose error is no larger."""

    peer: Swings
    ours: Swings
    median: float  # over the rounds
    least: float
    most: float


def ratios(found: Sequence[Swings]) -> list[Ratio]:
    """For each setting of each peer that was measured; one that none of ours equals has none."""
    compared = []
    for peer in (s for s in found if s.peer and s.rounds_ms):
        enough = [s for s in found if not s.peer and s.row.error <= peer.row.error]
        if enough:
            ours = min(enough, key=lambda s: s.row.median_ms)
            of_rounds = np.array(peer.rounds_ms) / np.array(ours.rounds_ms)
            compared.append(Ratio(peer, ours, *(float(f(of_rounds)) for f in (np.median, np.min, np.max))))
    return compared


def document(found: Sequence[Swings], about: dict[str, Any]) -> dict[str, Any]:
    """What ``--json`` prints and ``peers.json`` holds; null for what was not measured."""
    return {
        "machine": about,
        "rows": [{**_plain(asdict(s.row)), "peer": s.peer, "rounds_ms": list(s.rounds_ms)} for s in found],
        "ratios": [
            {
                "peer": r.peer.row.method, "peer_setting": r.peer.row.setting, "peer_error": r.peer.row.error,
                "method": r.ours.row.method, "setting": r.ours.row.setting, "error": r.ours.row.error,
                "median": r.median, "least": r.least, "most": r.most,
            }
            for r in ratios(found)
        ],
    }  # fmt: skip


def _plain(numbers: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in numbers.items()}


def write(folder: Path, found: Sequence[Swings], about: dict[str, Any]) -> list[Path]:
    """``peers`` .md and .json in ``folder``, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {
        folder / "peers.md": markdown(found, about),
        folder / "peers.json": json.dumps(document(found, about), indent=1, allow_nan=False) + "\n",
    }
    for path, words in written.items():
        path.write_text(words, encoding="utf-8")
    return list(written)


def markdown(found: Sequence[Swings], about: dict[str, Any]) -> str:
    timed = [s for s in found if s.rounds_ms]
    lines = [
        "# A chain here and in other programs",
        "",
        f"Written by `trainer bench peers`. {in_words(about)}.",
        "",
        inspect.getdoc(peers) or "",
        "",
        f"{peers.CASE}: {timed[0].row.size} links, one second in frames of 10 ms, {len(timed[0].rounds_ms)} rounds.",
        f"Error of the {timed[0].row.error_of}.",
        "",
        "Each peer's setting beside the fastest of ours whose error is no larger:",
        "",
        "| peer | setting | ms | error | ours | setting | ms | error | times as fast: median | least to most |",
        "|---|---|--:|--:|---|---|--:|--:|--:|--:|",
    ]
    for r in ratios(found):
        sides = " | ".join(
            f"{s.row.method} | {s.row.setting} | {ms(s.row.median_ms)} | {s.row.error:.1e}" for s in (r.peer, r.ours)
        )
        lines.append(f"| {sides} | {ms(r.median)} | {ms(r.least)} to {ms(r.most)} |")
    lines += ["", "| method | setting | frames | median ms | rounds | p90 ms | error | lengths |"]
    lines += ["|---|---|--:|--:|--:|--:|--:|--:|"]
    for s in found:
        if s.rounds_ms:
            spread = f"{ms(min(s.rounds_ms))} to {ms(max(s.rounds_ms))}"
            numbers = (
                f"{ms(s.row.median_ms)} | {spread} | {ms(s.row.p90_ms)} | {s.row.error:.1e} | {s.row.residual:.1e}"
            )
            lines.append(f"| {s.row.method} | {s.row.setting} | {s.row.frames} | {numbers} |")
        else:
            lines.append(f"| {s.row.method} | {s.row.status} | 0 | | | | | |")
    return "\n".join([*lines, ""])
