"""Devices: what moves the instruments. :func:`open_driver` turns ``--device`` into one."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from trainer.config import ConfigError
from trainer.curriculum import Task
from trainer.drivers.driver import Driver
from trainer.poses import ToolPoses
from trainer.profile import Hand, Profile, ProfileFile, RecordingSpec, load_profile, parse_profile

__all__ = ["Driver", "is_logged", "is_recording", "open_driver", "open_profile", "recording_path", "scripted_hands"]


#: How the names of recordings end.
RECORDINGS = (".mha", ".nrrd", ".txt", ".csv", ".xml")
#: Shipped profiles of recordings; a file is played by the first one whose sensors it has, in whatever format it is.
PLAYERS = ("plus-sequence", "jigsaws")
#: The shipped profile whose sensors are called as the instruments are, as in what we export; it takes those it finds.
PLAYER_OF_TOOLS = "pose-table"


def is_logged(reference: str) -> bool:
    """Whether ``reference`` is ``PATH.db#SESSION``, a session of our own log."""
    db, separator, session = reference.rpartition("#")
    return bool(separator and session) and db.endswith(".db")


def is_recording(reference: str) -> bool:
    """Whether ``reference`` names a recording (``*.mha``, ``*.csv`` …, ``PATH.db#SESSION``) and not a profile."""
    return Path(reference).suffix.lower() in RECORDINGS or is_logged(reference)


def open_profile(reference: str) -> ProfileFile:
    """The profile of a device: its name, its TOML, or a recording's path. Raises ConfigError.

    A recording is played by a shipped profile with its path filled in; the text is that of the filled-in profile.
    """
    if not is_recording(reference):
        if Path(reference).is_file() and Path(reference).suffix != ".toml":
            known = ", ".join(RECORDINGS)
            raise ConfigError(f"{reference}: neither a profile (.toml) nor a recording by its name ({known})")
        return load_profile(reference)
    template = load_profile("logged-session").text if is_logged(reference) else _player(reference)
    text = template.replace('path = ""', f"path = {json.dumps(reference, ensure_ascii=False)}", 1)
    return ProfileFile(path=reference, text=text, profile=parse_profile(text, reference))


def _player(path: str) -> str:
    """The text of the shipped profile that plays a recording, by the names of its sensors. Raises ConfigError."""
    from trainer.drivers.motion_file import read

    sensors = read(path).sensors
    for name in PLAYERS:
        player = load_profile(name)
        if player.profile.recording is not None and _names(player.profile.recording) <= set(sensors):
            return player.text
    player = load_profile(PLAYER_OF_TOOLS)
    assert player.profile.recording is not None
    wanted = _names(player.profile.recording)
    if not wanted & set(sensors):
        raise ConfigError(
            f"{path}: which of its sensors ({', '.join(sensors)}) moves what? Write a profile that says so "
            "(devices/README.md)"
        )
    text = player.text
    for missing in wanted.difference(sensors):
        text = re.sub(rf'(?m)^\[\[recording\.sensor\]\]\nname = "{missing}"\n(?:(?!\[).*\n)*', "", text)
    return text


def _names(spec: RecordingSpec) -> set[str]:
    return {sensor.name for sensor in spec.sensor}


def recording_path(file: ProfileFile) -> str:
    """Where the recording of a profile lies; a relative path in a TOML is relative to it. Raises ConfigError."""
    profile = file.profile
    if profile.recording is None or not profile.recording.path:
        raise ConfigError(f"device '{profile.name}' plays a recording: give its path to --device, or 'recording.path'")
    return str(_beside(file) / profile.recording.path)


def _beside(file: ProfileFile) -> Path:
    """The folder that a profile's relative paths begin at."""
    return Path(file.path).parent if file.path.endswith(".toml") else Path()


def open_driver(reference: str, task: Task, home: ToolPoses, seed: int) -> tuple[ProfileFile, Driver]:
    """The device ``reference``, ready for a session of ``task``, whose instruments wait at ``home``.

    Raises ConfigError for a profile or recording that cannot be used, DeviceError for a device that does not answer.
    """
    file = open_profile(reference)
    return file, _driver(file, file.profile, task, home, seed)


def scripted_hands(hand: Hand, task: Task, home: ToolPoses, seed: int) -> Driver:
    """The scripted hands that know what a task asks for: sewing, or handling a region of the anatomy."""
    if task.scene.anatomy is not None:
        from trainer.drivers.arthroscopic import ArthroscopicHands

        return ArthroscopicHands(hand, task, home, seed)
    from trainer.drivers.scripted import ScriptedHands

    return ScriptedHands(hand, task, home, seed)


def _driver(file: ProfileFile, profile: Profile, task: Task, home: ToolPoses, seed: int) -> Driver:
    if profile.hand is not None and profile.driver == "scripted":
        return scripted_hands(profile.hand, task, home, seed)
    tools = [instrument.tool for instrument in task.scene.instrument]
    if profile.minibird is not None and profile.driver == "minibird":
        from trainer.drivers.minibird import Minibird

        return Minibird(profile.minibird, profile.closure, tools, task.tick_hz, home)
    if profile.driver in ("openigtlink", "ndi", "spacemouse"):
        return _live(file, tools, task.tick_hz, home)
    path = recording_path(file)
    if is_logged(path):
        from trainer.drivers.logged import LoggedSession

        db, _, session = path.rpartition("#")
        return LoggedSession(Path(db), session, tools, task.tick_hz)
    from trainer.drivers.recording import Recording

    assert profile.recording is not None
    return Recording(Path(path), profile.recording, tools, task.tick_hz, home)


def _live(file: ProfileFile, tools: Sequence[str], tick_hz: float, home: ToolPoses) -> Driver:
    """A device that tells finished poses."""
    from trainer.drivers.connected import Connected
    from trainer.drivers.live import LivePoses

    profile = file.profile
    session = (profile.closure, tools, tick_hz, home)
    if profile.openigtlink is not None and profile.driver == "openigtlink":
        from trainer.drivers.igtlink import Server

        server = profile.openigtlink
        return LivePoses(partial(Connected, "openigtlink", partial(Server, server)), server, server.device, *session)
    if profile.ndi is not None and profile.driver == "ndi":
        from trainer.drivers.ndi import Tracker

        tracker = profile.ndi
        connect = partial(Tracker, tracker, _beside(file))
        return LivePoses(partial(Connected, "ndi", connect), tracker, tracker.sensor, *session)
    from trainer.drivers.spacemouse import open_spacemouse

    assert profile.spacemouse is not None
    return open_spacemouse(profile.spacemouse, *session)
