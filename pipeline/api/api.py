"""Python functions that do for logs, recordings, experiments and lists what the commands do.

All functions raise BadInput with the same messages as the commands. docs/python.md shows how to use
them. The replay is in `fuselog.pipeline.api.replays`.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fuselog.pipeline.api.catalog import LISTS, Entries, Entry, entry_or_why
from fuselog.pipeline.api.lists import listed
from fuselog.pipeline.output.outputs import LOG, check_files, check_folder
from fuselog.pipeline.output.results import Result, read_table
from fuselog.pipeline.output.showing import Showing, Shown, shown_metrics
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.output.terminal import PrintedTable
from fuselog.pipeline.runs.ensemble import RUNS_AT_ONCE, Progress, no_progress
from fuselog.pipeline.runs.executors import PoolFactory, pool_for, started
from fuselog.pipeline.runs.experiment import (
    Experiment,
    Stated,
    read_experiment,
    require_campaign,
    run_experiment,
)
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.pipeline.runs.sweeps import Over, Sampling, over_of, points_of, run_sweep, settings_at
from fuselog.recorders.errors import BadInput, UnknownName, choices, without_warnings_of_numbers
from fuselog.recorders.log import Stream, write_log
from fuselog.recorders.parameters import merge
from fuselog.recorders.recording import import_run, record_run
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.foreign.naming import allowed

if TYPE_CHECKING:
    import pandas as pd


@without_warnings_of_numbers()
def record(scenario: str | Path, /, *, seed: int = 0, run: int = 0, **parameters: Any) -> MemorySource:
    """Record a run of a scenario in memory; the recording can be replayed, or written to a log.

    Args:
        scenario: a name from `scenarios`, or a TOML file.
        seed: seed of the random numbers.
        run: number of the run; scenario, parameters, seed and run determine the streams.
        parameters: values of parameters that differ from the scenario's defaults.

    Returns:
        The recording, which maps every topic to its stream.

    Raises BadInput for an unknown scenario or parameter.

    >>> record("landmarks", seed=7, duration_s=2.0)["/robot1/odometry"].topic
    '/robot1/odometry'
    """
    recorder, values, _ = load_scenario(str(scenario))
    return memory_source(*record_run(recorder, merge(values, parameters), seed, run))


@without_warnings_of_numbers()
def import_(importer: str, path: str | Path, /, **parameters: Any) -> MemorySource:
    """Import real data, in the format in which they were published, into memory.

    Args:
        importer: a registered name, such as "mrclam"; `fuselog scenarios` lists the names.
        path: the file or folder to read.
        parameters: parameters of the importer.

    Returns:
        The recording, which can be read and replayed like a log.

    Raises BadInput for an unknown importer or parameter, or if the importer cannot read the data.
    """
    return memory_source(*import_run(importer, located(path), parameters))


@without_warnings_of_numbers()
def write(path: str | Path, streams: MemorySource | Iterable[Stream]) -> None:
    """Write a recording or your own streams as a log; the file appears only when it is complete.

    Args:
        path: the MCAP file; an existing log that fuselog wrote is replaced.
        streams: a recording, or streams, one per topic.

    Raises BadInput if a stream violates its schema, or if the existing file is not a log that fuselog
    wrote.
    """
    check_files([(Path(path), LOG)], {})
    if isinstance(streams, MemorySource):
        write_log(path, streams.streams.values(), streams.run)
        return
    given = list(streams)
    if not all(isinstance(each, Stream) for each in given):
        raise BadInput(
            f"{path}: these are no streams; give streams made with make_stream, or a recording"
        )
    write_log(path, given)


@dataclass(frozen=True, repr=False)
class ResultFolder(Showing):
    """A result folder and the content of its result.json.

    Attributes:
        folder: the path of the folder.
        result: the content of result.json: metrics, tables, claims.
    """

    folder: Path
    result: Result

    @property
    def _shown(self) -> Shown:
        verdicts = Counter(claim.verdict for claim in self.result.claims)
        counted = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
        sentences = [each.sentence for each in self.result.alarms[:1]]
        sentences += [f"claims: {counted}"] if counted else []
        title = f"Result of {self.result.experiment} in {self.folder}"
        return shown_metrics(title, sentences, self.result.metrics, self.result.bounds)

    @property
    def metrics(self) -> "pd.DataFrame":
        """Return a table with a row per metric: estimator, quantity, case, value."""
        return summary_table(self.result.metrics)

    @property
    def claims(self) -> "pd.DataFrame":
        """Return a table with a row per claim: statement, measured value, verdict and reason."""
        import pandas as pd  # slow to import

        return pd.DataFrame([vars(claim) for claim in self.result.claims])

    @cached_property
    def tables(self) -> "dict[str, pd.DataFrame]":
        """Read all tables, by name."""
        paths = sorted((self.folder / "tables").glob("*.parquet"))
        return {path.stem: read_table(path) for path in paths}


@without_warnings_of_numbers()
def run(
    experiment: str | Path | Stated,
    /,
    *,
    runs: int | None = None,
    seed: int | None = None,
    data: str | Path | None = None,
    out: str | Path | None = None,
    logs: int = 20,
    errors: bool = False,
    workers: int | None = 1,
    scheduler: str | None = None,
    executor: Executor | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    progress: Progress = no_progress,
) -> ResultFolder:
    """Run an experiment and write its result folder.

    Args:
        experiment: a name from `experiments`, a TOML file, or an experiment that was read.
        runs: number of runs; by default the experiment's.
        seed: by default the experiment's.
        data: the real data, if the experiment imports any.
        out: the result folder; by default out/ and the experiment's name.
        logs: number of runs whose logs are kept.
        errors: whether all individual errors are kept.
        workers: number of processes that share the runs; a script that uses more than one must guard its
            own code with `if __name__ == "__main__":`, because the processes import it. None uses all
            cores if that saves time.
        scheduler: a Dask scheduler whose workers share the runs, or `local:N`.
        executor: any other executor whose workers can read this machine's files.
        set: entries of the experiment, parameters of its scenario, or parameters of its estimators by
            label: `{"duration_s": 20, "ekf": {"gate_probability": 0.99}}`.
        progress: function that wraps iterables to report progress.

    Returns:
        The result folder, with metrics, claims and tables.

    Raises BadInput if the experiment cannot be run, or if the folder exists and is not a result.
    """
    stated = _stated(experiment)
    found = stated.with_settings(allowed(set or {}), _given(runs=runs, seed=seed))
    if workers not in (None, 1) or scheduler is not None or executor is not None:
        require_campaign(found, "leave out workers, scheduler and executor")
    folder = Path("out", stated.name) if out is None else Path(out)
    place = None if data is None else Path(data)
    check_folder(folder, {"input": [*_inputs(stated, found), *filter(None, [place])]})
    with _pool(workers, scheduler, executor, [found]) as open_pool:
        result = run_experiment(
            stated.name,
            found,
            folder,
            data=place,
            logs=logs,
            errors=errors,
            open_pool=open_pool,
            progress=progress,
        )
    return ResultFolder(folder, result)


@without_warnings_of_numbers()
def sweep(
    experiment: str | Path | Stated,
    over: Mapping[str, Iterable[Any]] | Sequence[Over],
    /,
    *,
    runs: int | None = None,
    seed: int | None = None,
    samples: int | None = None,
    sampling: Sampling = "sobol",
    out: str | Path | None = None,
    workers: int | None = 1,
    scheduler: str | None = None,
    executor: Executor | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    progress: Progress = no_progress,
) -> ResultFolder:
    """Run an experiment at all points of a grid and write a result folder.

    Args:
        experiment: a name from `experiments`, a TOML file, or an experiment that was read.
        over: values by key, such as `{"ekf.sigma_range_m": np.geomspace(0.05, 0.8, 9), "robots": [1,
            2]}`, or ranges, as returned by `parse_over`.
        runs: number of runs at each point; by default the experiment's.
        seed: by default the experiment's.
        samples: number of points to sample instead of using the whole grid.
        sampling: "sobol" or "random".
        out: the result folder; by default out/ and the experiment's name with -sweep.
        workers: as for `run`.
        scheduler: as for `run`.
        executor: as for `run`.
        set: as for `run`.
        progress: as for `run`.

    Returns:
        The result folder, whose table `sweep` has a row per point, estimator and metric.

    Raises BadInput if the experiment cannot be run, or if the folder exists and is not a result.
    """
    stated, given = _stated(experiment), _given(runs=runs, seed=seed)
    own = allowed(set or {})
    if isinstance(over, Mapping):
        over = [over_of(key, np.asarray(values).tolist()) for key, values in over.items()]
    points = points_of(over, samples, sampling, stated.with_settings(own, given).seed)
    found = [stated.with_settings(merge(own, allowed(settings_at(point))), given) for point in points]
    folder = Path("out", f"{stated.name}-sweep") if out is None else Path(out)
    check_folder(folder, {"input": _inputs(stated, found[0])})
    with _pool(workers, scheduler, executor, found) as open_pool:
        result = run_sweep(
            stated.name, over, points, found, folder, open_pool=open_pool, progress=progress
        )
    return ResultFolder(folder, result)


def _stated(experiment: str | Path | Stated) -> Stated:
    return experiment if isinstance(experiment, Stated) else read_experiment(str(experiment))


def _given(**entries: int | None) -> dict[str, int]:
    return {name: value for name, value in entries.items() if value is not None}


def _inputs(stated: Stated, experiment: Experiment) -> list[Path]:
    """List the files that define an experiment: its logs, its own file, its scenario."""
    scenario = "" if experiment.record is None else experiment.record.scenario
    tables = [Path(scenario)] if scenario.endswith(".toml") else []
    return [*experiment.files, *stated.files, *tables]


def _pool(
    workers: int | None,
    scheduler: str | None,
    executor: Executor | None,
    experiments: Sequence[Experiment],
) -> AbstractContextManager[PoolFactory]:
    """Choose the workers for experiments, and start them if there is more than one cell.

    If there is a scheduler, the default of one process is ignored.
    """
    if scheduler is not None and workers == 1:
        workers = None
    runs = sum(len(each.files) or each.runs for each in experiments)
    open_pool = pool_for(workers, scheduler, runs, executor)
    is_one_cell = len(experiments) == 1 and runs <= RUNS_AT_ONCE
    return nullcontext(open_pool) if is_one_cell else started(open_pool)


class Catalog(Mapping[str, Entry]):
    """All entries of a kind by name; for an unknown name, `UnknownName` suggests similar ones."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    @cached_property
    def _entries(self) -> Entries:
        return LISTS[self._kind]()

    def __getitem__(self, name: str) -> Entry:
        if name not in self._entries:
            raise UnknownName(f"no {self._kind} '{name}'; {choices(name, self._entries)}")
        return entry_or_why(name, self._entries[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        width = max(map(len, self), default=0)
        return "\n".join(f"{name:{width}}  {what}" for name, what in self._listed().items())

    def _repr_html_(self) -> str:
        rows = list(self._listed().items())
        return Shown(f"{self._kind}s", tables=[PrintedTable("", ["name", "what"], rows)]).html

    def _listed(self) -> dict[str, Any]:
        return listed(f"{self._kind}s")


scenarios = Catalog("scenario")
estimators = Catalog("estimator")
models = Catalog("model")
metrics = Catalog("metric")
experiments = Catalog("experiment")
