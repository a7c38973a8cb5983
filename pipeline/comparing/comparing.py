"""Comparison of estimators by the paired differences of their metrics over the same runs."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.api.planning import Kind
from fuselog.pipeline.comparing.candidates import AGE, Candidate
from fuselog.pipeline.comparing.groups import (
    comparable_groups,
    inputs_of,
    kind_of,
    named_in,
    table_of_runs,
    unlike_runs,
    with_logs_of_folders,
)
from fuselog.pipeline.output import words
from fuselog.pipeline.output.alarms import Stressing
from fuselog.pipeline.output.charts import Axis, Chart, Panel, band, curve, level
from fuselog.pipeline.output.coverage import coverage_table, sentences
from fuselog.pipeline.output.outputs import TIMELINE, check_files, check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.output.words import count
from fuselog.pipeline.runs.ensemble import Progress, judge_logs, no_progress
from fuselog.pipeline.runs.estimates import hash_files
from fuselog.pipeline.stressing.stressing import stress as stress_logs
from fuselog.pipeline.stressing.sums import verdicts_of
from fuselog.pipeline.stressing.verdicts import Stress
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.log import RunMetadata, open_log
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.replaying.usage import Row
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.judging.errors.differences import (
    NATS,
    Difference,
    Target,
    paired_difference,
    target_of,
)
from fuselog.replay.judging.intervals import FEWEST_RUNS, too_few
from fuselog.replay.judging.verdicts import DIFFER, Comparison

MARGIN = 0.02
# Largest number of time spans in the differences over time.
SPANS = 32

ALL = "all"


class Paired(NamedTuple):
    """A metric of two candidates, with the difference over the runs and the verdict.

    Attributes:
        first, second: names of the candidates.
        quantity: name of the metric.
        case: case of the estimates; `all` is the mean over the cases of each run.
        target: best value of the metric.
        found: difference over the runs, with its interval.
        where: start and end of the time span that contributes most to the difference, in s since the
            run's epoch; None if there is no such span.
        stressed: largest change of either candidate's metric under changes that should not matter.
        unit: "run", or "group" if the difference is over groups of logs.
    """

    first: str
    second: str
    quantity: str
    case: str
    target: Target
    found: Difference
    where: tuple[float, float] | None = None
    stressed: float = 0.0
    unit: str = "run"

    @property
    def is_withheld(self) -> bool:
        """Test whether changes that should not matter move the metric by more than the difference."""
        return self.found.verdict in DIFFER and abs(self.found.more.value) < self.stressed

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        found = self.found
        of = f" of {self.case}" if self.case else ""
        values = f"{found.second:.4g} against {found.first:.4g}"
        if isinstance(self.target, float):
            values += f", where {self.target:g} is ideal"
        if found.runs < FEWEST_RUNS:
            equal = "equal in every run; " if found.verdict == Comparison.TIE else ""
            return f"{self.quantity}{of}: {values}; {equal}{too_few(found.runs)}"
        interval = f"difference {found.more}"
        of_runs = f"{count(found.runs, self.unit)}, margin {found.margin:.3g}"
        verdict = f"{self.second} is {found.verdict} than {self.first}"
        if found.verdict == Comparison.UNDECIDED:
            verdict = f"{self.second} and {self.first} may or may not differ by more than the margin"
        elif found.verdict == Comparison.TIE:
            verdict = f"no difference beyond the margin between {self.second} and {self.first}"
        if self.is_withheld:
            return (
                f"{self.quantity}{of}: verdict withheld: {values}; {interval}: changes that should not "
                f"matter move it by up to {self.stressed:.3g}"
            )
        when = f"; mostly from {self.where[0]:.1f} to {self.where[1]:.1f} s" if self.where else ""
        return f"{self.quantity}{of}: {verdict}: {values}; {interval}, {of_runs}{when}"


def under_stress(paired: Sequence[Paired], verdicts: Mapping[str, Stressing]) -> list[Paired]:
    """Add to each metric the larger of the two candidates' changes under stress."""
    found = []
    for each in paired:
        key = each.quantity if each.case in ("", ALL) else f"{each.quantity}.{each.case}"
        own = [verdicts[name].moved.get(key, 0.0) for name in (each.first, each.second)]
        found.append(each._replace(stressed=max(own)))
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Differences:
    """Differences between the first candidate of each group and every other candidate of the group.

    Attributes:
        groups: groups of candidates.
        margin: relative difference of a metric that is considered irrelevant.
        gap_limit_s: longest gap over which the truth is interpolated.
        notes: sentences about unequal inputs and omitted runs or metrics.
        paired: every metric of every pair.
        times: a row per pair, case, quantity and time span, with the difference and its interval.
        stress: effects of changes that should not matter; None if they were not tested.
        tables: other tables for the result folder.
        results: the results and logs whose estimates were compared; empty if logs were replayed.
    """

    groups: Sequence[Sequence[Candidate]]
    margin: float
    gap_limit_s: float
    notes: Sequence[str]
    paired: Sequence[Paired]
    times: pd.DataFrame = field(default_factory=pd.DataFrame)
    stress: Stress | None = None
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    results: Sequence[Path] = ()

    @cached_property
    def table(self) -> pd.DataFrame:
        """Return a table with a row per pair, metric and case."""
        rows = []
        for each in self.paired:
            found = each.found.columns
            begin_s, end_s = each.where or (np.nan, np.nan)
            first, second = each.first, each.second
            about = {"quantity": each.quantity, "case": each.case, "aim": _target_text(each.target)}
            when = {"most_from_s": begin_s, "most_to_s": end_s}
            if each.is_withheld:
                found["verdict"] = Comparison.WITHHELD.value
            rows.append({"first": first, "second": second, **about, **found, **when})
        return pd.DataFrame(rows)

    @property
    def sentences(self) -> list[str]:
        """Return the verdicts in words, beginning with significant differences."""
        order = (*DIFFER, Comparison.UNDECIDED, Comparison.TIE)
        return [
            each.sentence for each in sorted(self.paired, key=lambda p: order.index(p.found.verdict))
        ]

    def worse(self) -> list[Paired]:
        """Return the metrics of error, consistency and failure in which a candidate is clearly worse.

        The whole interval of the difference from the first candidate is then beyond the margin.

        Raises BadInput if there are too few runs for an interval, or if a candidate that is not worse in
        any metric lacks a metric of the first candidate, because then it cannot be judged.
        """
        judged = [each for each in self.paired if _is_judged(each.quantity)]
        runs = max((each.found.runs for each in judged), default=0)
        if runs < FEWEST_RUNS:
            raise BadInput(
                f"an interval needs at least {FEWEST_RUNS} runs, and the comparison has only "
                f"{count(runs, 'run')}; give more runs, or leave out --fail-if-worse"
            )
        worse = [
            each for each in judged if each.found.verdict == Comparison.WORSE and not each.is_withheld
        ]
        failing = {each.second for each in worse}
        for first, *others in self.groups:
            for second in others:
                lacking = sorted(_judged_by(first) - _judged_by(second))
                if lacking and second.name not in failing:
                    raise BadInput(
                        f"{second.name}: has no {', '.join(lacking)}, which {first.name} has, so it "
                        "cannot be judged; let it output the same components and innovations, or "
                        "leave out --fail-if-worse"
                    )
        return worse

    def __repr__(self) -> str:
        return "\n".join([*self.notes, *self.sentences])

    def charts(self) -> dict[str, Chart]:
        """Draw the differences over time in a chart for each pair and case."""
        if self.times.empty:
            return {}
        groups = self.times.groupby(["first", "second", "case"], sort=False)
        return {
            "-".join(filter(None, ("differences", *map(str, what)))): _chart(rows)
            for what, rows in groups
        }

    def draw(self, save: Path) -> None:
        """Draw, to the .rrd file `save`, the first run that all candidates of the first group share.

        Raises BadInput if the candidates share no run.
        """
        from fuselog.replay.timeline.show import Drawing  # slow to import

        candidates = self.groups[0]
        check_files([(save, TIMELINE)], {"input": self.inputs})
        if not self.drawable:
            raise BadInput(f"{save}: no run has estimates of both sides to draw; leave out --save")
        first = self.drawable[0]
        source, estimates = side_by_side(candidates, first)
        names = [candidate.name for candidate in candidates]
        identity = json.dumps([source.name, names])
        with Drawing(source.whole(), identity=identity, save=save, sides=names) as drawing:
            judge_logs([estimates], [source], {}, gap_limit_s=self.gap_limit_s, drawing=drawing)

    def save(self, folder: str | Path) -> ResultFolder:
        """Write tables, figures and timeline to the result folder `folder`, for `fuselog report`.

        Raises BadInput if `folder` exists and is not a result of fuselog.
        """
        place = Path(folder)
        inputs = self.inputs
        check_folder(place, {"input": inputs})
        names = [[candidate.name for candidate in candidates] for candidates in self.groups]
        tables = {"differences": self.table, "runs": table_of_runs(self.groups), **self.tables}
        outcome = Outcome(tables=tables, figures=dict(self.charts()), kind="compare")
        for run in self.drawable[:1]:
            outcome.figures |= scene_of(self.groups[0], run, self.gap_limit_s)
        if self.coverage:
            outcome.tables["coverage"] = coverage_table(self.coverage)
        if len(self.times):
            outcome.tables["times"] = self.times
        for each in self.paired:
            key = f"{each.second}.{each.quantity}_difference"
            outcome.metrics[f"{key}.{each.case}" if each.case else key] = each.found.more.value
        outcome.input_sha256 = hash_files([path for path in inputs if path.is_file()])
        if self.stress is not None:
            outcome.stress = [*verdicts_of(self.stress.stressed).values()]
        settings = {
            "title": "; ".join(" against ".join(reversed(each)) for each in names),
            "sides": names,
            "margin": self.margin,
            "notes": list(self.notes),
        }
        if self.results:
            settings["candidates"] = [str(path.absolute()) for path in self.results]
        with result_folder(place) as part:
            if self.drawable:
                self.draw(part / "timeline.rrd")
            return ResultFolder(place, write_outcome(part, "compare", settings, outcome))

    @cached_property
    def coverage(self) -> list[Row]:
        """Return the table of used and unused messages per topic, for all candidates."""
        return [
            row for candidates in self.groups for candidate in candidates for row in candidate.coverage
        ]

    @property
    def drawable(self) -> list[str]:
        """Return the runs for which all candidates of the first group have estimates."""
        first, *others = self.groups[0]
        return [run for run in first.pairs if all(run in each.pairs for each in others)]

    @property
    def inputs(self) -> list[Path]:
        """Return the input files of the first group."""
        sources = [
            each for candidate in self.groups[0] for pair in candidate.pairs.values() for each in pair
        ]
        return [each.log.path for each in sources if isinstance(each, LogSource)]


def _is_judged(key: str) -> bool:
    is_of_group = words.quantity(key).group == words.CONSISTENCY
    return is_of_group or words.is_error(key) or key == "failed_runs"


def _judged_by(candidate: Candidate) -> set[str]:
    """List the metrics by which a candidate is judged, except the optional `estimates_without_*`."""
    known = candidate.rows.dropna(subset=["value"])["quantity"]
    return {key for key in known if _is_judged(key) and not key.startswith("estimates_without")}


def _target_text(target: Target) -> str:
    return "" if target is None else f"{target:g}" if isinstance(target, float) else target


def _chart(rows: pd.DataFrame) -> Chart:
    first, second, case = (rows[name].iloc[0] for name in ("first", "second", "case"))
    panels = []
    for quantity, of in rows.groupby("quantity", sort=False):
        x = of["elapsed_s"].to_numpy()
        label = f"{second} - {first}"
        panel = Panel(x=Axis(label="time (s)"), y=Axis(label=f"difference of {quantity}"))
        panel.series.extend([curve(label, x, of["difference"]), level("no difference", x, 0.0)])
        panel.bands.append(band(label, x, of["low"], of["high"]))
        panels.append(panel)
    title = f"{case or 'differences'}: {second} minus {first}, with 95 % intervals over the runs"
    return Chart(title=title, panels=panels)


@without_warnings_of_numbers()
def compare(
    *candidates: str | Path,
    estimators: Sequence[str | Mapping[str, Kind]] = (),
    truth: str | Path | None = None,
    case: str | None = None,
    margin: float = MARGIN,
    gap_limit_s: float = 0.2,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    recover: bool = False,
    stress: bool = False,
    progress: Progress = no_progress,
) -> Differences:
    """Compare estimators over the same runs, with the first one as the reference.

    Args:
        candidates: result folders, estimates logs or folders of them, and trajectory files; with
            `estimators`, logs to replay or folders of them.
        estimators: estimators to compare, in the form that `replay` accepts, or labels of estimates that
            the logs contain. Recorded estimates come first. By default, these are the estimators that
            all candidates have in common, or the only estimator of each candidate.
        truth: file of the true trajectory, if all candidates are trajectory files.
        case: case to which trajectory files belong, such as `robot2`, if a log has several truths.
        margin: relative difference of a metric that is considered irrelevant.
        gap_limit_s: longest gap over which the truth is interpolated.
        set: for the replay of logs, alterations of topics, and parameters of estimators, in the form
            that `replay` accepts.
        recover: whether the readable part of truncated or damaged logs is used.
        stress: whether to withhold a verdict if changes that should not matter (see `stress`) move the
            metric by more than the difference. Requires logs and `estimators`.
        progress: function that reports progress while results are replayed.

    Returns:
        The difference of every metric for every pair, with its interval and a verdict.

    Raises BadInput if there are fewer than two candidates, or they have no run or metric in common.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", duration_s=5.0))
    >>> found = compare("run.mcap", estimators=["ekf", {"sure": {"kind": "ekf", "sigma_range_m": 0.02}}])
    >>> found.table.query("quantity == 'nees'")["runs"].tolist()
    [1]
    """
    if not 0 <= margin < np.inf:
        raise BadInput(f"margin is {margin:g}; give a share such as 0.02, which means 2 %")
    named = named_in(estimators)
    paths = with_logs_of_folders(list(map(located, candidates)), named, recover=recover)
    if not paths:
        raise BadInput("nothing to compare; give result folders, estimates logs or trajectories")
    givens = inputs_of(
        paths, estimators, set or {}, truth, case, progress, gap_limit_s=gap_limit_s, recover=recover
    )
    kinds = {kind_of(path, named, recover=recover) for path in paths}
    done = differences_of(comparable_groups(givens, named), margin, gap_limit_s)
    paired, notes = done.paired, list(done.notes)
    found = None
    if stress:
        if kinds != {"log"}:
            raise BadInput(
                f"--stress: {paths[0]} is not a log to replay; give logs, and estimators with -e"
            )
        sources = [LogSource(open_log(path, recover=recover)) for path in paths]
        found = stress_logs(sources, estimators, gap_limit_s=gap_limit_s, set=set)
        paired = under_stress(paired, verdicts_of(found.stressed))
    notes += sentences(done.coverage)
    notes = list(dict.fromkeys(notes))
    results = paths if kinds <= {"result", "estimates"} else []
    return replace(done, notes=notes, paired=paired, stress=found, results=results)


def differences_of(
    candidates: Iterable[Sequence[Candidate]], margin: float, gap_limit_s: float
) -> Differences:
    """Compare the first candidate of each group with the others."""
    groups = list(map(_with_ages, candidates))
    notes = [note for group in groups for candidate in group for note in candidate.notes]
    paired: list[Paired] = []
    times: list[pd.DataFrame] = []
    for group in groups:
        for second in group[1:]:
            notes += unlike_runs(group[0], second)
            own, over_time = _compared(group[0], second, margin, notes)
            paired += own
            times.append(over_time)
    filled = [each for each in times if len(each)]
    table = pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()
    return Differences(groups, margin, gap_limit_s, notes, paired, table)


def _with_ages(group: Sequence[Candidate]) -> list[Candidate]:
    """Omit the age of estimates if it is zero for all candidates."""
    rows = pd.concat([each.rows for each in group])
    if (rows["value"][rows["quantity"] == AGE] > 0.0).any():
        return list(group)
    return [replace(each, rows=each.rows[each.rows["quantity"] != AGE]) for each in group]


def _by_importance(quantities: Iterable[str]) -> list[str]:
    """List quantities with the age of estimates after the errors, since waiting reduces errors."""
    found = list(dict.fromkeys(quantities))
    others = [name for name in found if name != AGE]
    errors = [number for number, name in enumerate(others, 1) if "rmse" in name]
    if AGE in found:
        others.insert(errors[-1] if errors else 0, AGE)
    return others


def _compared(
    first: Candidate, second: Candidate, margin: float, notes: list[str]
) -> tuple[list[Paired], pd.DataFrame]:
    """Compare the common metrics of two candidates, over their common runs and over time."""
    keys = ["quantity", "case", "run"]
    both = first.rows.merge(second.rows, on=keys, suffixes=("_first", "_second"))
    of_first, of_second = (set(candidate.rows["quantity"]) for candidate in (first, second))
    for candidate, alone in ((first, of_first - of_second), (second, of_second - of_first)):
        if alone:
            notes.append(f"only {candidate.name} has {', '.join(sorted(alone))}")
    known = both.dropna(subset=["value_first", "value_second"])
    if known.empty:
        raise BadInput(
            f"{first.name} and {second.name} have no metric in common: one of them has estimates "
            "without truth, or of other quantities"
        )
    over_time = _over_time(first, second, margin)
    paired: list[Paired] = []
    for quantity in _by_importance(known["quantity"]):
        rows = known[known["quantity"] == quantity]
        missing = len(set(both["run"])) - len(set(rows["run"]))
        if missing:
            notes.append(f"{quantity}: {count(missing, 'run')} without it are left out")
        scale = NATS if quantity == "log_likelihood" else None
        cases = list(dict.fromkeys(rows["case"]))
        sizes = {first.sizes.get((quantity, case), target_of(quantity)) for case in cases}
        groups = {ALL: rows} if len(cases) > 1 and len(sizes) == 1 else {}
        groups |= {case: rows[rows["case"] == case] for case in cases}
        for case, own in groups.items():
            target = first.sizes.get(
                (quantity, case if case in cases else cases[0]), target_of(quantity)
            )
            means = own.groupby("run", sort=False)[["value_first", "value_second"]].mean().to_numpy()
            found = paired_difference(means[:, 0], means[:, 1], target, margin, scale)
            where = _where(over_time, quantity, case, found)
            paired.append(Paired(first.name, second.name, quantity, case, target, found, where))
    return paired, over_time


def _over_time(first: Candidate, second: Candidate, margin: float) -> pd.DataFrame:
    """Compute the differences of the main RMSEs and the NEES by time span."""
    if first.times.empty or second.times.empty:
        return pd.DataFrame()
    width_s = _span_s([first.times, second.times])
    spans = [_in_spans(candidate.times, width_s) for candidate in (first, second)]
    both = spans[0].merge(spans[1], on=["case", "quantity", "span", "run"], suffixes=("_1", "_2"))
    rows = []
    for _, own in both.groupby(["case", "quantity", "span"], sort=False):
        case, quantity, span = (own[name].iloc[0] for name in ("case", "quantity", "span"))
        target = first.sizes.get((quantity, case), target_of(quantity))
        found = paired_difference(own["value_1"].to_numpy(), own["value_2"].to_numpy(), target, margin)
        about = {"first": first.name, "second": second.name, "case": case, "quantity": quantity}
        time = {
            "elapsed_s": (span - 0.5) * width_s,
            "from_s": (span - 1) * width_s,
            "to_s": span * width_s,
        }
        kept = {name: found.columns[name] for name in ("difference", "low", "high", "runs")}
        rows.append({**about, **time, **kept})
    return pd.DataFrame(rows)


def _span_s(tables: Iterable[pd.DataFrame]) -> float:
    """Choose a multiple of the span lengths in all tables that gives at most `SPANS` spans."""
    ends_ms = [np.rint(table["until_s"].to_numpy() * 1e3).astype(np.int64) for table in tables]
    width = int(np.lcm.reduce([np.gcd.reduce(each) for each in ends_ms]))
    longest = max(int(each.max()) for each in ends_ms)
    while longest > SPANS * width:
        width *= 2
    return width * 1e-3


def _in_spans(times: pd.DataFrame, width_s: float) -> pd.DataFrame:
    """Compute the NEES and the RMSEs of position and orientation (or the first RMSE) in each span."""
    columns = [column for column in times if "rmse" in str(column)]
    main = [each for each in ("position_rmse_m", "orientation_rmse_deg") if each in columns]
    parts = []
    for quantity in [*(main or columns[:1]), "nees"]:
        power = 1 if quantity == "nees" else 2
        span = np.ceil(times["until_s"] / width_s - 1e-9).astype(int)
        sums = times.assign(span=span, value=times["estimates"] * times[quantity] ** power)
        spans = sums.dropna(subset=["value"]).groupby(["run", "case", "span"], sort=False)
        mean = spans["value"].sum() / spans["estimates"].sum()
        parts.append((mean ** (1 / power)).rename("value").reset_index().assign(quantity=quantity))
    return pd.concat(parts, ignore_index=True)


def _where(
    over_time: pd.DataFrame, quantity: str, case: str, found: Difference
) -> tuple[float, float] | None:
    """Find the consecutive spans that contribute most to a difference; None if it is insignificant."""
    if over_time.empty or found.verdict not in DIFFER:
        return None
    own = over_time[(over_time["quantity"] == quantity) & (over_time["case"] == case)]
    own = own.sort_values("from_s").reset_index(drop=True)
    sign = np.sign(found.more.value)
    beyond = np.where(sign > 0, own["low"] > 0, own["high"] < 0)
    if not beyond.any():
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], beyond.astype(int), [0]])))
    stretches = list(zip(edges[::2], edges[1::2], strict=True))
    begin, end = max(stretches, key=lambda each: float(own["difference"][slice(*each)].abs().sum()))
    return float(own["from_s"][begin]), float(own["to_s"][end - 1])


def side_by_side(candidates: Sequence[Candidate], run: str) -> tuple[Source, MemorySource]:
    """Return the log of a run, and the estimates of all candidates under their names."""
    source = candidates[0].pairs[run][0]
    streams = {
        topic: stream
        for own in (candidate.estimates(run) for candidate in candidates)
        for topic, stream in own.read([*own.topics]).items()
    }
    about = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    return source, MemorySource(streams, about, source.name)


def scene_of(candidates: Sequence[Candidate], run: str, gap_limit_s: float) -> dict[str, Chart]:
    """Draw a run from above, and enlarge one second of it if the ellipses are too small to be seen.

    The result is empty if the truth or the estimates have no horizontal positions.
    """
    from fuselog.pipeline.output.report.first_run import seen_from_above  # slow to import
    from fuselog.pipeline.output.report.scene import lens, plan

    found = seen_from_above(*side_by_side(candidates, run), gap_limit_s)
    if found is None:
        return {}
    near = lens(found, [candidate.name for candidate in candidates])
    return {"scene": plan(found)} | ({"lens": near} if near else {})
