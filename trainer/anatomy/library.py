"""A knee by what a task or a command line calls it: the name of a built-in one, or the folder of an imported one."""

from __future__ import annotations

import hashlib
from pathlib import Path

from trainer.anatomy import imported, knee
from trainer.anatomy.imported import Anatomy
from trainer.config import ConfigError
from trainer.curriculum import AnatomySpec


def load(reference: str, voxel_mm: float = knee.USUAL_MM) -> Anatomy:
    """The knee ``reference``; ``voxel_mm`` is the resolution of a built-in one. Raises ConfigError."""
    if reference in knee.names():
        spec = knee.load(reference)
        return Anatomy(reference, knee.build(spec, voxel_mm), spec.side, reference)
    folder = Path(reference)
    if folder.is_file():
        raise ConfigError(
            f"{folder}: a file, not a knee; import it first: trainer anatomy import {folder} --labels TOML --out DIR"
        )
    if not folder.is_dir():
        raise ConfigError(
            f"no knee '{reference}': expected {', '.join(knee.names())}, or a folder that `anatomy import` made"
        )
    return imported.load(folder)


def of_task(spec: AnatomySpec | None, reference: str = "") -> Anatomy | None:
    """The knee ``reference`` for a task, or without one the task's own; None where a task has no knee.

    Raises ConfigError.
    """
    if spec is None or spec.knee is None:
        if reference:
            raise ConfigError("this task takes place in no knee that could be another one: leave --anatomy out")
        return None
    return load(reference or spec.knee.name, spec.knee.voxel_mm)


def fingerprint(anatomy: Anatomy) -> str:
    """SHA-256 (hexadecimal) of all of a knee that a scene is made of: labels, where they lie, and the side."""
    volume = anatomy.volume
    place = volume.lps_from_volume
    told = repr((volume.labels.shape, volume.spacing_mm, place.position.tolist(), place.quaternion.tolist()))
    return hashlib.sha256(f"{anatomy.side} {told} ".encode() + volume.labels.tobytes()).hexdigest()
