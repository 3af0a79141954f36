"""Poses from an NDI Polaris, Vega or Aurora, through scikit-surgerynditracker."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.connected import flawed
from trainer.drivers.live import Reading
from trainer.drivers.makers import failures, library
from trainer.drivers.plausible import FARTHEST_MM, LENGTH_TOLERANCE
from trainer.drivers.serial_port import DeviceError
from trainer.profile import NdiSpec

#: The tracker repeats a frame until it has the next; it is asked again after this long, s.
AGAIN_S = 0.005
#: A tracker without a new frame for this long is gone: forty frames of a slow one of 20 Hz, assumed.
SILENT_S = 2.0

UNSEEN = "the tracker does not see it"


class Tracker:
    """The tracker of a profile, tracking."""

    def __init__(self, spec: NdiSpec, beside: Path) -> None:
        """ROM files lie in ``beside``. Raises ConfigError, DeviceError."""
        self._where = spec.host or spec.port
        self._names = [sensor.name for sensor in spec.sensor]
        roms = [beside / rom for rom in spec.rom]
        for rom in roms:
            if not rom.is_file():
                raise ConfigError(f"{rom}: no such ROM file; give 'ndi.rom' the tools' descriptions from their maker")
        module = library("sksurgerynditracker.nditracker", "scikit-surgerynditracker")
        settings: dict[str, object] = {"tracker type": spec.tracker, "use quaternions": True}
        if roms:
            settings["romfiles"] = [str(rom) for rom in roms]
        if spec.tracker == "vega":
            settings |= {"ip address": spec.host, "port": spec.tcp_port}
        else:
            settings["serial port"] = spec.port
        self._frames = [-1.0] * len(self._names)
        with failures(self._where):
            self._tracker: Any = module.NDITracker(settings)
        try:
            with failures(self._where):
                there = len(self._tracker.get_tool_descriptions()[0])
                if there < len(self._names):
                    raise DeviceError(
                        f"{self._where}: the tracker has {there} sensors, the profile names {len(self._names)}"
                    )
                self._tracker.start_tracking()
        except DeviceError:
            self.close()
            raise
        self._heard_s = time.monotonic()

    def read(self) -> list[Reading]:
        found = []
        with failures(self._where):
            _, _, frames, poses, _ = self._tracker.get_frame()
            now = time.monotonic()
            for k, name in enumerate(self._names):
                if frames[k] != self._frames[k]:
                    self._frames[k] = float(frames[k])
                    found.append(_reading(name, now, np.asarray(poses[k], dtype=np.float64).ravel()))
        if found:
            self._heard_s = now
        elif now - self._heard_s > SILENT_S:
            raise DeviceError(f"{self._where}: the tracker has stopped; check its cable and its power")
        else:
            time.sleep(AGAIN_S)
        return found

    def close(self) -> None:
        try:
            self._tracker.close()
        except Exception:  # a tracker that is gone cannot be told so
            return


def _reading(name: str, now_s: float, pose: np.ndarray) -> Reading:
    """``pose`` is qw qx qy qz, x y z in mm, NaN where the tracker does not see the sensor."""
    q, position = pose[:4], pose[4:7]
    if not np.isfinite(pose).all():
        return flawed(name, now_s, UNSEEN)
    if abs(q @ q - 1.0) > LENGTH_TOLERANCE or np.abs(position).max() > FARTHEST_MM:
        return flawed(name, now_s, "what comes is no pose")
    return Reading(name, now_s, position, q / np.linalg.norm(q))
