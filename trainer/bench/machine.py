"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, system, and the load (mean of running processes) of the last minute.

    What the system does not tell is "unknown" or absent.
    """
    found: dict[str, Any] = {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
    }
    if hasattr(os, "getloadavg"):
        found["load_before"] = round(os.getloadavg()[0], 2)
    return found


def in_words(about: dict[str, Any]) -> str:
    """One line of :func:`machine` and, where it has them, versions."""
    words = [f"{about['cpu']}, {about['cores']} cores, {about['system']}"]
    if "load_before" in about:
        words.append(f"load before the run {about['load_before']}")
    words += [f"{name} {version}" for name, version in about.get("versions", {}).items()]
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
