"""Which label of a file is which structure: a TOML with a table ``[labels]``, number = "structure"."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from trainer import config
from trainer.anatomy.structures import DATA, number_of, structures
from trainer.anatomy.volume_file import LARGEST_LABEL
from trainer.config import ConfigError

#: What a label is mapped to that a knee of ours does not have: muscle, skin, an implant.
IGNORED = "ignored"


@dataclass(frozen=True)
class LabelMap:
    """Structures by the labels of a file."""

    path: str
    labels: dict[int, str]
    side: Literal["left", "right", ""] = ""  # of the knee, where the map is for one knee only; checked, see landmarks

    def structure(self, name: str) -> int | None:
        """The label of a structure; None where the map does not name it."""
        return next((label for label, found in self.labels.items() if found == name), None)

    def missing(self) -> list[str]:
        """Structures of a knee that the map does not name."""
        return [name for name in structures() if name not in self.labels.values()]

    def renumber(self) -> np.ndarray:
        """(65536,) uint8: our number for each label of the file, 0 for what is ignored or not named."""
        table = np.zeros(LARGEST_LABEL + 1, dtype=np.uint8)
        for label, name in self.labels.items():
            table[label] = 0 if name == IGNORED else number_of(name)
        return table


@dataclass(frozen=True)
class _File:
    labels: dict[str, str]
    side: Literal["left", "right", ""] = ""


def read(path: Path) -> LabelMap:
    """The label map in a TOML file, or the shipped one of that name. Raises ConfigError."""
    named = _shipped_folder() / f"{path}.toml"
    if not path.is_file():
        if not named.is_file():
            raise ConfigError(f"{path}: no such file, and no shipped label map ({', '.join(shipped_names())})")
        path = named
    return parse(config.read_toml(path), str(path))


def parse(table: dict[str, Any], name: str) -> LabelMap:
    """The label map in a TOML table; ``name`` is used in errors. Raises ConfigError."""
    file = config.build(_File, table, name)
    labels: dict[int, str] = {}
    for key, structure in file.labels.items():
        if not key.isdecimal() or not 1 <= int(key) <= LARGEST_LABEL:
            raise ConfigError(
                f"{name}: [labels] '{key}' is no label; expected a whole number from 1 to {LARGEST_LABEL}"
            )
        if structure not in structures() and structure != IGNORED:
            near = difflib.get_close_matches(structure, structures(), n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(structures())}"
            raise ConfigError(f"{name}: label {key}: no structure '{structure}', {hint}, or '{IGNORED}'")
        if int(key) in labels:
            raise ConfigError(f"{name}: label {int(key)} is named twice")
        if structure != IGNORED and structure in labels.values():
            raise ConfigError(f"{name}: two labels are the {structure}; a structure has one")
        labels[int(key)] = structure
    if not labels:
        raise ConfigError(f"{name}: [labels] names no label")
    return LabelMap(name, labels, file.side)


def shipped_names() -> list[str]:
    """The label maps that come with the program."""
    return sorted(path.stem for path in _shipped_folder().glob("*.toml"))


def shipped() -> list[LabelMap]:
    """All of them, in the order of their names."""
    return [read(_shipped_folder() / f"{name}.toml") for name in shipped_names()]


def _shipped_folder() -> Path:
    return DATA / "labels"


def check_against(given: LabelMap, present: set[int], file: str) -> None:
    """Raises ConfigError unless the map names exactly the labels that a file has."""
    absent = sorted(set(given.labels) - present)
    if absent:
        raise ConfigError(
            f"{given.path}: {_labels(absent)} not in {file}, which has {_span(sorted(present))}; "
            "is it this file's map? If so, take out what was not segmented"
        )
    unnamed = sorted(present - set(given.labels))
    if unnamed:
        raise ConfigError(f"{given.path}: {_labels(unnamed)} of {file} not named; name it, or give it as '{IGNORED}'")


def _labels(labels: list[int]) -> str:
    return f"label {labels[0]} is" if len(labels) == 1 else f"labels {_span(labels)} are"


def _span(labels: list[int]) -> str:
    return ", ".join(str(label) for label in labels) if labels else "none"
