"""Campaigns: the same bytes from any workers and after any stop, and nothing worked off twice."""

import json
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import chdir, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.command_line import main
from fuselog.pipeline.output.results import TIMINGS
from fuselog.pipeline.runs import campaigns, executors
from fuselog.pipeline.runs.campaigns import Pace, work_off
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.executors import (
    InlineExecutor,
    WorkerPool,
    pool_for,
    processes,
    started,
    version_of_code,
)
from fuselog.pipeline.runs.experiment import (
    Experiment,
    experiment_of_logs,
    load_experiment,
    run_experiment,
)
from fuselog.pipeline.runs.inputs import Record
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import write_log
from fuselog.recorders.recording import record_run
from fuselog.replay.foreign.naming import Allowed
from fuselog.replay.judging.metrics.sums import BinnedSums
from tests.bench import scaling
from tests.pipeline.conftest import shadowed

pytestmark = pytest.mark.usefixtures("blank_figures")

# Three cells, of which the last is small.
CELL, RUNS = 16, 36
SETTINGS = {"duration_s": 1}


def run(folder: Path, open_pool=None, runs: int = RUNS, **options) -> dict[str, bytes]:
    """Run the experiment; returns the bytes of all files of its result but for the timeline."""
    name, experiment = load_experiment("landmarks", SETTINGS, {"runs": runs})
    run_experiment(name, experiment, folder, logs=2, open_pool=open_pool, **options)
    return contents(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".rrd" and path.name != TIMINGS
    }


@pytest.fixture(scope="module", autouse=True)
def _small_cells() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", CELL)
        yield


def unfinished(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.unfinished")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, dict[str, bytes]]:
    """The result of one process, and its folder."""
    folder = tmp_path_factory.mktemp("campaign") / "result"
    return folder, run(folder, errors=True)


@pytest.fixture(scope="module")
def without_errors(tmp_path_factory) -> tuple[Path, dict[str, bytes]]:
    """The result of one process without its table of errors, and its place, where it is no longer."""
    folder = tmp_path_factory.mktemp("campaign") / "result"
    files = run(folder)
    shutil.rmtree(folder)
    return folder, files


@pytest.fixture
def place(without_errors) -> Path:
    """Where that result was, since estimates state where their logs are."""
    yield without_errors[0]
    shutil.rmtree(without_errors[0], ignore_errors=True)


@pytest.fixture
def files(without_errors) -> dict[str, bytes]:
    return without_errors[1]


@pytest.fixture
def worked_off(monkeypatch) -> list[int]:
    """The first runs of all cells that are worked off, as it goes."""
    cells: list[int] = []
    work = campaigns.Cell.packed

    def packed(cell, folder):
        cells.append(cell.first)
        return work(cell, folder)

    monkeypatch.setattr(campaigns.Cell, "packed", packed)
    return cells


@pytest.mark.paper
def test_cells_are_merged_into_what_one_pass_gives(whole, tmp_path, monkeypatch):
    folder, files = whole
    monkeypatch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", RUNS)
    one_pass = json.loads(run(tmp_path / "one")["result.json"])["metrics"]
    assert json.loads(files["result.json"])["metrics"] == pytest.approx(one_pass, rel=1e-12)
    errors = pytest.importorskip("pandas").read_parquet(folder / "tables/errors/ekf-robot1.parquet")
    runs = errors.groupby("run").size()
    assert len(runs) == RUNS
    assert runs.nunique() == 1
    assert (folder / "timeline.rrd").is_file()
    assert sum(name.startswith("logs/") for name in files) == 2
    assert not unfinished(folder).exists()


@pytest.mark.paper
def test_another_way_of_working_gives_the_same_bytes(whole, tmp_path, worked_off):
    place = whole[0]  # the same place, since estimates state where their logs are
    kept = tmp_path / "first"
    place.rename(kept)
    try:

        @contextmanager
        def backwards():
            """Works on all cells at once, and the last one is done first."""
            yield WorkerPool(Backwards(), 3)

        assert run(place, backwards, errors=True) == whole[1]
        assert worked_off == [2 * CELL, CELL, 0]
    finally:
        shutil.rmtree(place, ignore_errors=True)
        kept.rename(place)


class Backwards(InlineExecutor):
    """Begins when three are there, with the last."""

    def __init__(self) -> None:
        self.waiting: list = []

    def submit(self, work, /, *args):
        """Keep the work, and do all of it when there is enough."""
        future: Future = Future()
        self.waiting.append((future, work, args))
        if len(self.waiting) == 3:
            for each, work, args in reversed(self.waiting):
                each.set_result(work(*args))
        return future


@pytest.mark.paper
def test_a_stopped_campaign_goes_on_where_it_was(place, files, worked_off, monkeypatch, caplog):
    counted = campaigns.Cell.packed

    def stopped(cell, folder):
        if cell.first == CELL:
            raise KeyboardInterrupt
        return counted(cell, folder)

    with monkeypatch.context() as patch:
        patch.setattr(campaigns.Cell, "packed", stopped)
        with pytest.raises(KeyboardInterrupt):
            run(place)
    assert not place.exists()
    assert "1 finished cells are kept; run the same command again to compute the others" in caplog.text
    half = unfinished(place) / f".{'0' * 64}.bin.abc.part"  # killed while a cell was being kept
    half.mkdir()
    (half / "fuselog.lock").touch()
    (half / "new.bin").write_bytes(b"half a ce")
    assert run(place) == files
    assert "1 of 3 cells are already done" in caplog.text
    assert worked_off == [0, CELL, 2 * CELL]
    assert not unfinished(place).exists()


@pytest.mark.paper
@pytest.mark.parametrize("what", ["settings", "one cell", "code", "damaged", "a file is gone"])
def test_cells_of_something_else_are_not_used(what, tmp_path, worked_off, monkeypatch):
    place = tmp_path / "result"
    with monkeypatch.context() as patch:
        patch.setattr(campaigns.Checkpoints, "hand_over", lambda *_: 1 / 0)
        with pytest.raises(BadInput, match="division by zero"):
            run(place, runs=CELL + 2)
    worked_off.clear()
    if what == "code":
        monkeypatch.setattr(campaigns, "version_of_code", lambda: "another")
    elif what == "damaged":
        for path in unfinished(place).glob("*.bin"):
            path.write_bytes(path.read_bytes()[:-1])
        half = next(unfinished(place).glob("*/logs")) / "half.mcap"
        half.write_bytes(b"killed while a log was written")
    elif what == "a file is gone":
        next(unfinished(place).glob("*/logs/run-0001.mcap")).unlink()
    run(place, runs={"settings": CELL + 3, "one cell": 1}.get(what, CELL + 2))
    assert worked_off == {"a file is gone": [0], "one cell": []}.get(what, [0, CELL])
    assert not list(place.rglob("half.mcap"))
    assert not unfinished(place).exists()


@pytest.mark.paper
def test_a_dead_worker_costs_its_cell_which_is_tried_again(tmp_path, worked_off):
    teams = []

    @contextmanager
    def dying():
        teams.append(Dying(deaths=len(teams) < 2))
        yield WorkerPool(teams[-1], 2)

    files = run(tmp_path / "result", dying)
    assert len(teams) == 3
    assert worked_off == [CELL, 2 * CELL, 0]  # the first cell died beside the second, then the third
    assert json.loads(files["result.json"])["settings"]["runs"] == RUNS

    @contextmanager
    def hopeless():
        yield WorkerPool(Dying(deaths=True), 1)

    with pytest.raises(BadInput, match="runs 0 to 15: the process that computed them died 3 times"):
        run(tmp_path / "other", hopeless)


class Dying(InlineExecutor):
    """The process of the first cell dies, as in a pool, which is then of no use."""

    def __init__(self, *, deaths: bool) -> None:
        self.deaths = deaths

    def submit(self, work, /, *args, **kwargs):
        """Die at the first work."""
        if self.deaths:
            self.deaths = False
            future: Future = Future()
            future.set_exception(BrokenExecutor("it was killed"))
            return future
        return super().submit(work, *args, **kwargs)


class Waiting(Executor):
    """Keeps work waiting until it is told to do the first of it, or to die with it."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Future[bytes], Callable[[], bytes]]] = []

    def submit(self, work, /, *args, **kwargs):
        """Have the work wait."""
        self.waiting.append((Future(), partial(work, *args, **kwargs)))
        return self.waiting[-1][0]

    def go_on(self, *, dies: bool) -> None:
        """Do the first work that waits, or die with it."""
        future, work = self.waiting.pop(0)
        if dies:
            future.set_exception(BrokenExecutor("it was killed"))
        else:
            future.set_result(work())


class Numbered(NamedTuple):
    """A cell whose result is its number."""

    first: int
    runs: int = 1
    files: tuple[Path, ...] = ()

    @property
    def end(self) -> int:
        """The next cell."""
        return self.first + 1

    @property
    def key(self) -> str:
        """The number, as a name of a kept cell."""
        return f"{self.first:064x}"

    def packed(self, folder: Path) -> bytes:  # noqa: ARG002
        """The number, as workers send it."""
        return pickle.dumps(self.first)


def test_a_cell_waits_for_each_worker_and_is_not_blamed_for_its_death(tmp_path):
    executors_begun: list[Waiting] = []
    deaths, waiting = [True, True, False, True, False, False], []

    @contextmanager
    def one_worker():
        executors_begun.append(Waiting())
        yield WorkerPool(executors_begun[-1], 1, queued=1)

    def go_on() -> None:
        waiting.append(len(executors_begun[-1].waiting))
        executors_begun[-1].go_on(dies=deaths.pop(0))

    with checkpoints_of(tmp_path / "result") as checkpoints:
        cells = [Numbered(number) for number in range(3)]
        assert [*work_off(cells, one_worker, checkpoints, Pace(3), go_on)] == [0, 1, 2]
    assert waiting == [2, 2, 2, 2, 2, 1]
    assert not deaths


def test_workers_begin_before_their_work_is_ready_and_others_when_these_died():
    begun: list[Waiting] = []
    ended: list[Waiting] = []

    @contextmanager
    def two_workers():
        begun.append(Waiting())
        yield WorkerPool(begun[-1], 2)
        ended.append(begun[-1])

    with started(two_workers) as open_pool:
        assert len(begun[0].waiting) == 2
        with open_pool() as pool:
            assert pool.executor is begun[0]
            assert not ended
        assert ended == begun
        with open_pool() as pool:
            assert pool.executor is begun[1]
            assert not begun[1].waiting
    assert len(begun) == 2
    assert ended == begun
    with started(two_workers):
        assert len(ended) == 2
    assert ended == begun


# What a worker says of its cores: threads of libraries, and cores of kernels.
CORES_THERE = (
    "(__import__('scipy.linalg'), "
    "{each['num_threads'] for each in __import__('threadpoolctl').threadpool_info()}, "
    "__import__('fuselog.recorders.compiling.compile', fromlist=['']).core_count())[1:]"
)


@pytest.fixture
def all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """No variable states the number of cores, as in a user's shell."""
    for name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("all_cores")
def test_a_worker_uses_one_core() -> None:
    """Also in SciPy, whose library is another than NumPy's, and is loaded only when it is used.

    Ctrl-C, which all processes of a terminal get, does not reach it while it is started.
    """
    with processes(1)() as pool:
        assert not pool.executor.submit(eval, "'scipy' in __import__('sys').modules").result()
        assert pool.executor.submit(eval, CORES_THERE).result() == ({1}, 1)
        if hasattr(signal, "pthread_sigmask"):
            blocked = pool.executor.submit(signal.pthread_sigmask, signal.SIG_BLOCK, []).result()
            assert signal.SIGINT in blocked
            assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.paper
def test_workers_in_another_folder_read_logs_and_write_files(tmp_path, monkeypatch):
    """Relative paths are the driver's; what is required is every log, and the folder of kept cells."""
    monkeypatch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", 1)
    monkeypatch.chdir(tmp_path)
    drives, place = [Path(f"{seed}.mcap") for seed in (1, 2)], Path("result")
    for seed, drive in enumerate(drives):
        recording, run = record_run("landmarks", {"duration_s": 3.0}, seed)
        write_log(drive, recording.streams, run)

    def replayed(open_pool=None) -> dict[str, bytes]:
        experiment = experiment_of_logs(drives, ["ekf"]).with_settings({}, {})
        run_experiment("drives", experiment, place, logs=1, errors=True, open_pool=open_pool)
        return contents(place)

    files = replayed()
    shutil.rmtree(place)
    required: list[Path] = []
    (tmp_path / "elsewhere").mkdir()
    elsewhere = WorkerPool(Elsewhere(tmp_path / "elsewhere"), 1, required.extend)
    assert replayed(lambda: nullcontext(elsewhere)) == files
    assert "estimates/run-0000.mcap" in files
    assert required == [*(tmp_path / drive for drive in drives), tmp_path / unfinished(place)]


class Elsewhere(InlineExecutor):
    """Works in another folder; what comes and goes is pickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def submit(self, work, /, *args):
        """Work there."""
        with chdir(self.folder):
            return super().submit(pickle.loads(pickle.dumps(work)), *args)


@pytest.mark.parametrize("fault", ["cannot read", "has another"])
def test_a_path_that_a_worker_does_not_find_is_named(fault: str, tmp_path: Path) -> None:
    """With the worker and the mend, whether it is missing there or not the same."""
    log = tmp_path / "drive.mcap"
    log.write_bytes(b"a log")

    class Client:
        """Has a worker with the same files, and one without."""

        def run(self, function, paths):
            there = function(paths)
            return {"tcp://one:1": there, "tcp://two:2": [there[0], None if fault[0] == "c" else (1, 1)]}

    with pytest.raises(BadInput) as refused:
        executors._require_paths("tcp://one:8786", Client(), [tmp_path, log])
    assert str(refused.value) == (
        f"--scheduler tcp://one:8786: worker tcp://two:2 {fault} {log}; put logs and --out on a "
        "disk that all workers share, under the same paths, or leave out --scheduler"
    )


@pytest.mark.paper
def test_a_campaign_without_logs_has_its_timeline(tmp_path):
    name, experiment = load_experiment("landmarks", SETTINGS, {"runs": CELL + 2})
    run_experiment(name, experiment, tmp_path / "result", logs=0)
    assert (tmp_path / "result" / "timeline.rrd").is_file()
    assert not (tmp_path / "result" / "logs").exists()


def test_progress_tells_how_many_runs_how_fast_and_who_works(tmp_path):
    said: list[tuple[str, int]] = []

    def progress(items, title, total):
        for item in items:
            yield item
            said.append((str(title), total))

    run(tmp_path / "result", runs=CELL + 2, progress=progress)
    told = [each for each in said if each[0].startswith("replaying: ")]
    assert [total for _, total in told] == [2, 2]
    for done, (text, _) in zip((CELL, CELL + 2), told, strict=True):
        assert re.fullmatch(rf"replaying: {done} of 18 runs, [1-9]\d* runs/s, 1 worker; cells", text)


def test_what_is_not_ours_stays(tmp_path):
    place = tmp_path / "result"
    unfinished(place).mkdir()
    note = unfinished(place) / "thesis.txt"
    note.write_text("years of work")
    with pytest.raises(
        BadInput, match=r"contains thesis\.txt, which fuselog did not write; move it away"
    ):
        run(place, runs=CELL + 2)
    assert note.read_text() == "years of work"
    note.unlink()
    with checkpoints_of(place) as checkpoints:
        checkpoints.begin()
        with pytest.raises(BadInput, match="another fuselog command is using this folder"):
            run(place, runs=CELL + 2)


def test_a_metric_that_cannot_be_pickled_is_bad_input(monkeypatch, tmp_path):
    work = campaigns.Cell.work_off

    def unpicklable(cell, folder):
        done = work(cell, folder)
        done.judge._names[0] = lambda: 0
        return done

    monkeypatch.setattr(campaigns.Cell, "work_off", unpicklable)
    with pytest.raises(BadInput, match="the sums of a metric cannot be sent to another process"):
        run(tmp_path / "result", runs=CELL + 2)


def test_bins_of_very_many_runs_are_wider():
    whole, parts = (BinnedSums(1, width=1, limit=8, cells=32) for _ in range(2))
    rng = np.random.default_rng(5)
    for first in range(0, 12, 2):
        part = BinnedSums(1, width=1, limit=8, cells=32, first=first)
        position, values = rng.integers(0, 8, 40), rng.normal(size=(40, 1))
        part.add(position, values, rng.integers(first, first + 2, 40))
        parts.merge(pickle.loads(pickle.dumps(part)))
        whole.merge(part)
    cells, count, sums = parts.filled()
    assert parts.width == 4
    assert len(cells) <= 32
    assert count.sum() == 240
    assert set(cells[:, 0]) == set(range(12))
    assert len(part._sums) <= 3  # a part has no place for the groups before its own
    assert np.array_equal(sums, whole.filled()[2])


def test_options_that_contradict_or_lead_nowhere_are_refused(tmp_path, capsys):
    out = ["--out", str(tmp_path / "result")]
    begin = ["run", "landmarks", "--runs", "130", *out]
    assert main([*begin, "--workers", "2", "--scheduler", "local:2"]) == 2
    assert "a scheduler has its own workers; give one" in capsys.readouterr().err
    assert main([*begin, "--workers", "0"]) == 2
    capsys.readouterr()
    assert main(["run", "ispace", "--workers", "2", *out]) == 2
    assert (
        "networks replays all runs together, in one process; leave out --workers"
        in capsys.readouterr().err
    )
    pytest.importorskip("distributed")
    assert main([*begin, "--scheduler", "local:many"]) == 2
    assert "expected local:N with at least one worker" in capsys.readouterr().err
    with pytest.raises(BadInput, match="expected local:N with at least one worker"):
        fl.run("landmarks", runs=130, scheduler="local:many", out=tmp_path / "result")
    assert not list(tmp_path.iterdir())


def test_the_version_of_the_code_is_of_all_sources():
    assert version_of_code() == version_of_code.__wrapped__()
    assert len(version_of_code()) == 64


def test_the_page_and_its_figure_say_what_was_measured():
    measured = scaling.kept()
    page = scaling.PAGE.read_text(encoding="utf-8")
    assert scaling.rendered(page, measured) == page, "python -m tests.bench.scaling --keep makes it anew"
    drawn = ElementTree.parse(scaling.FIGURE).find(".//{http://purl.org/dc/elements/1.1/}description")
    assert drawn is not None
    assert drawn.text == scaling.chart(measured).model_dump_json()
    slower = measured._replace(driver_s=2 * measured.driver_s)
    assert scaling.rendered(page, slower) != page


def test_the_simulated_driver_is_the_limit_where_it_is_busy():
    """A cell of 1 s, and .1 s of the driver: ten workers and one more keep it busy."""
    network = scaling.NETWORK_BYTES_PER_S
    measured = scaling.Measured(1.0, 0.05, round(0.05 * network), (100.0, 200.0), {})
    assert measured.limit_workers == 11
    assert scaling.simulated(measured, 1) == pytest.approx(128 / 1.1, rel=0.01)
    assert scaling.simulated(measured, 4) == pytest.approx(4 * 128 / 1.1, rel=0.05)
    assert scaling.simulated(measured, 100) == pytest.approx(measured.limit_runs_per_s, rel=0.01)


@pytest.mark.paper
def test_processes_give_the_same_bytes_also_after_a_kill(place, worked_off, monkeypatch):
    monkeypatch.setattr("fuselog.pipeline.runs.ensemble.RUNS_AT_ONCE", 128)
    runs = 130
    files = run(place, runs=runs)
    shutil.rmtree(place)
    worked_off.clear()
    command = [
        "run",
        "landmarks",
        "--runs",
        str(runs),
        "--logs",
        "2",
        "--out",
        str(place),
        "--set",
        f"duration_s={SETTINGS['duration_s']}",
    ]
    fuselog = Path(sys.executable).with_name("fuselog")
    begun = subprocess.Popen([fuselog, *command, "--workers", "2"], stderr=subprocess.PIPE)
    while not list(unfinished(place).glob("*.bin")):
        assert begun.poll() is None, begun.communicate()
        time.sleep(0.01)
    begun.kill()
    begun.communicate()
    assert not place.exists()
    assert main(command) == 0
    assert contents(place) == files
    assert len(worked_off) < 2  # in this process; the other cell is of a worker
    assert not unfinished(place).exists()


@pytest.mark.paper
@pytest.mark.usefixtures("all_cores")
def test_dask_workers_give_the_same_bytes(place, files, tmp_path):
    """Of `local:1`, and by its address as of a cluster that is there, whose worker may share no files.

    A worker uses one core, also when it was started again, and imports no module of the current folder.
    """
    distributed = pytest.importorskip("distributed")
    with shadowed(tmp_path), pool_for(None, "local:1", RUNS)() as pool:
        client = distributed.get_client()
        assert pool.executor.submit(eval, CORES_THERE).result() == ({1}, 1)
        for each in (lambda: nullcontext(pool), pool_for(None, client.scheduler.address, RUNS)):
            assert run(place, each) == files
            shutil.rmtree(place)
        client.restart()
        assert pool.executor.submit(eval, CORES_THERE).result() == ({1}, 1)


def test_cells_of_a_library_that_was_compiled_again_are_not_used(tmp_path: Path) -> None:
    library = tmp_path / "mine.so"
    stated = {"kind": "lib", "path": Allowed(library)}
    experiment = Experiment(
        title="mine", record=Record(scenario="landmarks"), estimators={"mine": stated}
    )
    keys = []
    for content in ("one", "another"):
        library.write_text(content)
        keys.append(campaigns.Cell(experiment, 0, 1, 1, False, False, tmp_path).key)
    assert keys[0] != keys[1]
