"""What tests of all rooms share."""

import gc
import os
import signal
import sys
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from fuselog.recorders.compiling.compile import core_count, use_cores
from fuselog.recorders.environment import CORES
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

gc.disable()  # until the tests are collected: what is imported stays
os.fsync = lambda _: None  # no test ends the machine; commands in other processes do wait for the disk

pytest_plugins = ["tests.goldens.keeping"]

# The same examples in every run: a red test is red for everyone, and stays so until it is mended.
settings.register_profile("fuselog", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("fuselog")

# readline, which pytest imports, sets these for the processes of xdist, where text would be 80 wide
for _name in ("COLUMNS", "LINES"):
    os.environ.pop(_name, None)


def pytest_collection_finish() -> None:
    """Leave what is imported by now out of every later collection: a twentieth of the suite's time."""
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(200_000, 20, 100)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip on Windows what it has no such thing for."""
    if sys.platform == "win32" and item.get_closest_marker("unix"):
        pytest.skip("signals, limits, links and owners of files as Unix has them")


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops in plain Python: the reference, which a debugger can follow.

    Memory holds what shows where it is read before it is written.
    """
    monkeypatch.setenv("FUSELOG_UNCOMPILED", "1")
    monkeypatch.setattr(np, "empty", _unwritten)


@pytest.fixture
def collect() -> Callable[[], int]:
    """Collect what is left of a test; going through what other tests left takes a second."""
    gc.freeze()
    return gc.collect


@pytest.fixture
def on_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Have kernels use a number of cores, until the test ends."""
    before = core_count()
    monkeypatch.setenv(CORES, str(before))  # so that what was there is put back
    yield use_cores
    use_cores(before)


def _unwritten(shape: Any, dtype: Any = float, **options: Any) -> np.ndarray:
    made = np.zeros(shape, dtype, **options)
    if made.dtype.kind == "f":
        made[...] = np.nan
    return made


@contextmanager
def heeding_interrupts() -> Iterator[None]:
    """Ctrl-C ends this process and one begun meanwhile, also in a background job or with nohup."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


_FIRST: dict[tuple[tuple[str, ...], ...], str] = {}  # of charts with the same axes


@contextmanager
def without_drawing() -> Iterator[None]:
    """Figures are made and written, but not drawn, which takes most of a short run's time.

    Of charts with the same axes only the first is made, each time; the others are blank.
    """
    from matplotlib.figure import Figure

    from fuselog.pipeline.output.charts import Chart, draw

    def made(chart: Chart) -> Figure:
        axes = tuple((panel.title, panel.x.label, panel.y.label) for panel in chart.panels)
        told = chart.model_dump_json()
        return draw(chart) if _FIRST.setdefault(axes, told) == told else Figure()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fuselog.pipeline.output.results.draw", made)
        patch.setattr("matplotlib.figure.Figure.draw", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def blank_figures() -> Iterator[None]:
    """Nothing is drawn in modules that look at no drawing.

    Those of experiments, sweeps, trajectories and the report draw theirs, and so do the studies whose
    figures are no charts: all charts are drawn by the same code.
    """
    with without_drawing():
        yield


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real data sets that are not part of the project; tests without it are skipped."""
    beside_the_checkout = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("FUSELOG_DATA", beside_the_checkout))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set FUSELOG_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def mrclam6(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of MRCLAM data set 6, unpacked once."""
    return _unpacked(real_data / "mrclam6.tar.xz", tmp_path_factory) / "mrclam6"


@pytest.fixture(scope="session")
def mrclam6_log(mrclam6: Path) -> MemorySource:
    """The log of MRCLAM data set 6, imported once."""
    return memory_source(*import_run("mrclam", mrclam6, {}))


@pytest.fixture(scope="session")
def autoferry(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the Autoferry scenarios, unpacked once."""
    return _unpacked(real_data / "autoferry.tar.xz", tmp_path_factory) / "autoferry"


@pytest.fixture(scope="session")
def autoferry_log(autoferry: Path) -> Callable[[int], MemorySource]:
    """The log of an Autoferry scenario, each imported once."""
    return cache(
        lambda number: memory_source(*import_run("autoferry", autoferry / f"scenario{number}", {}))
    )


@pytest.fixture(scope="session")
def trajectories(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of TUM and KITTI trajectories and of evo's results, unpacked once."""
    return _unpacked(real_data / "trajectories.tar.xz", tmp_path_factory) / "trajectories"


@pytest.fixture(scope="session")
def navigation(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of GNSS, inertial and UWB recordings, unpacked once."""
    return _unpacked(real_data / "navigation.tar.xz", tmp_path_factory) / "navigation"


@pytest.fixture(scope="session")
def acoustic(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of opensoundscape's recordings and tables, unpacked once."""
    return _unpacked(real_data / "acoustic.tar.xz", tmp_path_factory) / "acoustic"


def _unpacked(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not path.exists():
        pytest.skip(f"no {path}")
    place = tmp_path_factory.mktemp("data")
    with tarfile.open(path) as archive:
        archive.extractall(place, filter="data")
    return place
