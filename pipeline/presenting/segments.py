"""Lists of the runs of results, sweeps, comparisons and logs, with what is known about each run."""

import math
import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fuselog.pipeline.output.results import RESULT_FILE, RUNS, Result, read_result, read_table
from fuselog.pipeline.output.words import is_error
from fuselog.pipeline.presenting.drawing import open_run, runner_of, worst_times
from fuselog.pipeline.presenting.runs import (
    WITHOUT_RUNS,
    WORST_AT,
    Part,
    Runs,
    Segment,
    Value,
    files_of,
    group_of,
    hash_of,
)
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import labels_of, source_of_estimates
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log

if TYPE_CHECKING:
    import pandas as pd


def list_runs(paths: Sequence[Path], gap_limit_s: float, *, recover: bool = False) -> Runs | None:
    """Return the runs of a result, of a folder of logs, or of several of them; None if there are none.

    Several results of the same runs are versions of their estimates, as are several estimates logs of
    one log.

    Args:
        paths: results, folders of logs, or logs and estimates logs.
        gap_limit_s: longest gap over which the truth of logs is interpolated.
        recover: whether to read the intact part of damaged logs.

    Raises BadInput if a result or a log cannot be read, if one of several paths has no separate runs, or
    if they are not of the same runs.
    """
    if len(paths) > 1 and all(path.suffix == ".mcap" for path in paths):
        runs = _of_logs(paths[0], paths, gap_limit_s, recover=recover)
    else:
        found = {path: _runs_in(path, gap_limit_s, recover=recover) for path in paths}
        if len(paths) > 1 and None in found.values():
            without = next(path for path, own in found.items() if own is None)
            raise BadInput(WITHOUT_RUNS.format(without))
        given = [own for own in found.values() if own is not None]
        if not given:
            return None
        runs = _together(given)
    return runs._replace(given=files_of(paths))


def _runs_in(path: Path, gap_limit_s: float, *, recover: bool) -> Runs | None:
    if not path.is_dir():
        return None
    if not (path / RESULT_FILE).is_file():
        files = files_of([path])
        return _of_logs(path, files, gap_limit_s, recover=recover) if files else None
    result = read_result(path)
    if "sweep" in result.settings:
        return _of_sweep(path, result)
    if not (path / RUNS).is_file() or "study" not in result.settings:
        return None
    return _of_result(path, result)


def _together(given: Sequence[Runs]) -> Runs:
    """Join lists of the same runs, with the estimates of each list as a version.

    Raises BadInput if the results are not of the same runs.
    """
    first, *others = given
    _, *titles = _distinct([each.path for each in given])
    segments = {each.name: each for each in first.segments}
    for other, title in zip(others, titles, strict=True):
        for segment in other.segments:
            own = segments.get(segment.name)
            if own is None or own.of != segment.of:
                raise BadInput(
                    f"{other.path}: its run {segment.name} is not a run of {first.path}; give results "
                    "of the same runs"
                )
            properties = dict(own.properties)
            for group, values in segment.properties.items():
                label, _, case = group.partition(" ")
                if group != "run":
                    named = group_of(f"{label} {title}", case)
                    properties[named if group in properties else group] = values
            parts = (*own.parts, *(replace(part, title=title) for part in segment.parts))
            segments[segment.name] = replace(own, parts=parts, properties=properties)
    return first._replace(segments=list(segments.values()))


def _distinct(paths: Sequence[Path]) -> list[str]:
    """Return the names of paths, preceded by the names of their parent folders if names are equal."""
    places = [str(path.absolute()).removesuffix(".mcap").removesuffix(".estimates") for path in paths]
    parts = [Path(os.path.normpath(place)).parts for place in places]
    lengths = range(1, max(map(len, parts), default=0) + 1)
    named = (["-".join(each[-length:]) for each in parts] for length in lengths)
    return next((names for names in named if len({*names}) == len({*parts})), [])


def _of_result(folder: Path, result: Result) -> Runs | None:
    """Return the runs of a result; return None if its runs are not numbered."""
    import pandas as pd

    from fuselog.pipeline.output.report.evidence import findings  # slow to import

    rows = read_table(folder / RUNS)
    if not {"estimator", "case", "run"} <= {*rows} or not pd.api.types.is_integer_dtype(rows["run"]):
        return None
    found = findings(result, {"runs": rows})
    runner = runner_of(folder, result)
    segments = _segments(folder, runner, "run-{run:04d}", {})
    names = [*segments]
    rows = rows.assign(segment=[names[run] for run in rows["run"]])
    tables = {}
    for kind in ("times", "failures"):
        place = folder / "tables" / f"{kind}.parquet"
        if place.is_file():
            table = read_table(place)
            tables[kind] = table.assign(segment=[names[run] for run in table["run"]])
    verdicts = {label: found.of[label].verdict.value for label in found.labels}
    gap_limit_s = runner.experiment.gap_limit_s
    return _sorted(folder, rows, segments, gap_limit_s, tables, verdicts)


def _of_sweep(folder: Path, result: Result) -> Runs:
    """Return the runs at all points of a sweep."""
    segments: dict[str, Segment] = {}
    for number, point in enumerate(result.settings["sweep"]):
        swept: dict[str, Value] = {
            key: float(value) if isinstance(value, int | float) else str(value)
            for key, value in point.items()
        }
        runner = runner_of(folder, result, number)
        name = f"point-{number:04d}-run-{{run:04d}}"
        segments |= _segments(folder, runner, name, swept, number)
    rows = read_table(folder / "tables" / "sweep-runs.parquet")
    named = [
        f"point-{point:04d}-run-{run:04d}" for point, run in zip(rows["point"], rows["run"], strict=True)
    ]
    rows = rows.drop(columns="point").assign(segment=named)
    return _sorted(folder, rows, segments, runner_of(folder, result).experiment.gap_limit_s)


def _segments(
    folder: Path, runner: Runner, name: str, swept: Mapping[str, Value], point: int | None = None
) -> dict[str, Segment]:
    """Return the runs of a result, or of one point of a sweep, by name."""
    experiment, data = runner.experiment, runner.setting.data
    folder = folder.resolve()
    stated = experiment.model_dump(mode="json", by_alias=True)
    settings = hash_of([stated, str(data)])
    seed: dict[str, Value] = {"seed": experiment.seed} if experiment.record else {}
    found: dict[str, Segment] = {}
    for run, log in zip(range(experiment.runs), chain(experiment.files, repeat(None)), strict=False):
        about: dict[str, Value] = {"run": run, **seed, **swept}
        if point is not None:
            about = {"point": point, **about}
        if log is not None:
            about["log"] = log.name
        kept, estimates = (folder / kind / f"run-{run:04d}.mcap" for kind in ("logs", "estimates"))
        opened = kept if kept.is_file() else log
        if point is None and estimates.is_file() and opened is not None:
            part = Part(log=opened, estimates=estimates)
        else:
            part = Part(log=log, result=folder, run=run, point=point, settings=settings)
        of = str(log) if log else hash_of([stated["record"], stated["import"], str(data), seed, run])
        own = name.format(run=run)
        found[own] = Segment(own, of, (part,), {"run": about})
    return found


def _of_logs(path: Path, files: Sequence[Path], gap_limit_s: float, *, recover: bool) -> Runs:
    """Return a run for each log, with each of its estimates logs as a version of the estimates.

    Raises BadInput if a log cannot be read, or the log of estimates is missing.
    """
    from fuselog.replay.judging.tables import joined  # slow to import

    logs: dict[Path, Path] = {}
    versions: dict[Path, list[Path]] = {}
    losses: dict[Path, list[str | None]] = {}
    for file in map(Path.absolute, files):
        opened = [open_log(file, recover=recover)]
        is_estimates = "log" in (opened[0].run.notes if opened[0].run else {})
        if is_estimates:
            opened.append(source_of_estimates(opened[0], recover=recover).log)
        log = opened[-1].path.absolute()
        place = log.resolve()
        logs.setdefault(place, log)
        versions.setdefault(place, []).extend([file] if is_estimates else [])
        losses.setdefault(place, []).extend(each.loss_statement for each in opened)
    segments: dict[str, Segment] = {}
    for name, (place, log) in zip(_distinct([*logs.values()]), logs.items(), strict=True):
        titles = _distinct(versions[place])
        parts = [
            Part(title=title, log=log, estimates=file, recover=recover)
            for title, file in zip(titles, versions[place], strict=True)
        ]
        parts.sort(key=lambda part: (part.title != log.stem, part.title))
        if not parts:
            has_estimates = labels_of(open_log(log, recover=recover))
            parts = [Part(log=log, estimates=log if has_estimates else None, recover=recover)]
        about: dict[str, Value] = {"log": str(log)}
        if damage := "; ".join(dict.fromkeys(filter(None, losses[place]))):
            about["damage"] = damage
        segments[name] = Segment(name, str(place), tuple(parts), {"run": about})
    rows = joined(_judged(segment, gap_limit_s) for segment in segments.values())
    return _sorted(path, rows, segments, gap_limit_s)


def _judged(segment: Segment, gap_limit_s: float) -> "pd.DataFrame":
    """Judge the estimates of a segment; return a row per estimator and case."""
    source, estimates, _ = open_run(segment)
    if not estimates.topics:
        import pandas as pd

        return pd.DataFrame()
    judge = judge_logs([estimates], [source], {}, gap_limit_s=gap_limit_s)
    rows, worst_s = judge.runs_table.assign(segment=segment.name), worst_times(judge)
    keys = zip(rows["estimator"], rows["case"], strict=True)
    return rows.assign(**{WORST_AT: [worst_s.get(key, math.nan) for key in keys]})


def _sorted(
    path: Path,
    rows: "pd.DataFrame",
    segments: Mapping[str, Segment],
    gap_limit_s: float,
    tables: Mapping[str, "pd.DataFrame"] | None = None,
    verdicts: Mapping[str, str] | None = None,
) -> Runs:
    """Combine what is known about runs, and sort them: failed runs first, then the largest errors.

    Runs are sorted by the error of the estimator that has the smallest error over all runs.
    """
    tables, verdicts = tables or {}, verdicts or {}
    properties = {name: each.properties for name, each in segments.items()}
    quantity = next((str(key) for key in rows if is_error(str(key))), "")
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
    failed = _failures(rows, segments, tables.get("failures"))
    order, error = "in the order of their names", dict.fromkeys(segments, 0.0)
    columns = [("run", key) for key in ("rank", *next(iter(properties.values()), {"run": {}})["run"])]
    if quantity:
        by_run = (rows[quantity] ** 2).groupby([rows["estimator"], rows["segment"]]).mean()
        best = str(by_run.groupby(level=0).mean().idxmin())
        error |= {str(name): float(of) for name, of in by_run[best].dropna().items()}
        order = f"the worst first, by {quantity} of {best}"
        groups = dict.fromkeys(group for own in properties.values() for group in own if group != "run")
        firsts = sorted(groups, key=lambda group: group.partition(" ")[0] != best)
        columns += [(group, quantity) for group in firsts]
    names = sorted(segments, key=lambda name: (name not in failed, -error[name], name))
    for rank, name in enumerate(names, start=1):
        properties[name]["run"]["rank"] = rank
    for name, sentence in failed.items():
        properties[name]["run"]["failure"] = sentence
    if failed:
        columns.append(("run", "failure"))
    ordered = [segments[name] for name in names]
    return Runs(path, ordered, order, columns, gap_limit_s)


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
    rows: "pd.DataFrame", segments: Mapping[str, Segment], failures: "pd.DataFrame | None"
) -> dict[str, str]:
    """Return for each run why estimators failed, or for which estimators there are no errors."""
    found: dict[str, list[str]] = {}
    if len(rows):
        for label, own in rows.groupby("estimator", sort=False):
            for name in segments.keys() - set(own["segment"]):
                found.setdefault(name, []).append(f"{label} has no errors")
    if failures is not None and len(failures):
        for segment, sentences in failures.groupby("segment", sort=False)["failure"]:
            found[str(segment)] = list(sentences)
    return {name: "; ".join(sentences) for name, sentences in found.items()}
