"""The report of ``trainer bench soak``: a page in Markdown, and the numbers."""

from __future__ import annotations

import inspect
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from trainer.bench import soak as bench
from trainer.bench.machine import in_words
from trainer.bench.soak import Soak
from trainer.clock import pace

#: Readings at the beginning of a session after which all that it needs is in memory, a second each.
WARM_S = 20


def document(soak: Soak, minutes: float, tick_hz: float, about: dict[str, Any]) -> dict[str, Any]:
    """What ``--json`` prints and ``realtime.json`` holds; numbers of nothing are None."""
    at_s, rss, of = np.array(soak.at_s), np.array(soak.rss_mb), np.array(soak.session_of)
    last = len(soak.sessions) - 1
    warm = of > 0 if last > 0 else of == 0
    settled = np.flatnonzero(of == last)[WARM_S:]
    waiting: dict[str, int] = {}
    for session in soak.sessions:
        for name, most in session.waiting.items():
            waiting[name] = max(waiting.get(name, 0), most)
    return {
        "minutes_asked": minutes,
        "minutes": len(soak.work_ms) / tick_hz / 60.0,
        "machine": about,
        "pace": pace(tick_hz, soak.work_ms),
        "latency_ms": soak.latency.summary(),
        "memory_mb": {
            "start": _first(rss),
            "warm": _first(rss[warm]),
            "end": _first(rss[::-1]),
            "slope_per_minute": _slope(at_s[warm] / 60.0, rss[warm]),
            "slope_per_minute_last_session": _slope(at_s[settled] / 60.0, rss[settled]),
        },
        "waiting_most": waiting,
        "drift_ticks_most": max((s.drift_ticks for s in soak.sessions), default=None),
        "losses": sum(s.losses for s in soak.sessions),
        "sessions": [asdict(s) for s in soak.sessions],
        "rss_mb": [[round(float(t), 1), round(float(m), 2)] for t, m in zip(at_s, rss, strict=True)],
    }


def write(folder: Path, found: dict[str, Any], quick: bool) -> list[Path]:
    """``realtime`` .md and .json in ``folder``, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {
        folder / "realtime.md": markdown(found, quick),
        folder / "realtime.json": json.dumps(found, indent=1, allow_nan=False) + "\n",
    }
    for path, words in written.items():
        path.write_text(words, encoding="utf-8")
    return list(written)


def markdown(found: dict[str, Any], quick: bool) -> str:
    lines = [
        "# A station in real time",
        "",
        f"Written by `trainer bench soak{' --quick' if quick else ''}`. {in_words(found['machine'])}.",
        "",
        (inspect.getdoc(bench) or "").partition("\n\n")[2],
        "",
        "| what | |",
        "|---|---|",
        *(f"| {what} | {value} |" for what, value in rows(found)),
        "",
        "| session | outcome | ticks | overruns | losses | most drift, ticks |",
        "|--:|---|--:|--:|--:|--:|",
    ]
    for k, s in enumerate(found["sessions"], 1):
        ending = s["outcome"] or "broken off"
        lines.append(f"| {k} | {ending} | {s['ticks']} | {s['overruns']} | {s['losses']} | {s['drift_ticks']:.2f} |")
    return "\n".join([*lines, ""])


def rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The figures in words."""
    work, late, memory = found["pace"], found["latency_ms"], found["memory_mb"]
    waiting = ", ".join(f"{name} {most}" for name, most in found["waiting_most"].items())
    return [
        ("sessions", f"{len(found['sessions'])}, {found['minutes']:.1f} min of {found['minutes_asked']:g} asked for"),
        (
            "work per tick",
            f"median {work['p50_ms']:.2f} ms, 99 % within {work['p99_ms']:.2f} ms, longest {work['max_ms']:.2f} ms",
        ),
        ("overruns", f"{work['overruns']}"),
        (
            "byte to event",
            f"median {late['p50']:.2f} ms, 99 % within {late['p99']:.2f} ms, longest {late['max']:.2f} ms, "
            f"{late['poses']} poses",
        ),
        ("memory", f"{_mb(memory['start'])} at the start, {_mb(memory['warm'])} warm, {_mb(memory['end'])} at the end"),
        (
            "slope of memory",
            f"{_mb(memory['slope_per_minute'])} a minute when warm, "
            f"{_mb(memory['slope_per_minute_last_session'])} a minute in the last session",
        ),
        ("most waiting", waiting or "–"),
        ("drift", f"at most {found['drift_ticks_most'] or 0.0:.2f} ticks"),
        ("instruments lost", f"{found['losses']}"),
    ]


def _mb(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} MB"


def _first(values: np.ndarray) -> float | None:
    return float(values[0]) if len(values) else None


def _slope(t: np.ndarray, values: np.ndarray) -> float | None:
    return float(np.polyfit(t, values, 1)[0]) if len(t) > 1 and t[-1] > t[0] else None
