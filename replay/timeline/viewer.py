"""Viewer of Rerun, which is part of rerun-sdk: a window, a picture, or a page for a browser.

The viewer listens only on the loopback interface, does not report usage, does not use the network, and
ends with the process that started it, even if that process is killed.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import rerun as rr
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from rerun.experimental import ViewerClient

from fuselog.recorders.atomic import scratch_folder, whole_file
from fuselog.recorders.errors import BadInput
from fuselog.recorders.processes import start_module
from fuselog.replay.timeline.sinks import rerun_path

PACKAGES = "mesa-vulkan-drivers libvulkan1 libegl1 libgl1-mesa-dri libxkbcommon-x11-0"
# Value of the PNG keyword `Software` in a picture.
SOFTWARE = "fuselog"
_START_S = 20.0
_LOAD_S = 60.0
_END_S = 5.0
_SAID = "rerun.log"
# Messages of the viewer cover its first three or four pictures, regardless of the time, so the first
# pictures are taken of an empty window. The first picture of a timeline may be incomplete.
_EMPTY_PICTURES, _PICTURES = 7, 3
# Height in pixels of the viewer's bar, with the menu and badges of its environment.
_BAR = 36


class Listener(NamedTuple):
    """Running Rerun process, and the address at which it receives data."""

    url: str
    process: subprocess.Popen[bytes]


def screenshot(
    shown: Path | str,
    png: Path,
    *,
    at_s: float | None = None,
    size: tuple[int, int] = (1600, 1000),
    progress: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Save a picture of a timeline in the viewer; this needs a Vulkan driver, but no screen.

    Args:
        shown: the timeline, or the address of a dataset.
        png: the picture to write.
        at_s: time of the cursor in s since the epoch of the run; None for the middle.
        size: width and height in pixels.
        progress: function that is called with a description of the current step.

    Returns the reports of errors in views; empty without errors. The viewer's menu bar is cropped from
    the picture.

    Raises BadInput if a file cannot be found or written, if `at_s` is outside the run, or if no Vulkan
    driver is installed.
    """
    if isinstance(shown, Path):
        _require_timeline(shown)
    if not png.parent.is_dir():
        raise BadInput(f"{png}: the folder does not exist; make it first")
    with scratch_folder("fuselog-viewer") as folder, whole_file(png, parents=False) as new:
        window = f"{size[0]}x{size[1] + _BAR}"
        progress("picture: starting the viewer")
        with listen(folder, "--headless", "--hide-welcome-screen", "--window-size", window) as listener:
            client = ViewerClient.connect(listener.url)
            picture = folder / "picture.png"
            for _ in range(_EMPTY_PICTURES):
                client.save_screenshot(rerun_path(picture))
            progress("picture: loading the timeline")
            client.open(shown if isinstance(shown, str) else rerun_path(shown.resolve()))
            _await_loaded(client)
            _set_cursor(client, shown, at_s)
            for number in range(_PICTURES):
                progress(f"picture: drawing, {number + 1} of {_PICTURES}")
                client.save_screenshot(rerun_path(picture))
            views = client.get_state().views
        info = PngInfo()
        info.add_text("Software", SOFTWARE)
        with Image.open(picture) as image:
            image.crop((0, _BAR, *image.size)).save(new, pnginfo=info)
    return [f"{view.name}: {report}" for view in views for report in view.reports]


def view(rrd: Path, *, at_s: float | None = None) -> None:
    """Open a timeline in the desktop viewer and wait until it is closed.

    Args:
        rrd: the timeline.
        at_s: time of the cursor in s since the epoch of the run; None for the viewer's default.

    Raises BadInput if the file or a screen is missing, or if the viewer cannot run.
    """
    _require_timeline(rrd)
    with showing(str(rrd)) as listener:
        if at_s is not None:
            client = ViewerClient.connect(listener.url)
            _await_loaded(client)
            _set_cursor(client, rrd, at_s)
        listener.process.wait()


@contextmanager
def showing(address: str) -> Iterator[Listener]:
    """Open a timeline or a dataset in the desktop viewer, which is closed at the end.

    Raises BadInput if there is no screen, or if the viewer cannot run.
    """
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise BadInput(
            "there is no screen to show a timeline on; give --web to see it in a browser, --screenshot "
            "FILE.png for a picture, --save FILE.rrd for a file, or --connect URL for a running viewer"
        )
    port = _free_port()
    options = [address, "--port", str(port), "--bind", "127.0.0.1"]
    with scratch_folder("fuselog-viewer") as folder:
        with _running(folder, options, _private_environment(folder)) as process:
            try:
                _await_port(process, port)
            except ConnectionError:
                raise _why_ended(folder) from None
            yield Listener(f"rerun+http://127.0.0.1:{port}/proxy", process)
            code = process.poll()
        if code:
            raise _why_ended(folder)


def serve(rrd: Path, announce: Callable[[str], None]) -> None:
    """Serve a timeline to browsers on this machine with the web viewer of Rerun, until interrupted.

    Args:
        rrd: the timeline.
        announce: function that is called with the address of the page as soon as it is available.

    Raises BadInput if the file is missing, or if the viewer ends.
    """
    _require_timeline(rrd)
    with serving(announce, timeline=rrd) as listener:
        listener.process.wait()


@contextmanager
def serving(
    announce: Callable[[str], None], *, timeline: Path | None = None, address: str | None = None
) -> Iterator[Listener]:
    """Serve a timeline, or the dataset at an address, with Rerun's web viewer; see `serve`."""
    port = _free_port()
    options = ["--serve-web", "--web-viewer-port", str(port)]
    files = [] if timeline is None else [str(timeline.resolve())]
    with scratch_folder("fuselog-viewer") as folder, listen(folder, *files, *options) as listener:
        _await_port(listener.process, port)
        announce(f"http://127.0.0.1:{port}/?url={quote(address or listener.url, safe='')}")
        yield listener
        if listener.process.poll() is not None:
            raise _why_ended(folder)


def view_inline(rrd: Path) -> None:
    """Show a timeline in a notebook cell with the widget of the package rerun-notebook.

    Raises BadInput if the package is not installed, or if the file is missing.
    """
    _require_timeline(rrd)
    try:
        from IPython.display import display
        from rerun_notebook import Viewer
    except ImportError:
        raise BadInput(
            "to show a timeline in a notebook, install fuselog's extra `notebook`: pip install "
            f"rerun-notebook=={rr.__version__}; or write it with save=FILE.rrd"
        ) from None
    widget = Viewer(width="auto", height="auto")
    widget.send_rrd(rrd.read_bytes())
    display(widget)


@contextmanager
def listen(folder: Path, *options: str) -> Iterator[Listener]:
    """Run `rerun OPTIONS` as a receiver on the loopback interface, with `folder` as its home directory.

    Raises BadInput if the process does not start, or ends while it is still needed.
    """
    port = _free_port()
    address = ["--port", str(port), "--bind", "127.0.0.1"]
    environment = _private_environment(folder) | {"HOME": str(folder)}
    with _running(folder, [*options, *address], environment) as process:
        try:
            _await_port(process, port)
            yield Listener(f"rerun+http://127.0.0.1:{port}/proxy", process)
        except BadInput:
            raise
        except Exception as error:
            if _ended(process):
                raise _why_ended(folder) from error
            raise


@contextmanager
def _running(
    folder: Path, options: Sequence[str], environment: Mapping[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run `rerun OPTIONS` with its output in a file of the folder."""
    with (folder / _SAID).open("wb") as output:
        process = start_module(
            "fuselog.replay.timeline.keeper",
            *options,
            environment=environment,
            stdout=output,
            stderr=output,
            start_new_session=True,  # this process handles an interrupt from the terminal
        )
    assert process.stdin is not None
    try:
        yield process
    finally:
        process.stdin.close()  # this ends the process
        process.wait()


def _private_environment(folder: Path) -> dict[str, str]:
    """Return an environment with its own folders and without usage reports.

    The viewer's check for updates fails, because its proxy does not exist.
    """
    environment = {name: value for name, value in os.environ.items() if not _is_proxy(name)}
    for kind in ("CONFIG", "DATA", "CACHE"):
        environment[f"XDG_{kind}_HOME"] = str(folder / kind.lower())
    for kind in ("HTTP", "HTTPS", "ALL"):
        environment[f"{kind}_PROXY"] = "http://127.0.0.1:9"
    with _running(folder, ["analytics", "disable"], environment) as process:
        process.wait()
    if process.returncode != 0:
        raise _why_ended(folder)
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
    raise BadInput(
        f"Rerun's viewer did not answer within {_START_S:g} s after it was started; try again"
    )


def _ended(process: subprocess.Popen[bytes]) -> bool:
    """Test whether the process has ended or will end soon; its port closes before it ends."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END_S)
    return process.poll() is not None


def _why_ended(folder: Path) -> BadInput:
    log = (folder / _SAID).read_text(encoding="utf-8", errors="replace")
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
        raise BadInput(f"{rrd}: is not a timeline; give an .rrd file")


def _await_loaded(client: ViewerClient) -> None:
    end = time.monotonic() + _LOAD_S
    while client.get_state().loading and time.monotonic() < end:
        time.sleep(0.1)


def _set_cursor(client: ViewerClient, shown: Path | str, at_s: float | None) -> None:
    timelines = [each for run in client.get_state().recordings for each in run.timelines]
    times = next((each for each in timelines if each.name == "sim_time"), None)
    if times is None or times.start is None or times.end is None:
        if at_s is not None:
            raise BadInput(f"{shown}: has no timeline sim_time; leave out --at")
        return
    start_s, end_s = times.start * 1e-9, times.end * 1e-9
    cursor_s = 0.5 * (start_s + end_s) if at_s is None else at_s
    if not start_s <= cursor_s <= end_s:
        raise BadInput(f"--at {at_s:g}: give a time within the run, from {start_s:g} to {end_s:g} s")
    client.set_time("sim_time", duration=cursor_s, play_state="paused")
