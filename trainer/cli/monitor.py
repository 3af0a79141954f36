"""What ``trainer devices monitor`` shows: a table that is drawn anew while records arrive, or one JSON document."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

    from trainer.drivers.watch import Watch
    from trainer.motion import Motion
    from trainer.profile import Profile, RecordingSpec

REDRAWN_EVERY_S = 0.25
WINDOW_S = 2.0  # what the live table is about: the last seconds


def show(reference: str, seconds: float | None, as_json: bool) -> None:
    """Show how records arrive: of a live device until ``seconds`` are over or Ctrl-C, of a recording at its own pace.

    ``--json`` waits for a live device only. Raises ConfigError for a device that neither has records nor plays a
    recording, DeviceError for one that does not answer, or of which nothing comes, when that is shown.
    """
    from trainer import drivers
    from trainer.config import ConfigError
    from trainer.drivers.motion_file import read
    from trainer.drivers.recording import check_sensors

    file = drivers.open_profile(reference)
    profile, spec = file.profile, file.profile.recording
    if profile.driver == "minibird":
        _watch(profile, seconds, as_json)
        return
    if profile.driver in ("openigtlink", "ndi", "spacemouse"):
        raise ConfigError(f"device '{profile.name}' cannot be monitored: only miniBIRDs and recordings can")
    if spec is None or profile.driver != "recording" or drivers.is_logged(drivers.recording_path(file)):
        raise ConfigError(f"device '{profile.name}' receives no records, so there is nothing to monitor")
    motion = read(drivers.recording_path(file))
    check_sensors(motion, spec)
    end_s = motion.duration_s if seconds is None else min(seconds, motion.duration_s)
    if as_json:
        print(json.dumps(measured(motion, profile, spec, 0.0, end_s), indent=2))
    else:
        _play(motion, profile, spec, end_s)


def measured(motion: Motion, profile: Profile, spec: RecordingSpec, start_s: float, end_s: float) -> dict[str, Any]:
    """What the records between two times, s from the first, say; ready for JSON."""
    import numpy as np

    from trainer.drivers.monitor import arrival, seen
    from trainer.drivers.recording import recorded_closure

    t = motion.time - motion.time[0]
    part = slice(int(np.searchsorted(t, start_s, side="left")), int(np.searchsorted(t, end_s, side="right")))
    sensors = {}
    for sensor in spec.sensor:
        track = motion.track(sensor.name)
        closure = recorded_closure(track, sensor)
        found = seen(track.position[part], track.ok[part], None if closure is None else closure[part])
        sensors[sensor.name] = {"tool": sensor.tool, **asdict(found)}
    return {
        "device": profile.name,
        "calibration": _calibration(profile),
        **asdict(arrival(motion.time[part], motion.frame_number[part])),
        "sensors": sensors,
    }


def _calibration(profile: Profile) -> dict[str, Any] | None:
    used = profile.calibration
    return None if used is None else {"date": used.date, "age_s": used.age_s(datetime.now(UTC))}


def _watch(profile: Profile, seconds: float | None, as_json: bool) -> None:
    """Look at a live device. The last word is about all ``seconds``; without them about the last two."""
    from rich.console import Console
    from rich.live import Live

    from trainer.drivers.minibird_record import DROPPED
    from trainer.drivers.serial_port import DeviceError
    from trainer.drivers.watch import Watch
    from trainer.session import interruptible

    console = Console(stderr=as_json)
    with Watch(profile, WINDOW_S if seconds is None else seconds) as device, interruptible() as interrupted:
        ends = float("inf") if seconds is None else time.monotonic() + seconds
        with Live(console=console, auto_refresh=False, transient=True) as live:
            while not interrupted() and (left := ends - time.monotonic()) > 0.0:
                time.sleep(min(REDRAWN_EVERY_S, left))
                if console.is_terminal:
                    live.update(_table(_seen_live(profile, device)), refresh=True)
        report = _seen_live(profile, device)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        Console().print(_table(report))
    if not set(report["flaws"]) - {DROPPED}:
        raise DeviceError(
            f"device '{profile.name}': no record came; {report['trouble'] or 'the stream does not start'}"
        )


def _seen_live(profile: Profile, device: Watch) -> dict[str, Any]:
    """As :func:`measured`, and what is wrong now and was with records so far."""
    return {
        "device": profile.name,
        "calibration": _calibration(profile),
        **asdict(device.arrival()),
        "sensors": {name: {"tool": tool, **asdict(found)} for name, (tool, found) in device.seen().items()},
        "flaws": device.flaws,
        "trouble": device.trouble,
    }


def _play(motion: Motion, profile: Profile, spec: RecordingSpec, end_s: float) -> None:
    """Draw the table of the last seconds while they pass, and in the end that of all."""
    from rich.console import Console
    from rich.live import Live

    began = time.monotonic()
    with Live(auto_refresh=False, transient=True) as live:
        now = 0.0
        while now < end_s:
            time.sleep(min(REDRAWN_EVERY_S, end_s - now))
            now = min(time.monotonic() - began, end_s)
            live.update(_table(measured(motion, profile, spec, now - WINDOW_S, now)), refresh=True)
    Console().print(_table(measured(motion, profile, spec, 0.0, end_s)))


def _table(report: dict[str, Any]) -> Table:
    from rich.table import Table

    used = report["calibration"]
    calibrated = "not calibrated" if used is None else f"calibrated {used['age_s'] / 3600.0:.1f} h ago"
    pace = f"{_text(report['rate_hz'], 1)} Hz, jitter {_text(report['jitter_ms'], 2)} ms"
    lost = f"lost {report['lost']} ({_text(report['loss_percent'], 1)} %)"
    caption = f"{pace}, longest {_text(report['interval_max_ms'], 1)} ms, {lost}\n{calibrated}"
    if report.get("trouble"):
        caption += f"\n{report['trouble']}"
    table = Table(title=report["device"], caption=caption)
    table.add_column("sensor")
    for column in ("seen %", "x mm", "y mm", "z mm", "closure"):
        table.add_column(column, justify="right")
    for name, sensor in report["sensors"].items():
        place = sensor["position_mm"] or (None, None, None)
        numbers = (_text(v, 2) for v in (*place, sensor["closure"]))
        table.add_row(f"{name} ({sensor['tool']})", f"{sensor['seen_percent']:.1f}", *numbers)
    return table


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
