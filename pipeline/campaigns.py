"""Campaigns: an experiment cut into cells, worked off in any order, merged in the cells' own.

A cell is a part of the runs. What it gives depends on its description and on the code alone, so that it
may be worked off anywhere, and once is enough: finished cells are kept until all are done, and the same
command goes on from there after it was stopped; see `pipeline.kept`.
"""

import hashlib
import json
import logging
import pickle
import shutil
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from pipeline.ensemble import KEPT_BYTES, Pass, parts_of, require_memory
from pipeline.executors import Crew, Here, here, version_of_code
from pipeline.experiment import Experiment, Record, Setting, load_scenario
from pipeline.kept import Kept
from pipeline.runner import Runner
from recorders.errors import BadInput
from recorders.parameters import merge

# A cell whose workers died so often is given up.
ATTEMPTS = 3
_LOG = logging.getLogger("fuselog")


class Cell(NamedTuple):
    """The runs from `first` to `end` of an experiment.

    Attributes:
        experiment: all of it; nothing that decides lies in another file, but for its logs.
        first, end: the runs.
        logs: of how many of them the logs are kept.
        draws: whether the timeline of the first is drawn.
        errors: whether every single error is kept.
        place: where the experiment's result will be.
    """

    experiment: Experiment
    first: int
    end: int
    logs: int
    draws: bool
    errors: bool
    place: Path

    @property
    def writes(self) -> bool:
        """Whether there will be files."""
        return self.draws or self.logs > 0 or self.errors

    @property
    def key(self) -> str:
        """A hash of what decides about the result: this description, the data, and the code."""
        experiment = self.experiment.model_dump(mode="json", by_alias=True)
        states = [file.stat() for file in self.experiment.files[self.first : self.end]]
        data = [(state.st_size, state.st_mtime_ns) for state in states]
        runs = [self.first, self.end, self.logs, self.draws, self.errors]
        said = [experiment, data, runs, str(self.place.absolute()), version_of_code()]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def work_off(self, folder: Path, setting: Setting | None = None) -> Pass:
        """Record or open the runs, replay and judge them; files go to the folder."""
        if setting is None:
            logs = self.first + self.logs
            setting = Setting(folder, self.place, logs=logs, draws=self.draws, errors=self.errors)
        return Runner(self.experiment, setting).judge(slice(self.first, self.end))

    def packed(self, folder: Path) -> bytes:
        """The same as bytes, which any process can take; BadInput where a metric stands against that."""
        if self.writes:
            shutil.rmtree(folder, ignore_errors=True)  # of a worker that was killed
            folder.mkdir()
        done = self.work_off(folder)
        try:
            return pickle.dumps(done)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise BadInput(
                f"what a metric keeps cannot go to another process ({error}); keep numbers, arrays "
                "and classes of a module"
            ) from error


def judge(experiment: Experiment, setting: Setting) -> Pass:
    """Replay and judge all runs of an experiment, cell by cell; its files go to the setting's folder.

    Raises BadInput where there is an estimator that can follow no run, or workers die again and again.
    """
    cells = cells_of(experiment, setting)
    if len(cells) == 1 or setting.kept is None:  # nothing to share, and nothing to go on with
        return cells[0].work_off(setting.folder, setting).check()
    (done,) = judge_all([experiment], setting)
    setting.kept.hand_over([cell.key for cell in cells], setting.folder)
    return done


def judge_all(experiments: Sequence[Experiment], setting: Setting) -> Iterator[Pass]:
    """What replaying and judging leaves of each experiment, in their order; see `judge`.

    Files stay where cells are kept.
    """
    assert setting.kept is not None
    parts = [cells_of(experiment, setting) for experiment in experiments]
    cells = list(chain.from_iterable(parts))
    runs = sum(experiment.runs for experiment in experiments)
    results = work_off(cells, setting.crew or here, setting.kept)
    told = iter(setting.progress(results, f"replaying {runs} runs", len(cells)))
    for part in parts:
        whole = next(told)
        hashes = hashlib.sha256(whole.input_sha256.encode())
        for done in islice(told, len(part) - 1):
            hashes.update(done.input_sha256.encode())
            whole.merge(done)
        if len(part) > 1:
            whole.input_sha256 = hashes.hexdigest()
        yield whole.check()


def cells_of(experiment: Experiment, setting: Setting) -> list[Cell]:
    """The cells: a cut that only the number of runs decides."""
    require_memory(f"{experiment.runs} runs of {experiment.title}", experiment.runs * KEPT_BYTES)
    if experiment.record:
        recorder, values, _ = load_scenario(experiment.record.scenario)
        parameters = merge(values, experiment.record.parameters)
        record = Record(scenario=recorder, parameters=parameters)
        experiment = experiment.model_copy(update={"record": record})
    cells = []
    for now in parts_of(experiment.runs):
        logs = min(max(setting.logs - now.start, 0), now.stop - now.start)
        draws = setting.draws and now.start == 0
        cells.append(Cell(experiment, now.start, now.stop, logs, draws, setting.errors, setting.place))
    return cells


def work_off(cells: Sequence[Cell], crew: Crew, kept: Kept) -> Iterator[Pass]:
    """What cells leave, in their order; those that are kept are not worked off again.

    Memory holds what is handed out and what comes in. Raises BadInput where the workers of a cell died
    again and again.
    """
    kept.begin()
    keys = [cell.key for cell in cells]
    waiting = deque(number for number, key in enumerate(keys) if not kept.has(key))
    if len(waiting) < len(cells):
        done = len(cells) - len(waiting)
        _LOG.warning("%s: has %d of %d cells; going on with the others", kept.folder, done, len(cells))
    died: Counter[int] = Counter()
    following = 0
    while following < len(cells):
        with crew() as team:
            pending: dict[Future[bytes], int] = {}
            lost: BaseException | None = None
            while following < len(cells) and lost is None:
                while waiting and len(pending) < team.workers:
                    number = waiting.popleft()
                    cell, folder = cells[number], kept.place_of(keys[number])
                    worker = team.executor if team.shares_files or not cell.writes else Here()
                    pending[worker.submit(cell.packed, folder)] = number
                left = kept.read(keys[following])
                if left is not None:
                    yield left
                    following += 1
                    continue
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    error = future.exception()
                    if isinstance(error, team.lost):
                        lost = error
                    else:
                        number = pending.pop(future)
                        kept.write(keys[number], future.result())
            if lost is not None:  # and with it all others of some executors
                died.update(pending.values())
                waiting.extendleft(sorted(pending.values(), reverse=True))
                number, times = died.most_common(1)[0]
                if times >= ATTEMPTS:
                    cell = cells[number]
                    raise BadInput(
                        f"runs {cell.first} to {cell.end - 1}: the process that worked on them died "
                        f"{times} times ({lost}); try fewer workers, or --workers 1 to see why"
                    )
