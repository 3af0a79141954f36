"""Device profiles: which driver moves the instruments, and how what it sees maps to them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from trainer import config
from trainer.config import ANGLE_DEG, POSITION_MM, Bounds, ConfigError
from trainer.data_files import data_folder

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Hand:
    """How a scripted hand performs. ``None`` for the first three: aim where the task's steps say, at 90°."""

    entry_angle_deg: float | None = field(default=None, metadata={"bounds": Bounds(5.0, 90.0)})
    bite_mm: float | None = field(default=None, metadata={"bounds": Bounds(0.0, 100.0, low_open=True)})
    clock_deg: float | None = field(default=None, metadata=ANGLE_DEG)
    entry_angle_error_deg: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 90.0)})  # sd of the aimed angle
    aim_error_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 5.0)})  # sd of the aimed point, each way
    tremor_rms_um: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 5000.0)})  # of the tip, all axes together
    tremor_hz: float = field(default=8.0, metadata={"bounds": Bounds(1.0, 20.0)})
    speed_mm_s: float = field(default=4.0, metadata={"bounds": Bounds(0.01, 1000.0)})
    hesitation_s: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 60.0)})  # mean pause before each movement
    wander_mm: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 50.0)})  # sd of detours on the way
    seed: int = field(default=0, metadata={"bounds": Bounds(0, 2**63 - 1)})
    source: str = ""  # where the numbers come from


@dataclass(frozen=True)
class Sensor:
    """One tracked sensor of a recording and the instrument it moves."""

    name: str
    tool: Literal["left", "right"]
    closure: float = field(default=1.0, metadata={"bounds": Bounds(0.0, 1.0)})  # jaws, where none are recorded
    jaw_open_deg: float | None = field(default=None, metadata=ANGLE_DEG)  # where an angle of the jaws is recorded:
    jaw_closed_deg: float | None = field(default=None, metadata=ANGLE_DEG)  # at which they are open, and closed
    position_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)  # sensor_from_tool
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # about x, then y, then z

    def __post_init__(self) -> None:
        if (self.jaw_open_deg is None) != (self.jaw_closed_deg is None):
            raise ValueError("'jaw_open_deg' and 'jaw_closed_deg' go together")
        if self.jaw_open_deg is not None and self.jaw_open_deg == self.jaw_closed_deg:
            raise ValueError("'jaw_open_deg' and 'jaw_closed_deg' must differ")


@dataclass(frozen=True)
class RecordingSpec:
    """How a recorded motion enters the scene: world = anchor · scale · (position, rotation) · device."""

    path: str = ""  # usually given by --device PATH
    sensor: tuple[Sensor, ...] = ()
    scale: float = field(default=1.0, metadata={"bounds": Bounds(1e-6, 1e6)})  # of positions
    position_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # about x, then y, then z
    anchor: Literal["home", "none"] = "none"  # home: the first sample of a tool is where the task has it wait


@dataclass(frozen=True)
class Profile:
    """A device, as its TOML file states it."""

    name: str
    driver: Literal["scripted", "recording"]
    summary: str
    hand: Hand | None = None
    recording: RecordingSpec | None = None

    def __post_init__(self) -> None:
        wanted = {"scripted": "hand", "recording": "recording"}[self.driver]
        if getattr(self, wanted) is None:
            raise ValueError(f"driver '{self.driver}' needs a table [{wanted}]")


@dataclass(frozen=True)
class ProfileFile:
    """A profile together with the text it came from; the log stores both."""

    path: str  # as given to --device
    text: str
    profile: Profile

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.text.encode()).hexdigest()


def parse_profile(text: str, name: str) -> Profile:
    """The profile in a TOML text. Raises ConfigError."""
    return config.build(Profile, config.parse_toml(text, name), name)


def profile_names() -> list[str]:
    """Names of the shipped profiles, sorted."""
    return sorted(p.stem for p in data_folder("devices").glob("*.toml"))


def load_profile(reference: str) -> ProfileFile:
    """A shipped profile's name or the path of a profile's TOML. Raises ConfigError."""
    if reference.endswith(".toml"):
        path = Path(reference)
    elif reference in profile_names():
        path = data_folder("devices") / f"{reference}.toml"
    else:
        raise ConfigError(f"unknown device profile '{reference}'; known: {', '.join(profile_names())}")
    text = config.read_text(path)
    return ProfileFile(path=reference, text=text, profile=parse_profile(text, str(path)))
