"""Device profiles: which driver moves the instruments, and how what it sees maps to them.

Beside a profile there may be calibrations (:mod:`trainer.calibration`). Loading the profile appends the text of the
newest, or of the one that ``calibrated_by`` names, and puts its numbers in the place of the profile's own; so the text
that a session stores says all.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

from trainer import calibration, config
from trainer.calibration import Calibration, Distortion
from trainer.config import ANGLE_DEG, POSITION_MM, Bounds, ConfigError
from trainer.data_files import data_folder

Vector = tuple[float, float, float]
TCP_PORT = {"bounds": Bounds(1, 65535)}


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


@dataclass(frozen=True, kw_only=True)
class Mount:
    """How a sensor is fixed to the instrument that it moves."""

    closure: float = field(default=1.0, metadata={"bounds": Bounds(0.0, 1.0)})  # jaws, where nothing measures them
    position_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)  # sensor_from_tool
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # about x, then y, then z


@dataclass(frozen=True, kw_only=True)
class Registration:
    """How a device's poses enter the scene.

    world = anchor · scene_from_device · (scale · position, rotation) · sensor_from_tool.
    """

    scale: float = field(default=1.0, metadata={"bounds": Bounds(1e-6, 1e6)})  # of positions
    position_mm: Vector = field(default=(0.0, 0.0, 0.0), metadata=POSITION_MM)  # scene_from_device
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # about x, then y, then z
    anchor: Literal["home", "none"] = "none"  # home: the first sample of a tool is where the task has it wait
    distortion: Distortion | None = None  # of the tracker's field; usually from a calibration


M = TypeVar("M", bound=Mount)
P = TypeVar("P", bound=Registration)


@dataclass(frozen=True)
class Sensor(Mount):
    """One tracked sensor of a recording and the instrument it moves."""

    name: str
    tool: Literal["left", "right"]
    jaw_open_deg: float | None = field(default=None, metadata=ANGLE_DEG)  # where an angle of the jaws is recorded:
    jaw_closed_deg: float | None = field(default=None, metadata=ANGLE_DEG)  # at which they are open, and closed

    def __post_init__(self) -> None:
        if (self.jaw_open_deg is None) != (self.jaw_closed_deg is None):
            raise ValueError("'jaw_open_deg' and 'jaw_closed_deg' go together")
        if self.jaw_open_deg is not None and self.jaw_open_deg == self.jaw_closed_deg:
            raise ValueError("'jaw_open_deg' and 'jaw_closed_deg' must differ")


@dataclass(frozen=True)
class RecordingSpec(Registration):
    """How a recorded motion enters the scene."""

    path: str = ""  # usually given by --device PATH
    sensor: tuple[Sensor, ...] = ()


@dataclass(frozen=True)
class Bird(Mount):
    """One unit of the flock and the instrument that its sensor is fixed to."""

    address: int = field(metadata={"bounds": Bounds(1, 14)})  # as its switches say
    tool: Literal["left", "right"]
    port: str = ""  # its own; empty: it reports through the flock's port

    @property
    def name(self) -> str:
        return f"bird{self.address}"


@dataclass(frozen=True)
class MinibirdSpec(Registration):
    """A flock of miniBIRDs."""

    bird: tuple[Bird, ...]
    port: str = ""  # of the flock, in group mode: /dev/ttyUSB0, or any address that pyserial knows
    baud: int = field(default=115200, metadata={"bounds": Bounds(2400, 4_000_000)})
    rate_hz: float = field(default=103.0, metadata={"bounds": Bounds(20.0, 144.0)})  # of measurement
    hemisphere: Literal["forward", "aft", "lower", "upper", "right", "left"] = "forward"
    quaternion: Literal["measured", "direct", "inverse"] = "measured"  # whose rotation is sent: compared with angles
    reset: bool = False  # by RTS at the start; needs a cable that has it

    def __post_init__(self) -> None:
        if not self.bird:
            raise ValueError("a flock needs a table [[minibird.bird]]")
        for what in ("address", "tool"):
            found = [getattr(bird, what) for bird in self.bird]
            if len(set(found)) < len(found):
                raise ValueError(f"two birds have the same {what}")
        own = [bird.port for bird in self.bird]
        if any(own) and not all(own):
            raise ValueError("either each bird has a port of its own, or none has one")
        if all(own) and len(set(own)) < len(own):
            raise ValueError("two birds have the same port; in group mode give it to [minibird] instead")
        if any(own) == bool(self.port):
            raise ValueError("give 'port' for the flock in group mode, or a port to each bird")


@dataclass(frozen=True)
class Jaw:
    """Two-point calibration of one forceps' closure sensor: its raw counts when open and when closed."""

    tool: Literal["left", "right"]
    open: float = field(metadata={"bounds": Bounds(0.0, 65535.0)})
    closed: float = field(metadata={"bounds": Bounds(0.0, 65535.0)})

    def __post_init__(self) -> None:
        if abs(self.closed - self.open) < 10.0:
            raise ValueError("'open' and 'closed' must be at least 10 counts apart")


@dataclass(frozen=True)
class ClosureSpec:
    """The board that measures how far the forceps are closed; devices/closure-sensor/ has its firmware."""

    port: str
    jaw: tuple[Jaw, ...]
    baud: int = field(default=115200, metadata={"bounds": Bounds(2400, 4_000_000)})

    def __post_init__(self) -> None:
        if not self.port.strip():
            raise ValueError("'port' is empty; give the board's")
        if not self.jaw or len({jaw.tool for jaw in self.jaw}) < len(self.jaw):
            raise ValueError("a board needs one table [[closure.jaw]] for each tool that it measures")


@dataclass(frozen=True)
class Tracked(Mount):
    """A sensor that its device knows by name, and the instrument that it moves."""

    name: str
    tool: Literal["left", "right"]


@dataclass(frozen=True)
class OpenigtlinkSpec(Registration):
    """A server of OpenIGTLink (PLUS, 3D Slicer …) whose TRANSFORM messages move the instruments."""

    device: tuple[Tracked, ...]  # by the device names in the messages
    host: str = "127.0.0.1"
    port: int = field(default=18944, metadata=TCP_PORT)

    def __post_init__(self) -> None:
        _check_tracked(self.device, "openigtlink.device")


@dataclass(frozen=True)
class NdiSpec(Registration):
    """An NDI Polaris, Vega or Aurora."""

    tracker: Literal["polaris", "vega", "aurora"]
    sensor: tuple[Tracked, ...]  # an Aurora's in the order of its ports, the others' in that of their ROM files
    port: str = ""  # serial, of a Polaris or an Aurora
    host: str = ""  # of a Vega
    tcp_port: int = field(default=8765, metadata=TCP_PORT)
    rom: tuple[str, ...] = ()  # descriptions of the tools, beside the profile

    def __post_init__(self) -> None:
        _check_tracked(self.sensor, "ndi.sensor")
        if bool(self.host) != (self.tracker == "vega") or bool(self.port) == (self.tracker == "vega"):
            raise ValueError("a vega needs its 'host', a polaris or an aurora its serial 'port', and neither both")
        if len(self.rom) != (0 if self.tracker == "aurora" else len(self.sensor)):
            raise ValueError("'rom' names a file for each sensor of a polaris or vega, and none of an aurora's")


@dataclass(frozen=True)
class SpacemouseSpec:
    """A SpaceMouse: the further its cap is pushed, the faster the instrument moves."""

    tool: Literal["left", "right"]
    device: str = ""  # as its library calls it; empty: the first that is found
    rotation_deg: Vector = field(default=(0.0, 0.0, 0.0), metadata=ANGLE_DEG)  # scene_from_device; about x, then y, z
    speed_mm_s: float = field(default=20.0, metadata={"bounds": Bounds(0.01, 1000.0)})  # at full push
    turn_deg_s: float = field(default=60.0, metadata={"bounds": Bounds(0.1, 720.0)})  # at full twist
    dead: float = field(default=0.05, metadata={"bounds": Bounds(0.0, 0.5)})  # of a full push, that counts as none
    reach_mm: float = field(default=50.0, metadata={"bounds": Bounds(0.1, 1000.0)})  # from where the tool waits
    closure: float = field(default=0.0, metadata={"bounds": Bounds(0.0, 1.0)})  # at the start
    close_button: int = field(default=0, metadata={"bounds": Bounds(0, 63)})
    open_button: int = field(default=1, metadata={"bounds": Bounds(0, 63)})
    jaw_s: float = field(default=0.5, metadata={"bounds": Bounds(0.01, 10.0)})  # from open to closed, button held

    def __post_init__(self) -> None:
        if self.close_button == self.open_button:
            raise ValueError("'close_button' and 'open_button' must differ")


def _check_tracked(found: tuple[Tracked, ...], table: str) -> None:
    """Raises ValueError where a tracker's sensors are none, or two of one name or for one tool."""
    if not found:
        raise ValueError(f"a tracker needs a table [[{table}]]")
    for what in ("name", "tool"):
        if len({getattr(tracked, what) for tracked in found}) < len(found):
            raise ValueError(f"two tables [[{table}]] have the same {what}")


@dataclass(frozen=True)
class PublishSpec:
    """Where the instruments' poses are told to others while they move, as TRANSFORM messages of OpenIGTLink."""

    host: str = "127.0.0.1"  # this machine alone; "0.0.0.0": whoever reaches it
    port: int = field(default=18944, metadata=TCP_PORT)


@dataclass(frozen=True)
class Profile:
    """A device, as its TOML file states it."""

    name: str
    driver: Literal["scripted", "recording", "minibird", "openigtlink", "ndi", "spacemouse"]
    summary: str
    hand: Hand | None = None
    recording: RecordingSpec | None = None
    calibrated_by: str = "newest"  # of the calibrations beside the file; or the name of one of them, or "none"
    calibration: Calibration | None = None  # whose numbers are in effect
    minibird: MinibirdSpec | None = None
    openigtlink: OpenigtlinkSpec | None = None
    ndi: NdiSpec | None = None
    spacemouse: SpacemouseSpec | None = None
    closure: ClosureSpec | None = None
    publish: PublishSpec | None = None

    def __post_init__(self) -> None:
        wanted = "hand" if self.driver == "scripted" else self.driver
        if getattr(self, wanted) is None:
            raise ValueError(f"driver '{self.driver}' needs a table [{wanted}]")
        trackers = [self.ndi.port] if self.ndi is not None else []
        if self.minibird is not None:
            trackers += [self.minibird.port, *(bird.port for bird in self.minibird.bird)]
        if self.closure is not None and self.closure.port in trackers:
            raise ValueError(f"tracker and closure sensor have the same port '{self.closure.port}'")


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
    """The profile in a TOML text, with its calibration in effect. Raises ConfigError."""
    return _calibrated(config.build(Profile, config.parse_toml(text, name), name), name)


def _calibrated(profile: Profile, name: str) -> Profile:
    """The profile with what was measured in the place of what it states itself."""
    measured = profile.calibration
    if measured is None:
        return profile
    if profile.minibird is not None:
        birds = profile.minibird.bird
        birds = _calibrated_tips(birds, [bird.name for bird in birds], measured, name)
        return replace(profile, minibird=replace(_calibrated_place(profile.minibird, measured), bird=birds))
    if profile.openigtlink is not None:
        devices = profile.openigtlink.device
        devices = _calibrated_tips(devices, [d.name for d in devices], measured, name)
        return replace(profile, openigtlink=replace(_calibrated_place(profile.openigtlink, measured), device=devices))
    if profile.ndi is not None:
        tracked = _calibrated_tips(profile.ndi.sensor, [s.name for s in profile.ndi.sensor], measured, name)
        return replace(profile, ndi=replace(_calibrated_place(profile.ndi, measured), sensor=tracked))
    if profile.recording is not None:
        sensors = _calibrated_tips(profile.recording.sensor, [s.name for s in profile.recording.sensor], measured, name)
        return replace(profile, recording=replace(_calibrated_place(profile.recording, measured), sensor=sensors))
    return profile


def _calibrated_tips(mounts: tuple[M, ...], names: list[str], measured: Calibration, file: str) -> tuple[M, ...]:
    """Sensors, called ``names``, with the places of their tips as they were measured. Raises ConfigError."""
    tips = {tip.sensor: tip.position_mm for tip in measured.tip}
    if unknown := set(tips).difference(names):
        raise ConfigError(f"{file}: the calibration is of a sensor '{min(unknown)}', which the profile does not have")
    return tuple(
        replace(mount, position_mm=tips.get(name, mount.position_mm)) for name, mount in zip(names, mounts, strict=True)
    )


def _calibrated_place(spec: P, measured: Calibration) -> P:
    """Where the device is, and how its field is bent, as it was measured."""
    spec = replace(spec, distortion=measured.distortion or spec.distortion)
    if measured.scene is None:
        return spec
    return replace(spec, position_mm=measured.scene.position_mm, rotation_deg=measured.scene.rotation_deg)


def profile_names() -> list[str]:
    """Names of the shipped profiles, sorted; a name with a dot in it is that of a calibration."""
    return sorted(p.stem for p in data_folder("devices").glob("*.toml") if "." not in p.stem)


def profile_path(reference: str) -> Path:
    """The file of a shipped profile's name, or of the path of a profile's TOML. Raises ConfigError."""
    if reference.endswith(".toml"):
        return Path(reference)
    if reference in profile_names():
        return data_folder("devices") / f"{reference}.toml"
    raise ConfigError(f"unknown device profile '{reference}'; known: {', '.join(profile_names())}")


def load_profile(reference: str) -> ProfileFile:
    """A shipped profile's name or the path of a profile's TOML, with its calibration. Raises ConfigError."""
    path = profile_path(reference)
    text = config.read_text(path)
    profile = parse_profile(text, str(path))
    chosen = _calibration_of(profile, path)
    if chosen is not None and profile.calibration is None:
        addition = config.read_text(chosen)
        table = config.parse_toml(addition, str(chosen)).get("calibration")
        config.build(Calibration, table, str(chosen), "calibration")  # so that a fault is told of this file
        text = f"{text.rstrip()}\n\n# {chosen.name}\n{addition}"
        profile = parse_profile(text, str(path))
    return ProfileFile(path=reference, text=text, profile=profile)


def _calibration_of(profile: Profile, path: Path) -> Path | None:
    """The file of the calibration that a profile goes by; None where there is none."""
    if profile.calibrated_by == "none":
        return None
    found = calibration.beside(path)
    if profile.calibrated_by == "newest":
        return found[-1] if found else None
    named = path.with_name(profile.calibrated_by)
    if named not in found:
        known = ", ".join(p.name for p in found) or "there is none"
        raise ConfigError(f"{path}: no calibration '{profile.calibrated_by}' beside it; known: {known}")
    return named
