"""Experiments in TOML files, which define a scenario (or data, or logs), estimators and metrics."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, NonNegativeFloat, PositiveInt, field_validator, model_validator

from fuselog.pipeline.altering.changes import by_topic, is_of_topic
from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.output.claims import StatedClaim, decide, require_names, require_recordings
from fuselog.pipeline.output.results import Outcome, Result, plain, result_folder, write_outcome
from fuselog.pipeline.runs.checkpoints import Checkpoints, checkpoints_of
from fuselog.pipeline.runs.ensemble import Progress, no_progress
from fuselog.pipeline.runs.executors import PoolFactory
from fuselog.pipeline.runs.inputs import Import, Logs, Record, Recording, holding, load_scenario, shipped
from fuselog.pipeline.runs.settings import named_by, parameters_by_label
from fuselog.pipeline.selecting.catalog import is_catalog
from fuselog.pipeline.selecting.selection import of_catalog, table_of
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import open_log
from fuselog.recorders.parameters import Parameters, build, merge
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.recording import Recorder
from fuselog.recorders.registry import foreign_code, load
from fuselog.recorders.remote.paths import RemotePath, located
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.replaying.late import parse_late
from fuselog.replay.engine.streams.linting import of_first_messages
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.foreign.naming import allowed_in
from fuselog.replay.judging.metrics.measuring import find_metrics


class Experiment(Parameters):
    """One experiment as described by its TOML file.

    The runs are recorded from a scenario, imported, or read from existing logs.

    Attributes:
        title: a description in one line.
        text: more text for the report, in Markdown.
        study: name of the study that runs the experiment.
        seed: seed of the recorded runs.
        runs: number of recorded runs.
        record: what to simulate.
        import_: what to import.
        logs: logs to replay.
        estimators: parameters by label. `kind` names the estimator if the label is not its name. `like`
            names another label, whose kind and parameters apply unless they are set here.
        alterations: changes of topics before the replay, as for `--set /TOPIC.WHAT`.
        metrics: names of the metrics; by default all registered ones.
        gap_limit_s: longest gap over which truth is interpolated.
        arrival_order: whether messages are processed in order of arrival.
        late: how out-of-sequence measurements are handled, as for `--late` of `fuselog replay`.
        options: options of the study.
        recordings: the recordings that claims are about, by name, if the runs are not simulated.
        claims: claims about the resulting metrics.
        claims_of: name of another experiment whose claims are decided first.
    """

    title: str
    text: str | None = None
    study: str = "localization"
    seed: Annotated[int, Field(ge=0)] = 0
    runs: PositiveInt = 1
    record: Record | None = None
    import_: Import | None = Field(None, alias="import")
    logs: Logs | None = None
    estimators: dict[str, dict[str, Any]] = {}
    alterations: dict[str, Any] | None = None
    metrics: list[str] = []
    gap_limit_s: NonNegativeFloat = 0.2
    arrival_order: bool | None = None
    late: str | None = None
    options: dict[str, Any] = {}
    # claims do not affect the run, and a result contains them with their verdicts
    recordings: Annotated[dict[str, Recording], Field(exclude=True)] = {}
    claims: Annotated[list[StatedClaim], Field(exclude=True)] = []
    claims_of: Annotated[str, Field(exclude=True)] = ""

    @field_validator("estimators")
    @classmethod
    def _are_spelt_out(cls, stated: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        spelt = {label: _spelt_out(label, stated) for label in stated}
        for label, values in stated.items():
            if "like" in values and spelt[label]["kind"] == label:
                del spelt[label]["kind"]  # a label that is the name of an estimator needs no `kind`
        return spelt

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        if sum(each is not None for each in (self.import_, self.record, self.logs)) > 1:
            raise ValueError("give exactly one of [record], [import] and [logs]")
        if (self.import_ or self.logs) and (self.runs, self.seed) != (1, 0):
            raise ValueError(
                "imported data and logs have no seed and a fixed number of runs; leave out seed and runs"
            )
        return self

    @model_validator(mode="after")
    def _has_an_order(self) -> Self:
        if self.late is not None:
            parse_late(self.late, arrival_order=bool(self.arrival_order))
        if (self.arrival_order or self.alterations) and self.study != "localization":
            which = "arrival_order, late and settings of topics"
            raise ValueError(f"study {self.study} replays in the order of the stamps; leave out {which}")
        return self

    @model_validator(mode="after")
    def _has_the_recordings(self) -> Self:
        if self.recordings and not (self.import_ or self.logs):
            raise ValueError("[recordings] applies to imported data and logs; leave it out")
        return self

    @property
    def files(self) -> list[Path]:
        """Return the logs that are replayed."""
        return [located(file) for file in self.logs.files] if self.logs else []

    def with_absolute_files(self) -> "Experiment":
        """Return the experiment with absolute paths of logs."""
        if not self.logs:
            return self
        return self.model_copy(
            update={"logs": Logs(files=[str(each.absolute()) for each in self.files])}
        )


def _spelt_out(label: str, stated: Mapping[str, dict[str, Any]], *above: str) -> dict[str, Any]:
    """Return an estimator's parameters, completed with those of the estimator named by `like`."""
    values = stated[label]
    if "like" not in values:
        return values
    other, own = values["like"], {name: of for name, of in values.items() if name != "like"}
    if other not in stated or other in (label, *above):
        raise ValueError(
            f"estimator {label} has like = '{other}'; name another estimator of the experiment"
        )
    return merge({"kind": other, **_spelt_out(other, stated, label, *above)}, own)


@dataclass(frozen=True)
class Setting:
    """Where and how an experiment runs.

    Attributes:
        folder: folder to which all files are written.
        place: the final path of the folder.
        data: the data to import.
        logs: number of runs whose logs are kept.
        draws: whether the first run's timeline is drawn.
        errors: whether all individual errors are kept.
        options: options of the study, of the type that the study defines.
        progress: function that reports progress.
        open_pool: function that opens the workers for the cells; by default this process.
        checkpoints: storage of finished cells until all are done.
    """

    folder: Path
    place: Path
    data: Path | None = None
    logs: int = 20
    draws: bool = True
    errors: bool = False
    options: Any = None
    progress: Progress = no_progress
    open_pool: PoolFactory | None = None
    checkpoints: Checkpoints | None = None


@dataclass(frozen=True)
class Study:
    """A registered study, which runs an experiment.

    Attributes:
        summary: a description in one line.
        run: (experiment, setting) -> its outcome; logs and timeline go to the setting's folder.
        options: the type of the experiment's `options`.
        is_campaign: whether the study replays only through `fuselog.pipeline.runs.campaigns`, so that
            the runs can be distributed.
        runs: what the option for the number of runs counts, in words; empty if the study makes no runs.
    """

    summary: str
    run: Callable[[Experiment, Setting], Outcome]
    options: type[Parameters] = Parameters
    is_campaign: bool = False
    runs: str = "recorded runs"


class Stated(NamedTuple):
    """An experiment before settings are applied.

    Attributes:
        name: its name.
        source: the file from which the experiment was read, for messages.
        values: the entries of the file.
        folder: the folder to which the paths of the experiment's logs are relative.
        files: other files from which the experiment was read.
    """

    name: str
    source: str
    values: Mapping[str, Any]
    folder: Path
    files: Sequence[Path] = ()

    @property
    def labels(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the labels of the experiment's estimators, with the estimators' settings."""
        return self.with_settings({}, {}).estimators

    @property
    def _values(self) -> dict[str, Any]:
        """Return the experiment's entries, and permit the programs that they name."""
        stated = self.values.get("estimators")
        own = {"estimators": allowed_in(stated, self.folder)} if isinstance(stated, Mapping) else {}
        return {**self.values, **own}

    @property
    def _as_written(self) -> Experiment:
        return build(Experiment, self._values, f"experiment {self.source}")

    def with_settings(self, settings: Mapping[str, Any], over: Mapping[str, Any]) -> Experiment:
        """Build the experiment with settings, and then apply `over`; see `load_experiment`."""
        where = f"experiment {self.source}"
        own = _settings_of_experiment(self._as_written, settings)
        experiment = build(Experiment, {**merge(self._values, own), **over}, where)
        if experiment.claims_of:
            shared = read_experiment(experiment.claims_of)._as_written.claims
            experiment = experiment.model_copy(update={"claims": [*shared, *experiment.claims]})
        if not (experiment.import_ or experiment.logs):
            claims = [each.decided_from(self._as_written.runs) for each in experiment.claims]
            experiment = experiment.model_copy(update={"claims": claims})
        if experiment.logs is None:
            return experiment
        logs = _logs_of(experiment.logs, self.folder, where)
        return experiment.model_copy(update={"logs": logs})


def load_experiment(
    name: str, settings: Mapping[str, Any], over: Mapping[str, Any]
) -> tuple[str, Experiment]:
    """Load an experiment by its shipped name or TOML file, and apply settings and then `over`.

    A setting applies to the entry of the experiment or to the estimator that its first word names.
    Otherwise, a setting applies to a parameter of the scenario or importer or, if these have no such
    parameter, to all estimators that have it: `gap_limit_s=1`, `ekf.gate_probability=1`, `robots=2`,
    `gate_probability=1`, `/fix.delay_s=0.3`.
    """
    stated = read_experiment(name)
    return stated.name, stated.with_settings(settings, over)


def read_experiment(name: str) -> Stated:
    """Read an experiment by its shipped name or TOML file, without settings."""
    known = shipped("experiments")
    if not name.endswith(".toml") and name not in known:
        raise BadInput(f"no experiment '{name}', and it is not a .toml file; {choices(name, known)}")
    path = known.get(name, Path(name))
    return Stated(path.stem, name, read_toml(path), path.parent, () if name in known else (path,))


def is_of_logs(name: str) -> bool:
    """Test whether a name is that of a log, a catalog or a folder of logs, not of an experiment."""
    path = located(name)
    is_folder = path.is_dir() and name not in shipped("experiments")
    return path.suffix == ".mcap" or is_catalog(path) or is_folder


def experiment_of_logs(
    logs: Sequence[Path], labels: Sequence[str], unreadable: Mapping[Path, str] | None = None
) -> Stated:
    """Make the experiment that replays logs; raise BadInput if no estimator is named."""
    if not labels:
        raise BadInput(f"{logs[0]}: name the estimators to replay, such as -e ekf")
    title = logs[0].stem if len(logs) == 1 else f"{len(logs)} logs"
    of_logs: dict[str, Any] = {"files": [str(log) for log in logs]}
    if unreadable:
        of_logs["unreadable"] = {str(log): why for log, why in unreadable.items()}
    values = {
        "title": title,
        "logs": of_logs,
        "estimators": named_by(labels),
    }
    return Stated(title, str(logs[0]), values, Path())


def _logs_of(stated: Logs, folder: Path, where: str) -> Logs:
    """Find the logs that are named by files, patterns and a catalog."""
    files = _found(stated.files, folder, where)
    if stated.catalog is None:
        if stated.where is not None:
            raise BadInput(f"{where}: where = {stated.where!r} selects from a catalog; name it too")
        return stated.model_copy(update={"files": files})
    catalog = Path(os.path.normpath(folder / stated.catalog))
    found = of_catalog(catalog, stated.where)
    if not files:
        found.require_readable(catalog)
    files = list(dict.fromkeys([*files, *map(str, found.logs)]))
    why = {str(log): problem for log, problem in found.unreadable.items()}
    return Logs(files=files, unreadable=why or None)


def _found(patterns: Sequence[str], folder: Path, where: str) -> list[str]:
    """Find the files that match patterns, without duplicates; raise BadInput if a pattern has none."""
    files: dict[str, None] = {}
    for pattern in patterns:
        place = located(pattern)
        if not isinstance(place, RemotePath):
            place = Path(os.path.normpath(folder / pattern))
        root = Path(place.anchor)
        if place.is_file():
            found = [place]
        elif isinstance(place, RemotePath):
            found = sorted(place.glob("*.mcap"))
        else:
            found = sorted(root.glob(str(place.relative_to(root))))
        logs = [str(each) for each in found if len(found) == 1 or not each.match("*.estimates.mcap")]
        if not logs:
            raise BadInput(f"{where}: no log matches {place}; give files, or patterns such as *.mcap")
        files |= dict.fromkeys(logs)
    return list(files)


def given_files(experiment: Experiment, data: Path | None) -> list[Path]:
    """List the files that an experiment reads: its data, the files in its data folder, or its logs."""
    if data is None or experiment.logs is not None:
        return experiment.files
    return sorted(path for path in data.rglob("*") if path.is_file()) if data.is_dir() else [data]


def _settings_of_experiment(experiment: Experiment, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Assign settings to the parts of an experiment; raise BadInput for an unknown setting."""
    entries = {each.alias or name for name, each in Experiment.model_fields.items()}
    part, names = _parameters_of_source(experiment)
    own = parameters_by_label(experiment.estimators) if settings else {}
    placed: dict[str, Any] = {}
    for key, value in by_topic(settings).items():
        if key in entries:
            place: dict[str, Any] = {key: value}
        elif is_of_topic(key) and not isinstance(value, Mapping):
            place = {"alterations": {key: value}}
        elif key in experiment.estimators:
            place = {"estimators": {key: value}}
        elif key in names:
            place = {part: {"parameters": {key: value}}}
        elif takers := [
            label for label, known in own.items() if ("of_topics" if is_of_topic(key) else key) in known
        ]:
            of_all = {"estimators": {label: {key: value} for label in takers}}
            placed = merge(of_all, placed)  # a setting of one estimator takes precedence
            continue
        else:
            known = sorted(names.union(entries, own, *own.values()))
            raise BadInput(
                f"--set {key}: not an entry of the experiment, a parameter of what it records, an "
                f"estimator, or a parameter of its estimators; {choices(key, known)}"
            )
        placed = merge(placed, place)
    return placed


def _parameters_of_source(experiment: Experiment) -> tuple[str, set[str]]:
    """Return the name of the table that describes the source of the data, and its parameters."""
    if experiment.import_:
        part, recorder = "import", experiment.import_.source
    elif experiment.record:
        part, recorder = "record", load_scenario(experiment.record.scenario)[0]
    else:
        return "", set()
    fields = load("recorders", recorder, Recorder).parameters.model_fields
    return part, {field.alias or name for name, field in fields.items()}


def numbers_of(experiment: Experiment, options: Parameters) -> dict[str, float]:
    """Return the numbers that claims may name: the number of runs, and numeric options of the study."""
    return {"runs": experiment.runs, **{name: of for name, of in options if isinstance(of, int | float)}}


def require_campaign(experiment: Experiment, remedy: str) -> None:
    """Raise BadInput if the experiment's study replays all runs together in one process."""
    study: Study = load("studies", experiment.study, Study)
    if not study.is_campaign:
        raise BadInput(
            f"experiment '{experiment.title}': the study {experiment.study} replays all runs "
            f"together, in one process; {remedy}"
        )


def run_experiment(
    name: str,
    experiment: Experiment,
    folder: Path,
    *,
    data: Path | None = None,
    logs: int = 20,
    errors: bool = False,
    open_pool: PoolFactory | None = None,
    progress: Progress = no_progress,
) -> Result:
    """Run an experiment and write its folder, which appears only when complete; return result.json."""
    if experiment.import_ and data is None:
        raise BadInput(f"experiment {name} needs real data; give the folder with --data")
    if data is not None and experiment.record:
        raise BadInput(f"experiment {name} imports nothing; leave out --data")
    if experiment.logs is not None:
        if data is not None:
            place = str(data / "*.mcap") if data.is_dir() else str(data)
            files = _found([place], Path(), f"experiment {name}, --data {data}")
            experiment = experiment.model_copy(update={"logs": Logs(files=files)})
        if not experiment.files:
            raise BadInput(f"experiment {name} replays logs; name them in [logs], or with --data")
        experiment = experiment.model_copy(update={"runs": len(experiment.files)})
    study: Study = load("studies", experiment.study, Study)
    if not study.runs and experiment.runs != 1:
        raise BadInput(f"experiment {name}: study {experiment.study} makes no runs; leave out --runs")
    options = build(study.options, experiment.options, f"options of study {experiment.study}")
    numbers = numbers_of(experiment, options)
    require_names(experiment.claims, numbers, f"experiment {name}")
    require_recordings(experiment.claims, experiment.recordings, f"experiment {name}")
    configured = {label: configure(label, values) for label, values in experiment.estimators.items()}
    find_metrics(experiment.metrics)
    recordings = holding(experiment.recordings, given_files(experiment, data), f"experiment {name}")
    with (
        checkpoints_of(folder) as checkpoints,
        result_folder(folder) as part,
        foreign_code(f"study {experiment.study}"),
        warnings.catch_warnings(),
    ):
        # if all runs failed, the mean is null in the results, which needs no warning
        warnings.filterwarnings("ignore", "Mean of empty slice|All-NaN", RuntimeWarning)
        setting = Setting(
            folder=part,
            place=folder,
            data=data,
            logs=logs,
            errors=errors,
            options=options,
            progress=progress,
            open_pool=open_pool,
            checkpoints=checkpoints,
        )
        outcome = study.run(experiment, setting)
        if experiment.logs and experiment.logs.unreadable:
            outcome.tables["unreadable"] = table_of(experiment.logs.unreadable)
        metrics = plain(outcome.metrics)
        outcome.claims += decide(experiment.claims, metrics, outcome.intervals, numbers, recordings)
        settings = experiment.model_dump(mode="json", by_alias=True, exclude_none=True)
        settings |= {} if data is None else {"data": str(data)}
        settings["parameters"] = outcome.parameters or {
            label: parameters.model_dump(mode="json", exclude_none=True)
            for label, (_, parameters) in configured.items()
        }
        if experiment.logs is not None:
            alterations = experiment.alterations or {}
            sources = [alter(LogSource(open_log(each)), alterations) for each in experiment.files]
            of_logs = of_first_messages(sources)
            settings |= {"notes": of_logs} if of_logs else {}
        return write_outcome(part, name, settings, outcome)
