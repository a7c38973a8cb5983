"""Cells of an experiment, which are processed in any order and merged in a fixed order.

A cell is a part of the runs. A cell's result depends only on its description, its data and the code, so
it can be computed anywhere and needs to be computed only once. Finished cells are kept until all are
done, and after an interruption the same command continues with them; see
`fuselog.pipeline.runs.checkpoints`.
"""

import hashlib
import json
import logging
import pickle
import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from fuselog.pipeline.output.results import import_writers
from fuselog.pipeline.runs.checkpoints import Checkpoints
from fuselog.pipeline.runs.ensemble import Pass, parts_of
from fuselog.pipeline.runs.executors import (
    PoolFactory,
    inline_pool,
    keep_freed_memory,
    states_of,
    version_of_code,
)
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.inputs import Record, load_scenario
from fuselog.pipeline.runs.recorded import KEPT_BYTES, require_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import merge
from fuselog.replay.foreign.naming import program_files

# A cell is abandoned after its workers have died this many times.
ATTEMPTS = 3
_LOG = logging.getLogger("fuselog")


class Work(Protocol):
    """A part of a campaign: the runs from `first` to `end` (exclusive)."""

    @property
    def first(self) -> int:
        """Return the number of the first run."""

    @property
    def end(self) -> int:
        """Return the number of the run after the last."""

    @property
    def runs(self) -> int:
        """Return the number of runs."""

    @property
    def files(self) -> Sequence[Path]:
        """Return the logs that the work reads."""

    @property
    def key(self) -> str:
        """Return a hash of everything that determines the result."""

    def packed(self, folder: Path) -> bytes:
        """Do the work, write files to the folder, and pickle the result."""


@dataclass(frozen=True)
class Cell:
    """The runs from `first` to `end` (exclusive) of an experiment.

    Attributes:
        experiment: the complete experiment; apart from its logs and its estimators' programs, the result
            depends on no other file.
        first, end: the number of the first run, and of the run after the last.
        logs: number of runs whose logs are kept.
        draws: whether the timeline of the first run is drawn.
        errors: whether all individual errors are kept.
        place: final path of the experiment's result.
    """

    experiment: Experiment
    first: int
    end: int
    logs: int
    draws: bool
    errors: bool
    place: Path

    @property
    def runs(self) -> int:
        """Return the number of runs."""
        return self.end - self.first

    @property
    def files(self) -> list[Path]:
        """Return the logs that the cell reads."""
        return self.experiment.files[self.first : self.end]

    @cached_property
    def key(self) -> str:
        """Hash everything that determines the result: the cell's description, the data, and the code."""
        experiment = self.experiment.model_dump(mode="json", by_alias=True)
        runs = [self.first, self.end, self.logs, self.draws, self.errors]
        files = [*self.files, *program_files(self.experiment.estimators)]
        contents = [experiment, states_of(files), runs, str(self.place), version_of_code()]
        return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()

    def work_off(self, folder: Path, setting: Setting | None = None) -> Pass:
        """Record or open the runs, replay and judge them, and write files to the folder."""
        keep_freed_memory()
        if setting is None:
            logs = self.first + self.logs
            setting = Setting(folder, self.place, logs=logs, draws=self.draws, errors=self.errors)
        return Runner(self.experiment, setting).judge(slice(self.first, self.end))

    def packed(self, folder: Path) -> bytes:
        """Process the cell and pickle the result; raise BadInput if a metric cannot be pickled."""
        shutil.rmtree(folder, ignore_errors=True)  # files of a worker that was killed
        if self.draws or self.logs or self.errors:
            folder.mkdir()
        done = self.work_off(folder)
        try:
            return pickle.dumps(done)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise BadInput(
                f"the sums of a metric cannot be sent to another process ({error}); use numbers, arrays "
                "and classes defined in a module"
            ) from error


@dataclass
class Pace:
    """The progress of all cells.

    Attributes:
        runs: number of runs in all cells.
        done: number of runs in merged cells.
        worked_off: number of runs in the cells that this command, not an earlier one, computed.
        workers: number of workers.
        doing: what is done with the runs.
        what: what the runs are.
    """

    runs: int
    done: int = 0
    worked_off: int = 0
    workers: int = 0
    doing: str = "replaying"
    what: str = "runs"
    _begun_s: float = field(default_factory=perf_counter)

    def __str__(self) -> str:
        rate = self.worked_off / (perf_counter() - self._begun_s)
        workers = f"{self.workers} worker{'s' if self.workers > 1 else ''}"
        done = f"{self.done} of {self.runs} {self.what}, {rate:.0f} {self.what}/s"
        return f"{self.doing}: {done}, {workers}; cells"


def judge(experiment: Experiment, setting: Setting) -> Pass:
    """Replay and judge all runs of an experiment cell by cell; write files to the setting's folder.

    Raises BadInput if an estimator cannot replay any run, or if workers die repeatedly.
    """
    cells = cells_of(experiment, setting)
    if len(cells) == 1 or setting.checkpoints is None:  # nothing to distribute or to resume
        return cells[0].work_off(setting.folder, setting).check()
    (done,) = _merged([cells], setting)
    setting.checkpoints.hand_over([cell.key for cell in cells], setting.folder)
    return done


def judge_all(experiments: Sequence[Experiment], setting: Setting) -> Iterator[Pass]:
    """Replay and judge experiments, and yield their results in order; see `judge`.

    The files remain in the folder of the cells.
    """
    return _merged([cells_of(experiment, setting) for experiment in experiments], setting)


def _merged(parts: Sequence[Sequence[Cell]], setting: Setting) -> Iterator[Pass]:
    """Merge the results of the cells of each part, in order."""
    assert setting.checkpoints is not None
    cells = list(chain.from_iterable(parts))
    pace = Pace(sum(cell.runs for cell in cells))
    open_pool = setting.open_pool or inline_pool
    results = work_off(cells, open_pool, setting.checkpoints, pace, import_writers)
    finished = iter(setting.progress(results, pace, len(cells)))
    for part in parts:
        whole = next(finished)
        hashes = hashlib.sha256(whole.input_sha256.encode())
        for done in islice(finished, len(part) - 1):
            hashes.update(done.input_sha256.encode())
            whole.merge(done)
        if len(part) > 1:
            whole.input_sha256 = hashes.hexdigest()
        yield whole.check()
    for _ in finished:  # exhausts the iterator, which ends progress and pool
        pass


def cells_of(experiment: Experiment, setting: Setting) -> list[Cell]:
    """Divide an experiment into cells; the division depends only on the number of runs."""
    require_memory(f"{experiment.runs} runs of {experiment.title}", experiment.runs * KEPT_BYTES)
    if experiment.record:
        recorder, values, _ = load_scenario(experiment.record.scenario)
        parameters = merge(values, experiment.record.parameters)
        record = Record(scenario=recorder, parameters=parameters)
        experiment = experiment.model_copy(update={"record": record})
    experiment = experiment.with_absolute_files()  # a worker may have another working directory
    cells, place = [], setting.place.resolve()
    for now in parts_of(experiment.runs):
        logs = min(max(setting.logs - now.start, 0), now.stop - now.start)
        draws = setting.draws and now.start == 0
        cells.append(Cell(experiment, now.start, now.stop, logs, draws, setting.errors, place))
    return cells


def work_off(
    cells: Sequence[Work],
    open_pool: PoolFactory,
    checkpoints: Checkpoints,
    pace: Pace,
    meanwhile: Callable[[], object] = lambda: None,
) -> Iterator[Any]:
    """Yield the results of cells in order; cells that are already done are not computed again.

    `meanwhile` is called before each wait for a worker. Only the cells in progress are in memory.
    Raises BadInput if the workers of a cell died repeatedly.
    """
    checkpoints.begin()
    keys = [cell.key for cell in cells]
    waiting = deque(number for number, key in enumerate(keys) if not checkpoints.has(key))
    if len(waiting) < len(cells):
        done = len(cells) - len(waiting)
        _LOG.warning(
            "%s: %d of %d cells are already done; computing the others",
            checkpoints.folder,
            done,
            len(cells),
        )
    died: Counter[int] = Counter()
    following = 0
    while following < len(cells):
        with open_pool() as pool:
            pace.workers = pool.workers
            logs = [path for number in waiting for path in cells[number].files]
            pool.require([*logs, checkpoints.folder.absolute()])
            pending: dict[Future[Any], int] = {}
            lost: BaseException | None = None
            while following < len(cells) and lost is None:
                try:
                    while waiting and len(pending) < pool.workers + pool.queued:
                        place = checkpoints.place_of(keys[waiting[0]]).absolute()
                        future = pool.executor.submit(cells[waiting[0]].packed, place)
                        pending[future] = waiting.popleft()
                except BrokenExecutor as broken:  # a worker died since the last result
                    lost = broken
                    died[waiting[0]] += not pending
                    break
                left = checkpoints.read(keys[following])
                if left is not None:
                    pace.done += cells[following].runs
                    yield left
                    following += 1
                    continue
                if following not in waiting and following not in pending.values():
                    died[following] += 1
                    if died[following] >= ATTEMPTS:
                        raise BadInput(
                            f"{checkpoints.folder}: files there are being changed by another program or "
                            "a faulty disk; give another --out"
                        )
                    waiting.appendleft(following)
                    continue
                meanwhile()
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    try:
                        error = future.exception()
                    except CancelledError:  # cancelled by a scheduler that has ended
                        error = BrokenExecutor("the scheduler has ended")
                    if isinstance(error, (*pool.lost, BrokenExecutor)):
                        lost = error
                        continue
                    number = pending.pop(future)
                    pace.worked_off += cells[number].runs
                    checkpoints.write(keys[number], future.result())
            if lost is not None:  # afterwards, some executors lose all other cells as well
                died.update(islice(pending.values(), pool.workers))  # the others were not begun
                waiting.extendleft(sorted(pending.values(), reverse=True))
                number, times = died.most_common(1)[0]
                if times >= ATTEMPTS:
                    cell = cells[number]
                    raise BadInput(
                        f"{pace.what} {cell.first} to {cell.end - 1}: the process that computed them "
                        f"died {times} times ({lost}); try fewer workers, or --workers 1 to see why"
                    )
