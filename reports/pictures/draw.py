"""Draws the README's pictures: stitch.png from a recording, report.png from a report's HTML.

    python reports/pictures/draw.py SESSION.rrd REPORT.html [--out FOLDER] [--at SECONDS]

Needs, beside the package's own dependencies: a Vulkan driver (Mesa's lavapipe will do, Debian's
mesa-vulkan-drivers) for the recording, and Chromium for the report. The viewer listens on the loopback only.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rerun as rr
import rerun_cli

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
WINDOW = (1600, 900)
START_S = 30.0  # patience with a viewer on a software rasteriser
SETTLE_S = 8.0  # its start-up notice has faded, and a frame at the asked time is on screen


def draw_stitch(recording: Path, picture: Path, at_s: float) -> None:
    """The viewer's window with ``recording`` opened by its own blueprint, at ``at_s`` of the session."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as home:
        command = [
            str(Path(rerun_cli.__file__).with_name("rerun")),
            *("--headless", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"),
            *("--window-size", f"{WINDOW[0]}x{WINDOW[1]}"),
        ]
        # A home of its own: the person's viewer settings shall not show, and no usage data is collected.
        environment = os.environ | {"HOME": home, "XDG_RUNTIME_DIR": home, "RERUN_APP_ONLY": "true"}
        with (Path(home) / "viewer.log").open("w+") as log:
            viewer = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            try:
                client = _connect(viewer, port)
                client.open(str(recording.resolve()))
                # The title bar would show what this machine lacks, not what the recording holds.
                title_bar = {"/top_panel": {"PanelBlueprint": {"state": "Hidden"}}}
                shown = client.get_blueprint(of="recording").blueprint
                client.set_blueprint(shown | title_bar, of="recording")
                client.set_time("sim_time", duration=at_s, play_state="paused")
                settled = time.monotonic() + SETTLE_S
                while time.monotonic() < settled:
                    client.take_screenshot()  # the clock of the notice runs only while the window is drawn
                    time.sleep(0.5)
                picture.write_bytes(client.take_screenshot())
            except Exception as error:
                log.seek(0)
                sys.exit(f"{recording}: the viewer drew nothing: {error}\n{log.read()[-2000:]}")
            finally:
                viewer.kill()
                viewer.wait()


def _connect(viewer: subprocess.Popen[bytes], port: int) -> rr.experimental.ViewerClient:
    deadline = time.monotonic() + START_S
    while True:
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=1.0):
                return rr.experimental.ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy")
        except OSError:
            if viewer.poll() is not None:
                raise RuntimeError("it ended at once; is a Vulkan driver installed?") from None
            if time.monotonic() > deadline:
                raise RuntimeError(f"it did not start within {START_S:g} s") from None
            time.sleep(0.1)


def draw_report(report: Path, picture: Path) -> None:
    """The top of ``report`` as a browser shows it."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"{picture}: no browser found to draw it; install one of {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory() as profile:
        command = [
            *(browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *(f"--user-data-dir={profile}", "--window-size=1100,1400", f"--screenshot={picture.resolve()}"),
            report.resolve().as_uri(),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode != 0 or not picture.exists():
        sys.exit(f"{report}: {browser} drew nothing: {done.stderr.strip()[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the README's pictures.")
    parser.add_argument("recording", type=Path, help="a session's .rrd")
    parser.add_argument("report", type=Path, help="a session's report as HTML")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder of the pictures")
    parser.add_argument("--at", type=float, default=1.0, help="time of the session to show, s")
    arguments = parser.parse_args()
    for given in (arguments.recording, arguments.report):
        if not given.is_file():
            sys.exit(f"{given}: no such file")
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw_stitch(arguments.recording, arguments.out / "stitch.png", arguments.at)
    draw_report(arguments.report, arguments.out / "report.png")


if __name__ == "__main__":
    main()
