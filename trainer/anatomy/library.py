"""A knee by what a task or a command line calls it: the name of a built-in one, or the folder of an imported one."""

from __future__ import annotations

from pathlib import Path

from trainer.anatomy import imported, knee
from trainer.anatomy.imported import Anatomy
from trainer.config import ConfigError


def load(reference: str, voxel_mm: float = knee.USUAL_MM) -> Anatomy:
    """The knee ``reference``; ``voxel_mm`` is the resolution of a built-in one. Raises ConfigError."""
    if reference in knee.names():
        spec = knee.load(reference)
        return Anatomy(reference, knee.build(spec, voxel_mm), spec.side)
    folder = Path(reference)
    if not folder.is_dir():
        raise ConfigError(
            f"no knee '{reference}': expected {', '.join(knee.names())}, or a folder that `anatomy import` made"
        )
    return imported.load(folder)
