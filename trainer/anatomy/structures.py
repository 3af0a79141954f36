"""The structures of a knee, as ``data/structures.toml`` lists them: their numbers in volumes, kinds and colours."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from trainer import config
from trainer.config import Bounds, ConfigError

#: Structures, label maps, footprints and built-in knees.
DATA = Path(__file__).parent / "data"


@dataclass(frozen=True)
class Structure:
    """One structure; ``number`` is its label in a volume of ours."""

    number: int = field(metadata={"bounds": Bounds(1, 255)})
    kind: Literal["bone", "cartilage", "meniscus", "ligament"]
    opacity_per_mm: float = field(metadata={"bounds": Bounds(0.0, 100.0)})
    colour: tuple[int, int, int] = field(metadata={"bounds": Bounds(0, 255)})


@cache
def structures() -> dict[str, Structure]:
    """All structures by name, in the order of their numbers. Raises ConfigError."""
    path = DATA / "structures.toml"
    table = config.read_toml(path)
    found = {name: config.build(Structure, entry, str(path), name) for name, entry in table.items()}
    numbers = [s.number for s in found.values()]
    for number in numbers:
        if numbers.count(number) > 1:
            raise ConfigError(f"{path}: number {number} is given to more than one structure")
    return dict(sorted(found.items(), key=lambda item: item[1].number))


def shown() -> dict[int, tuple[tuple[int, int, int], float]]:
    """Colour and opacity per mm of each structure by its number, as pictures take them."""
    return {s.number: (s.colour, s.opacity_per_mm) for s in structures().values()}


def number_of(name: str) -> int:
    """The label of a structure in a volume of ours. Raises KeyError."""
    return structures()[name].number
