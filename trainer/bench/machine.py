"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, system, and the load now, before the measurement."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "load_before": load(),
    }


def load() -> float | None:
    """Mean number of running processes in the last minute, this one included; None where the system has no such."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def in_words(about: dict[str, Any]) -> str:
    """One line of :func:`machine` with ``load_after`` the measurement and ``versions`` by name."""
    words = [f"{about['cpu']}, {about['cores']} cores, {about['system']}"]
    if about["load_before"] is not None:
        words.append(f"load {about['load_before']} before and {about['load_after']} after")
    words += [f"{name} {version}" for name, version in about["versions"].items() if name != "machine"]
    return "; ".join(words)


def _cpu() -> str:
    """The processor's name: Linux keeps it in a file, other systems may tell."""
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or "unknown"
