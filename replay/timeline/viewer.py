"""Rerun's viewer, which rerun-sdk brings along: a picture without a screen, and the desktop window.

It runs as a process group of its own, listens on the loopback interface only, reports no usage and
reaches no network.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import move
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rerun.experimental import ViewerClient

from recorders.errors import BadInput

PACKAGES = "mesa-vulkan-drivers libvulkan1 libegl1 libgl1-mesa-dri libxkbcommon-x11-0"
# `python -m rerun_cli` loses the exit code
RERUN = (sys.executable, "-c", "import sys, rerun_cli.__main__ as cli; sys.exit(cli.main())")
_START_S = 20.0
_LOAD_S = 60.0
_END_S = 5.0
# The viewer's own messages lie on top of the first three or four pictures, however long that takes.
_PICTURES = 7


class Listener(NamedTuple):
    """A running Rerun process and the address that it receives at."""

    url: str
    process: subprocess.Popen[bytes]


def screenshot(
    rrd: Path, png: Path, *, at_s: float | None = None, size: tuple[int, int] = (1600, 1000)
) -> list[str]:
    """Save the viewer's picture of a timeline; needs no screen, only a Vulkan driver.

    Args:
        rrd: the timeline.
        png: the picture to write.
        at_s: where the cursor stands, in seconds since the run's epoch; None is the middle.
        size: width and height in pixels.

    Returns what the views complain of, an empty list where all is well.

    Raises BadInput where a file cannot be found or written, `at_s` is outside the run, or no Vulkan
    driver is installed.
    """
    _require_timeline(rrd)
    if not png.parent.is_dir():
        raise BadInput(f"{png}: its folder does not exist; create it first")
    with TemporaryDirectory(prefix="fuselog-viewer-") as name:
        folder = Path(name)
        window = f"{size[0]}x{size[1]}"
        with listen(folder, "--headless", "--hide-welcome-screen", "--window-size", window) as listener:
            client = ViewerClient.connect(listener.url)
            _load(client, rrd)
            _set_cursor(client, rrd, at_s)
            picture = str(folder / "picture.png")
            for _ in range(_PICTURES):
                client.save_screenshot(picture)
            views = client.get_state().views
        move(picture, png)
    return [f"{view.name}: {report}" for view in views for report in view.reports]


def view(rrd: Path) -> None:
    """Open a timeline in the desktop viewer and wait until it is closed.

    Raises BadInput where there is no such file, no screen, or the viewer cannot run.
    """
    _require_timeline(rrd)
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise BadInput("there is no screen to show a timeline on; use --screenshot FILE.png")
    with TemporaryDirectory(prefix="fuselog-viewer-") as name:
        command = [*RERUN, str(rrd), "--port", str(_free_port()), "--bind", "127.0.0.1"]
        environment = _private_environment(Path(name))
        done = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise _why_ended(done.stderr)


@contextmanager
def listen(folder: Path, *options: str) -> Iterator[Listener]:
    """Run `rerun OPTIONS` as a receiver on the loopback interface, at home in a folder of its own.

    Raises BadInput where it does not come up, or ends while it is still needed.
    """
    port = _free_port()
    log = folder / "rerun.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*RERUN, *options, "--port", str(port), "--bind", "127.0.0.1"],
            env=_private_environment(folder) | {"HOME": str(folder)},
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        _await_port(process, port)
        yield Listener(f"rerun+http://127.0.0.1:{port}/proxy", process)
    except BadInput:
        raise
    except Exception as error:
        if _ended(process):
            raise _why_ended(log.read_text()) from error
        raise
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _private_environment(folder: Path) -> dict[str, str]:
    """Folders of its own, usage reports off; the check for updates meets a proxy that is not there."""
    environment = {name: value for name, value in os.environ.items() if not _is_proxy(name)}
    for kind in ("CONFIG", "DATA", "CACHE"):
        environment[f"XDG_{kind}_HOME"] = str(folder / kind.lower())
    for kind in ("HTTP", "HTTPS", "ALL"):
        environment[f"{kind}_PROXY"] = "http://127.0.0.1:9"
    command = [*RERUN, "analytics", "disable"]
    subprocess.run(command, env=environment, capture_output=True, check=True)
    return environment


def _is_proxy(name: str) -> bool:
    return name.lower().endswith("_proxy")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _await_port(process: subprocess.Popen[bytes], port: int) -> None:
    end = time.monotonic() + _START_S
    while time.monotonic() < end:
        if process.poll() is not None:
            raise ConnectionError("it ended")
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(0.05)
    raise BadInput(f"Rerun's viewer does not answer within {_START_S:g} s of its start; try again")


def _ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether the process is at its end, or soon will be: its port closes before it is gone."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END_S)
    return process.poll() is not None


def _why_ended(log: str) -> BadInput:
    if "render context" in log or "graphics adapter" in log:
        return BadInput(
            f"the viewer found no Vulkan driver; on Debian and Ubuntu: apt-get install {PACKAGES}"
        )
    last = (log.strip().splitlines() or ["no reason given"])[-1]
    return BadInput(f"the viewer ended with an error: {last}")


def _require_timeline(rrd: Path) -> None:
    try:
        with rrd.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise BadInput(f"{rrd}: cannot be read ({error.strerror})") from None
    if magic != b"RRF2":
        raise BadInput(f"{rrd}: not a timeline; give an .rrd file")


def _load(client: ViewerClient, rrd: Path) -> None:
    client.open(str(rrd.resolve()))
    end = time.monotonic() + _LOAD_S
    while client.get_state().loading and time.monotonic() < end:
        time.sleep(0.1)


def _set_cursor(client: ViewerClient, rrd: Path, at_s: float | None) -> None:
    timelines = [each for run in client.get_state().recordings for each in run.timelines]
    times = next((each for each in timelines if each.name == "sim_time"), None)
    if times is None or times.start is None or times.end is None:
        if at_s is not None:
            raise BadInput(f"{rrd}: has no timeline sim_time for --at; leave it out")
        return
    start_s, end_s = times.start * 1e-9, times.end * 1e-9
    cursor_s = 0.5 * (start_s + end_s) if at_s is None else at_s
    if not start_s <= cursor_s <= end_s:
        raise BadInput(f"--at {at_s:g}: the run goes from {start_s:g} to {end_s:g} s")
    client.set_time("sim_time", duration=cursor_s, play_state="paused")
