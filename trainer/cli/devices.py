"""``trainer devices``: what can move the instruments, and whether a profile or a recording is in order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="What moves the instruments.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """List the shipped device profiles, and the serial ports of this machine with the profile that fits each."""
    from dataclasses import asdict

    from trainer import profile, serial_ports

    found = [profile.load_profile(name).profile for name in profile.profile_names()]
    rows = [{"name": p.name, "driver": p.driver, "summary": p.summary} for p in found]
    here = serial_ports.found()
    if as_json:
        print(json.dumps({"profiles": rows, "ports": [asdict(port) for port in here]}, indent=2))
        return
    for row in rows:
        print(f"{row['name']:<18} {row['driver']:<10} {row['summary']}")
    print()
    for port in here:
        print(f"{port.port:<18} {port.fits:<35} {port.what}")
    if not here:
        print("no serial port; plug a device in, or give its profile an address such as socket://host:port")


@app.command()
def check(
    path: Annotated[str, typer.Argument(metavar="PATH", help="A profile's .toml file, its name, or a recording.")],
    as_json: JsonOption = False,
) -> None:
    """Check a device profile or a recording, and say what a recording holds; exit code 1 when something is wrong."""
    from trainer.config import ConfigError

    problems: list[str] = []
    recording: dict[str, Any] | None = None
    try:
        recording = _check(path)
    except ConfigError as error:
        problems.append(str(error))
    if as_json:
        print(json.dumps({"path": path, "problems": problems, "recording": recording}, indent=2))
    elif problems:
        for problem in problems:
            typer.echo(problem, err=True)
    else:
        print(f"{path}: in order")
        if recording is not None:
            _print_recording(recording)
    if problems:
        raise typer.Exit(1)


@app.command()
def simulate(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="A device's name or .toml file.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the ports and a profile that names them appear.")],
    motion: Annotated[
        str, typer.Option(metavar="FILE", help="A tracker's recording (.mha) or PATH.db#SESSION; by default rest.")
    ] = "",
    fault: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="What goes wrong; repeat. See devices/README.md.")
    ] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=100.0, help="Times faster than real time.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the faults' chance.")] = 0,
) -> None:
    """Play a profile's devices on pseudo-terminals until Ctrl-C; what to give to --device is printed first."""
    import signal
    from types import FrameType

    from trainer import drivers
    from trainer.config import ConfigError
    from trainer.simulators import faults
    from trainer.simulators.hands import open_hands
    from trainer.simulators.station import Station, with_ports

    file = drivers.open_profile(profile)
    spec, closure = file.profile.minibird, file.profile.closure
    if spec is None:
        raise ConfigError(f"{profile}: only devices of driver 'minibird' can be simulated")
    trackers, closures = faults.parse(fault or [])
    hands = open_hands(motion, spec)
    out = out.absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise ConfigError(f"{out}: there is a file where a folder should be; give --out another name") from None
    ports = [out / "flock"] if spec.port else [out / bird.name for bird in spec.bird]
    ports += [out / "closure"] if closure is not None else []
    written = out / f"{file.profile.name}.toml"
    if written.exists() and file.path.endswith(".toml") and written.samefile(file.path):
        raise ConfigError(f"{written}: is the profile itself; give --out another folder")
    for port in ports:
        if port.exists():
            raise ConfigError(f"{port}: is there already; another simulation plays there, or remove it")
    ended = False

    def end(signum: int, frame: FrameType | None) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    station = Station(spec, closure, hands, ports, speed, trackers, closures, seed)
    written.write_text(with_ports(file.text, ports, hands.in_scene), encoding="utf-8")
    print(written, flush=True)
    print(json.dumps(station.run(lambda: ended)), flush=True)


def _check(reference: str) -> dict[str, Any] | None:
    """What the recording behind ``reference`` holds; None for a profile that names none. Raises ConfigError."""
    from trainer import drivers
    from trainer.config import ConfigError
    from trainer.drivers.motion_file import read
    from trainer.drivers.recording import check_sensors
    from trainer.motion import describe

    if drivers.is_recording(reference) and not drivers.is_logged(reference):
        return {"path": reference, **describe(read(reference))}  # it need not have the sensors of a shipped profile
    file = drivers.open_profile(reference)
    if reference.endswith(".toml") and file.profile.name != Path(reference).stem:
        raise ConfigError(f"{reference}: 'name' must equal the file's name, found '{file.profile.name}'")
    spec = file.profile.recording
    if file.profile.driver != "recording" or spec is None or not spec.path:
        return None
    path = drivers.recording_path(file)
    if drivers.is_logged(path):
        return _logged(path)
    motion = read(path)
    check_sensors(motion, spec)
    return {"path": path, **describe(motion)}


def _logged(reference: str) -> dict[str, Any]:
    from trainer.config import ConfigError
    from trainer.log import reader
    from trainer.log.schema import LogError

    path, _, session = reference.rpartition("#")
    try:
        with reader.open_log(Path(path)) as log:
            record = reader.load(log, session)
    except LogError as error:
        raise ConfigError(str(error)) from None
    return {
        "path": path,
        "session": record.header.id,
        "task": record.header.task,
        "frames": len(record.position),
        "duration_s": record.duration_s,
        "tools": list(record.header.tools),
    }


def _print_recording(recording: dict[str, Any]) -> None:
    print(f"{recording['frames']} frames, {recording['duration_s']:.2f} s")
    if "session" in recording:
        print(f"session {recording['session']} of {recording['task']}: {', '.join(recording['tools'])}")
        return
    print(
        f"interval median {recording['interval_median_ms']:.1f} ms, p99 {recording['interval_p99_ms']:.1f} ms, "
        f"max {recording['interval_max_ms']:.1f} ms"
    )
    print(f"{recording['gaps']} gaps, {recording['missing_frames']} missing frames")
    for name, sensor in recording["sensors"].items():
        print(f"{name}: {sensor['frames_ok']} frames OK, path {sensor['path_length_mm']:.1f} mm")
        if sensor["low_mm"] is not None:
            for axis, low, high in zip("xyz", sensor["low_mm"], sensor["high_mm"], strict=True):
                print(f"  {axis} {low:.2f} to {high:.2f} mm")


@app.command()
def calibrate(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="A profile's .toml file, or its name.")],
    points: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV: readings at known points, or the points to touch now.")
    ] = None,
    sweep: Annotated[
        Path | None, typer.Option(metavar="FILE|live", help="The tool turns on its tip: a recording, or now.")
    ] = None,
    grid: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV: readings all over the field, or the places to take now.")
    ] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help="The sensor, where there are several.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit where the scene is, where the tip is, how the field is bent; keep it in a dated file beside the profile."""
    from trainer.cli.calibrate import calibrate as fit_and_keep

    fit_and_keep(profile, points, sweep, grid, sensor, as_json)


@app.command()
def monitor(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="A profile's name or .toml, or a recording.")],
    seconds: Annotated[float | None, typer.Option(min=0.1, metavar="N", help="Only so long.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Show how the device's records arrive: rate, jitter, loss, poses, closure and the age of the calibration."""
    from trainer.cli.monitor import show

    show(profile, seconds, as_json)
