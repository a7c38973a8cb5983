"""Runs as segments of a dataset: what is known about each, and the logs or settings that draw it."""

import hashlib
import json
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fuselog.pipeline.altering.sources import alter, alter_all
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.output.results import RESULT_FILE, RUNS, Result, read_result, read_table
from fuselog.pipeline.output.words import is_error
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import labels_of, source_of_estimates
from fuselog.pipeline.runs.executors import states_of, version_of_code
from fuselog.pipeline.runs.experiment import Stated
from fuselog.pipeline.runs.initial_states import order_of
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner, runner_again
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, open_log
from fuselog.replay.engine.streams.sources import LogSource, MemorySource

if TYPE_CHECKING:
    import pandas as pd

Value = float | int | str
Recorded = LogSource | MemorySource
Properties = dict[str, dict[str, Value]]
# Relative difference of an error that the same code may give on another processor.
SAME = 1e-6
WORST = 20


@dataclass(frozen=True)
class Part:
    """The estimates of one run: a log of them, or what records and replays the run again.

    Attributes:
        title: name of this version, if the run has several.
        log: the log of the run, if it was kept.
        estimates: the log of the estimates, if they were kept.
        runner: object that records or opens the run and replays it, if it was not kept.
        run: the number of the run for the runner.
    """

    title: str = ""
    log: Path | None = None
    estimates: Path | None = None
    runner: Runner | None = None
    run: int = 0

    @property
    def key(self) -> str:
        """Return a hash of everything that determines the drawing."""
        files = [path for path in (self.log, self.estimates) if path is not None]
        contents: list[Any] = [self.title, [str(file) for file in files], states_of(files)]
        if self.runner is not None and self.estimates is None:
            experiment = self.runner.experiment
            logs = experiment.files[self.run : self.run + 1]
            stated = experiment.model_dump(mode="json", by_alias=True)
            contents += [stated, self.run, states_of(logs)]
        contents.append(version_of_code())
        return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()[:16]

    def load(self) -> tuple[Recorded, Recorded]:
        """Open or make the run and its estimates.

        Raises BadInput if the logs are gone and the run cannot be recorded again.
        """
        if self.estimates is not None:
            estimates = open_log(self.estimates)
            return source_of_estimates(estimates, self.log), LogSource(estimates)
        if self.log is not None:
            source = alter(LogSource(open_log(self.log)), {})
            return source, MemorySource({}, source.run or RunMetadata("unknown"), source.name)
        assert self.runner is not None
        experiment = self.runner.experiment
        found = alter_all(self.runner.obtain(first_run=self.run, runs=1), experiment.alterations or {})
        order, late = order_of(arrival_order=bool(experiment.arrival_order), late=experiment.late)
        outputs = replay_in_memory(found, experiment.estimators, order=order, late=late)
        run = found[0].run or RunMetadata("unknown", epoch_ns=found[0].epoch_ns)
        streams = {topic: rows.of_run(0) for topic, rows in outputs.items()}
        return found[0], MemorySource(streams, run, found[0].name)


@dataclass(frozen=True)
class Segment:
    """One run in a dataset.

    Attributes:
        name: the run's name, from which file names are made.
        parts: the versions of its estimates, the current one first.
        properties: what is known about the run, and about each estimator.
    """

    name: str
    parts: tuple[Part, ...]
    properties: Properties

    @property
    def key(self) -> str:
        """Return a hash of everything that determines the drawing."""
        return hashlib.sha256("".join(part.key for part in self.parts).encode()).hexdigest()[:16]

    def load(self) -> tuple[Recorded, MemorySource, dict[str, str]]:
        """Return the run, the estimates of all versions, and the version of each estimator by label.

        If an earlier version has an estimator with the same label, the version's title is appended to
        the label.
        """
        source, first = self.parts[0].load()
        versions = dict.fromkeys(labels_of(first), self.parts[0].title)
        streams = first.read([topic for topic in first.topics if topic.startswith("/estimates/")])
        for part in self.parts[1:]:
            _, other = part.load()
            for label in labels_of(other):
                names = chain(
                    [label, named := f"{label} {part.title}"], map(f"{named} {{}}".format, count(2))
                )
                name = next(each for each in names if each not in versions)
                versions[name] = part.title
                own = Renamed(other, label, name)
                streams |= own.read([*own.topics])
        run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
        return source, MemorySource(streams, run, source.name), versions


class Runs(NamedTuple):
    """The runs of a result or of a folder of logs.

    Attributes:
        path: the result or the folder.
        segments: the runs, the worst first.
        order: description of the order of the runs.
        columns: groups and names of the properties that a table shows first.
        gap_limit_s: longest gap over which the truth is interpolated.
    """

    path: Path
    segments: list[Segment]
    order: str
    columns: list[tuple[str, str]]
    gap_limit_s: float

    def chosen(self, text: str) -> list[Segment]:
        """Return the runs of `worst:N`, `all`, or of numbers or names separated by commas.

        Raises BadInput if there is no such run.
        """
        if text == "all":
            return self.segments
        word, _, count = text.partition(":")
        if word == "worst" and (not count or (count.isdecimal() and int(count))):
            return self.segments[: int(count or WORST)]
        by_name = {each.name: each for each in self.segments}
        found: dict[str, Segment] = {}
        for name in text.split(","):
            number = f"run-{int(name):04d}" if name.isdecimal() else name
            own = [each for each in by_name if each == number or each.startswith(f"{name}-")]
            if not own:
                first, last = min(by_name), max(by_name)
                raise BadInput(
                    f"--runs {text}: {self.path} has no run {name}; its {len(by_name)} runs are "
                    f"{first} to {last}; to select several, give worst:N or all"
                )
            found |= {each: by_name[each] for each in own}
        return list(found.values())


def runs_in(path: Path, gap_limit_s: float) -> Runs | None:
    """Return the runs of a result or of a folder of logs; None if the path has no separate runs.

    Raises BadInput if a result or a log cannot be read.
    """
    if not path.is_dir():
        return None
    if not (path / RESULT_FILE).is_file():
        files = sorted(path.glob("*.mcap"))
        return runs_of_logs(path, files, gap_limit_s) if files else None
    result = read_result(path)
    if "sweep" in result.settings:
        return _of_sweep(path, result)
    if not (path / RUNS).is_file() or "study" not in result.settings:
        return None
    return _of_result(path, result)


def together(given: Sequence[Runs]) -> Runs:
    """Join several results of the same runs, with the estimates of each result as a version.

    Raises BadInput if they are not the same runs.
    """
    first, *others = given
    segments = {each.name: each for each in first.segments}
    for other in others:
        title = other.path.resolve().name
        for segment in other.segments:
            own = segments.get(segment.name)
            if own is None or own.properties["run"].get("seed") != segment.properties["run"].get("seed"):
                raise BadInput(
                    f"{other.path}: its run {segment.name} is not a run of {first.path}; give results "
                    "of the same runs"
                )
            named = {
                f"{label} {title}" if label in own.properties else label: values
                for label, values in segment.properties.items()
                if label != "run"
            }
            parts = (*own.parts, *(replace(part, title=title) for part in segment.parts))
            segments[segment.name] = replace(own, parts=parts, properties=own.properties | named)
    return first._replace(segments=list(segments.values()))


def _of_result(folder: Path, result: Result) -> Runs | None:
    """Return the runs of a result; None if its runs are not numbered."""
    import pandas as pd

    from fuselog.pipeline.output.report.evidence import findings  # slow to import

    rows = read_table(folder / RUNS)
    if not {"estimator", "case", "run"} <= {*rows} or not pd.api.types.is_integer_dtype(rows["run"]):
        return None
    found = findings(result, {"runs": rows})
    runner = runner_again(folder, result)
    runs = range(runner.experiment.runs)
    names = {run: f"run-{run:04d}" for run in runs}
    parts = {name: (_part_of(folder, runner, run),) for run, name in names.items()}
    experiment = runner.experiment
    seed: dict[str, Value] = {"seed": experiment.seed} if experiment.record else {}
    about: dict[str, dict[str, Value]] = {name: {"run": run, **seed} for run, name in names.items()}
    for name, file in zip(about, experiment.files, strict=False):
        about[name]["log"] = file.name
    tables = {}
    for kind in ("times", "failures"):
        place = folder / "tables" / f"{kind}.parquet"
        if place.is_file():
            table = read_table(place)
            tables[kind] = table.assign(segment=table["run"].map(names))
    verdicts = {label: found.of[label].verdict.value for label in found.labels}
    rows = rows.assign(segment=rows["run"].map(names))
    return _sorted(folder, rows, parts, about, experiment.gap_limit_s, tables, verdicts)


def _part_of(folder: Path, runner: Runner, run: int) -> Part:
    """Return the kept logs of a run, or what records and replays it again."""
    log, estimates = (folder / kind / f"run-{run:04d}.mcap" for kind in ("logs", "estimates"))
    if estimates.is_file() and (log.is_file() or runner.experiment.logs):
        return Part(log=log if log.is_file() else None, estimates=estimates)
    return Part(runner=runner, run=run)


def _of_sweep(folder: Path, result: Result) -> Runs:
    """Return the runs at all points of a sweep."""
    from fuselog.pipeline.runs.sweeps import settings_at  # slow to import

    points = result.settings["sweep"]
    runner = runner_again(folder, result)
    entries = runner.experiment.model_dump(mode="json", by_alias=True, exclude_none=True)
    stated = Stated(result.experiment, str(folder / RESULT_FILE), entries, Path())
    rows = read_table(folder / "tables" / "sweep-runs.parquet")
    parts: dict[str, tuple[Part, ...]] = {}
    about: dict[str, dict[str, Value]] = {}
    for number, point in enumerate(points):
        there = replace(runner, experiment=stated.with_settings(settings_at(point), {}))
        for run in range(there.experiment.runs):
            name = f"point-{number:04d}-run-{run:04d}"
            parts[name] = (Part(runner=there, run=run),)
            about[name] = {"point": number, "run": run, "seed": there.experiment.seed} | {
                key: float(value) if isinstance(value, int | float) else str(value)
                for key, value in point.items()
            }
    named = [
        f"point-{point:04d}-run-{run:04d}" for point, run in zip(rows["point"], rows["run"], strict=True)
    ]
    rows = rows.drop(columns="point").assign(segment=named)
    return _sorted(folder, rows, parts, about, runner.experiment.gap_limit_s)


def runs_of_logs(path: Path, files: Sequence[Path], gap_limit_s: float) -> Runs:
    """Return a run for each log, with the estimates in all estimates logs of it as versions.

    Args:
        path: the path next to which the drawings are kept.
        files: logs and estimates logs.
        gap_limit_s: longest gap over which the truth is interpolated.

    Raises BadInput if a log cannot be read, or the log of estimates is missing.
    """
    from fuselog.replay.judging.tables import joined  # slow to import

    parts: dict[str, list[Part]] = {}
    logs: dict[str, Path] = {}
    for file in files:
        log = open_log(file)
        if "log" in (log.run.notes if log.run else {}):
            source = source_of_estimates(log).log.path
            own = parts.setdefault(source.stem, [])
            title = file.name.removesuffix(".mcap").removesuffix(".estimates")
            own.append(Part(title=title, log=source, estimates=file))
        else:
            logs[file.stem] = file
    for name, file in logs.items():
        parts.setdefault(name, [Part(log=file, estimates=file if labels_of(open_log(file)) else None)])
    segments = [
        Segment(name, tuple(sorted(own, key=lambda part: (part.title != name, part.title))), {})
        for name, own in parts.items()
    ]
    rows = joined(_judged(segment, gap_limit_s) for segment in segments)
    about: dict[str, dict[str, Value]] = {
        each.name: {"log": str(each.parts[0].log)} for each in segments
    }
    versions = {each.name: each.parts for each in segments}
    return _sorted(path, rows, versions, about, gap_limit_s)


def _judged(segment: Segment, gap_limit_s: float) -> "pd.DataFrame":
    """Judge the estimates of a segment: a row per estimator and case."""
    source, estimates, _ = segment.load()
    if not estimates.topics:
        import pandas as pd

        return pd.DataFrame()
    judge = judge_logs([estimates], [source], {}, gap_limit_s=gap_limit_s)
    return judge.runs_table.assign(segment=segment.name)


def _sorted(
    path: Path,
    rows: "pd.DataFrame",
    parts: Mapping[str, tuple[Part, ...]],
    about: Mapping[str, dict[str, Value]],
    gap_limit_s: float,
    tables: Mapping[str, "pd.DataFrame"] | None = None,
    verdicts: Mapping[str, str] | None = None,
) -> Runs:
    """Combine what is known about runs, and sort them: failed ones, then by error, the worst first.

    Runs are sorted by the error of the estimator that has the smallest error over all runs.
    """
    tables, verdicts = tables or {}, verdicts or {}
    quantity = next((str(key) for key in rows if is_error(str(key))), "")
    properties: dict[str, Properties] = {name: {"run": dict(about.get(name, {}))} for name in parts}
    several = len(rows) > 0 and len({*rows["case"]}) > 1
    for row in [*rows.to_dict("records"), *_worst_spans(tables.get("times"), quantity)]:
        label = str(row["estimator"])
        group = properties[row["segment"]].setdefault(f"{label} {row['case']}" if several else label, {})
        group |= {
            str(key): float(value)
            for key, value in row.items()
            if isinstance(value, int | float) and key != "run" and not math.isnan(value)
        }
        if label in verdicts:
            group["verdict"] = verdicts[label]
    failed = _failures(rows, parts, tables.get("failures"))
    order, error = "in the order of their names", dict.fromkeys(parts, 0.0)
    columns = [("run", key) for key in ("rank", *next(iter(about.values()), {}))]
    if quantity:
        by_run = (rows[quantity] ** 2).groupby([rows["estimator"], rows["segment"]]).mean()
        best = str(by_run.groupby(level=0).mean().idxmin())
        error |= {str(name): float(of) for name, of in by_run[best].dropna().items()}
        order = f"the worst first, by {quantity} of {best}"
        groups = dict.fromkeys(group for own in properties.values() for group in own if group != "run")
        firsts = sorted(groups, key=lambda group: group.partition(" ")[0] != best)
        columns += [(group, quantity) for group in firsts]
    names = sorted(parts, key=lambda name: (name not in failed, -error[name], name))
    for rank, name in enumerate(names, start=1):
        properties[name]["run"]["rank"] = rank
    for name, sentence in failed.items():
        properties[name]["run"]["failure"] = sentence
    if failed:
        columns.append(("run", "failure"))
    segments = [Segment(name, parts[name], properties[name]) for name in names]
    return Runs(path, segments, order, columns, gap_limit_s)


def _worst_spans(times: "pd.DataFrame | None", quantity: str) -> list[dict[Hashable, Any]]:
    """Return a row per estimator, case and run: the end of the span with the largest NEES or error."""
    if times is None or times.empty:
        return []
    by = next((key for key in ("nees", quantity) if key in times and times[key].notna().any()), None)
    if by is None:
        return []
    known = times.dropna(subset=[by])
    worst = known.loc[known.groupby(["estimator", "case", "segment"], sort=False)[by].idxmax()]
    kept = worst[["estimator", "case", "segment", "until_s"]]
    return kept.rename(columns={"until_s": "worst_by_s"}).to_dict("records")


def _failures(
    rows: "pd.DataFrame", parts: Mapping[str, object], failures: "pd.DataFrame | None"
) -> dict[str, str]:
    """Return by run why estimators failed, or which estimators have no errors."""
    found: dict[str, list[str]] = {}
    if len(rows):
        for label, own in rows.groupby("estimator", sort=False):
            for name in parts.keys() - set(own["segment"]):
                found.setdefault(name, []).append(f"{label} has no errors")
    if failures is not None and len(failures):
        for segment, sentences in failures.groupby("segment", sort=False)["failure"]:
            found[str(segment)] = list(sentences)
    return {name: "; ".join(sentences) for name, sentences in found.items()}
