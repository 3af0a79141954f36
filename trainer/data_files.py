"""Where the data that people other than programmers edit is found: curricula, devices, report templates."""

from __future__ import annotations

from pathlib import Path


def data_folder(name: str) -> Path:
    """The folder ``curricula``, ``devices`` or ``reports``: beside the package in a checkout, inside it in a wheel."""
    package = Path(__file__).parent
    checkout = package.parent / name
    return checkout if (package.parent / "pyproject.toml").exists() and checkout.is_dir() else package / "_data" / name
