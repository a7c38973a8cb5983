"""Presentation of a tuning's result: tables, figures, notes, settings, result folder."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomli_w

from fuselog.pipeline.altering.sources import setting_of
from fuselog.pipeline.api.api import ResultFolder
from fuselog.pipeline.api.replays import Replay, replay
from fuselog.pipeline.optimise import DROP_95, QUANTILE
from fuselog.pipeline.output.alarming import unseen
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.output.summary import summarise, summary_table
from fuselog.pipeline.output.words import label_of
from fuselog.pipeline.selecting.selection import table_of
from fuselog.pipeline.tuning.confidence import Profile, SearchOutcome, doubts, profiles
from fuselog.pipeline.tuning.objective import Objective, innovations_in
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.consistency.whiteness import whitened, whiteness
from fuselog.replay.judging.errors.evaluation import Floats, split_topic
from fuselog.replay.judging.tables import joined

Source = LogSource | MemorySource
START, TUNED = "start", "tuned"  # labels of the estimator with its start values and its tuned values
SETTINGS = "settings.toml"
IMPROBABLE = 1e-3  # probability below which innovations are not considered white


@dataclass(frozen=True, eq=False, repr=False)
class Tuning:
    """The result of a tuning.

    Attributes:
        label: the label of the estimator.
        logs, held_out_logs: the logs of the search, and other logs on which the values are judged.
        settings: the estimator's settings with the start values, and with the tuned values.
        objective: the cost that was minimised.
        found: the outcome of the search.
        costs: (2,) costs of the logs with the start and the tuned values. If the likelihood was
            optimised, each cost is minus the log-likelihood, corrected for the noise of the controls if
            a note says so.
        held_out_costs: (2,) costs of the held-out logs with the start and the tuned values, if there are
            such logs.
        folds: a row per fold: the values found on all other logs, and the costs of the fold's own logs.
        gate: the probability of the gate that was open in the search.
        advice: sentences on what to record next.
        files: texts that are written next to the settings, by file name.
        unreadable: why other logs of the selection cannot be read.
    """

    label: str
    logs: Sequence[Source]
    held_out_logs: Sequence[Source]
    settings: Mapping[str, Mapping[str, Any]]
    objective: Objective
    found: SearchOutcome
    costs: Floats
    held_out_costs: Floats | None
    folds: pd.DataFrame
    gate: float
    advice: Sequence[str] = ()
    files: Mapping[str, str] = field(default_factory=dict)
    unreadable: Mapping[Path, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        title = f"{self.label} tuned by {self.objective.by} over {_named(self.logs)}"
        return "\n".join([title, self.parameters.to_string(index=False), *self.notes])

    @property
    def parameters(self) -> pd.DataFrame:
        """Return a table with a row per parameter: start, value, 95 % interval (NaN if unknown)."""
        free = self.found.coordinates.free
        point, reach = self.found.coordinates.of(self.found.optimum), QUANTILE * self.standard_errors
        low, high = map(self.found.coordinates.unbounded, (point - reach, point + reach))
        return pd.DataFrame(
            {
                "parameter": [each.name for each in free],
                "start": [each.default for each in free],
                "value": self.found.optimum,
                "low": low,
                "high": high,
            }
        )

    @property
    def standard_errors(self) -> Floats:
        """Return standard errors (k,), of logarithms for positive parameters; NaN if unknown."""
        errors = np.full(len(self.found.optimum), np.nan)
        if self.found.confidence is not None:
            errors[list(self.found.confidence.places)] = self.found.confidence.errors
        return errors

    @property
    def correlation(self) -> pd.DataFrame:
        """Return the correlations of the parameters' errors (of logarithms, for positive parameters)."""
        if self.found.confidence is None:
            return pd.DataFrame()
        names = [self.found.coordinates.free[place].name for place in self.found.confidence.places]
        return pd.DataFrame(self.found.confidence.correlation, names, names)

    @property
    def profile(self) -> pd.DataFrame:
        """Return a table of each parameter's values with log-likelihoods relative to the maximum."""
        tables = [
            {
                "parameter": each.name,
                "value": each.along,
                "log_likelihood": -each.rise,
                "by_curvature": -each.parabola,
            }
            for each in self._profiles
        ]
        return joined(map(pd.DataFrame, tables))

    @cached_property
    def _profiles(self) -> list[Profile]:
        found = self.found
        if found.confidence is None:
            return []
        coordinates = found.coordinates
        return profiles(self.objective, coordinates, coordinates.of(found.optimum), found.confidence)

    @cached_property
    def whiteness(self) -> pd.DataFrame:
        """Return a table on whiteness, with a row per measured component and set of values.

        The columns are the number of innovations, the mean square of the normalised innovations, the
        correlation of each with the next one, the Ljung-Box statistic Q, and the probability of a larger
        Q if the innovations are white.
        """
        rows = []
        start = np.array([each.default for each in self.found.coordinates.free])
        for label, values in ((START, start), (TUNED, self.found.optimum)):
            series: dict[tuple[str, str], list[Floats]] = {}
            for run in self.objective.runs:
                for topic, innovations in innovations_in(self.objective.outputs(values, run)):
                    columns = zip(innovations.components, whitened(innovations).T, strict=True)
                    for name, column in columns:
                        series.setdefault((split_topic(topic)[1], name), []).append(column)
            for (case, name), found in series.items():
                tested = whiteness(found)
                rows.append(
                    {
                        "estimator": label,
                        "case": case,
                        "component": name,
                        "innovations": tested.size,
                        "mean_square": tested.mean_square,
                        "next_correlation": tested.correlation[0],
                        "ljung_box": tested.ljung_box,
                        "probability": tested.probability,
                    }
                )
        return pd.DataFrame(rows)

    @cached_property
    def replay(self) -> Replay:
        """Return the replay of the logs with both sets of values, labelled `start` and `tuned`."""
        return replay(self.logs, self.settings, gap_limit_s=self.objective.gap_limit_s)

    @cached_property
    def held_out(self) -> Replay | None:
        """Return the replay of the held-out logs with both sets of values, or None without such logs."""
        if not self.held_out_logs:
            return None
        named = {f"{label}-held-out": values for label, values in self.settings.items()}
        return replay(self.held_out_logs, named, gap_limit_s=self.objective.gap_limit_s)

    @property
    def replays(self) -> list[Replay]:
        """Return the replays of the logs and, if any, of the held-out logs."""
        return [self.replay, *([self.held_out] if self.held_out else [])]

    @property
    def metrics(self) -> pd.DataFrame:
        """Return a table with a row per metric and set of values: estimator, quantity, case, value."""
        return joined(each.metrics for each in self.replays)

    @cached_property
    def notes(self) -> list[str]:
        """Return remarks on the reliability of the values, one sentence each."""
        return [
            *self.notes_of_search,
            *(each for each in self.replay.judge.notes_of_coverage if each.startswith(TUNED)),
            *self._notes_of_innovations(),
            *self._notes_of_truth(),
            *self._notes_of_others(),
            *self.advice,
        ]

    @property
    def notes_of_search(self) -> list[str]:
        """Return the notes on the search, which need no replay."""
        return list(self._notes_of_search())

    def _notes_of_search(self) -> Iterator[str]:
        found, free = self.found, self.found.coordinates.free
        if found.was_stopped:
            yield (
                f"the search was stopped after {found.evaluations} evaluations: these are the best "
                "values so far, and their uncertainty is unknown"
            )
        elif not found.has_converged:
            yield "the search ended before it converged; start it again from these values"
        if self.gate < 1.0:
            yield (
                f"the gate (gate_probability = {self.gate:g}) was open during the search: rejected "
                "measurements cost nothing, so a closed gate would favour values that reject many"
            )
        if self.objective.by != "likelihood":
            yield f"tuning by {self.objective.by} gives no intervals; other values may be equally good"
        for topic, count in self.objective.left_out.items():
            yield (
                f"{topic}: the search left out the first {count} messages, because a delay could move "
                "them to before the start of the filter"
            )
        beyond = found.coordinates.at_bounds(found.coordinates.of(found.optimum))
        for each, value, is_beyond in zip(free, found.optimum, beyond, strict=True):
            if each.is_assumed:
                yield (
                    f"{each.name}: no channel states its value; the search starts from the default that "
                    f"replay uses, {each.default:g}; --set {each.name}=... sets another start"
                )
            if each.is_fixed and each.name not in found.held:
                yield (
                    f"{each.name}: the logs do not determine it; it stays at its start value, "
                    f"{each.default:g}"
                )
            elif is_beyond and not each.is_fixed:
                side = "lower" if value < each.default else "upper"
                yield (
                    f"{each.name}: the best value is its {side} bound {value:g}, so it has no interval; "
                    "give a wider --bound, or remove it from the free parameters"
                )
        yield from found.lacks
        if not found.begins_alike:
            yield (
                "with these values the filter starts at other stamps than in the search that found "
                "them; a new search would move the start again; give every log a prior"
            )
        if found.at_edge:
            yield (
                f"{', '.join(found.at_edge)}: no interval, because close to the value a run fails or "
                "uses fewer measurements, so that likelihoods cannot be compared; give every log a "
                "prior, a narrower --bound, or other start values"
            )
        if found.is_spike:
            yield (
                "there are no intervals: innovations are too large with these values, and a search from "
                "a second start ends at values that explain the logs less well, so the filter diverges "
                "nearby; choose other start values with --set, or use --grid"
            )
        if self.objective.is_corrected:
            yield (
                "the noise of the controls, such as odometry, would bias these values: shifted stamps "
                "average the noise, and a factor below 1 attenuates it; the search corrects for this, "
                "and the intervals include it"
            )
        if found.confidence is not None:
            yield from doubts(found.confidence, found.coordinates)

    def _notes_of_innovations(self) -> Iterator[str]:
        rows = self.whiteness.to_dict("records")
        if not rows:
            yield (
                f"{self.label} gives no innovations, so these values minimise the errors of its "
                "estimates against the truth; how well they fit the measurements is unknown"
            )
        for row in (each for each in rows if each["estimator"] == TUNED):
            if row["probability"] < IMPROBABLE:
                what = " ".join(filter(None, (row["case"], row["component"])))
                negative = row["next_correlation"] < 0
                yield (
                    f"{what}: the tuned innovations are not white (Ljung-Box {row['ljung_box']:.4g}, "
                    f"p = {row['probability']:.1g}); the correlation of successive innovations is "
                    f"{row['next_correlation']:.2g}, which suggests that the "
                    f"{'measurement' if negative else 'process'} noise is too small, or not white"
                )

    def _notes_of_truth(self) -> Iterator[str]:
        """Report large errors, such as a slowly changing bias, that the innovations do not show."""
        for replayed in self.replays:
            for each in unseen(replayed.judge):
                if not each.where.startswith(START):
                    yield (
                        f"{each.where} {each.part}".rstrip() + f": {each.evidence}; estimate slowly "
                        "changing errors, such as a sensor's bias, as states"
                    )

    def _notes_of_others(self) -> Iterator[str]:
        """Report whether the tuned values also explain logs outside the search better."""
        if self.held_out_costs is not None:
            before, after = self.held_out_costs
            what, sign = "cost", 1.0
            if self.objective.by == "likelihood":
                what, sign = f"log-likelihood ({self._scale})", -1.0
            yield (
                f"held-out logs: {what} {sign * before:.6g} with the start values, {sign * after:.6g} "
                f"with the tuned values: {'better' if after < before else 'no better'}"
            )
        if len(self.folds):
            better = int((self.folds[f"cost_{TUNED}"] < self.folds[f"cost_{START}"]).sum())
            yield (
                f"{better} of {len(self.folds)} folds are explained better with the values from the "
                "other folds"
            )

    @property
    def _scale(self) -> str:
        """Describe how the held-out logs' log-likelihood differs in scale from that in the tables."""
        count = len(self.held_out_logs)
        total = "of 1 log" if count == 1 else f"the sum over {count} logs"
        is_open, is_closed = (", gate open", ", with the gate") if self.gate < 1.0 else ("", "")
        return f"{total}{is_open}; the tables have the mean per log{is_closed}"

    @property
    def toml(self) -> str:
        """Return the tuned settings as TOML text for --settings."""
        values = {name: each for name, each in self.settings[TUNED].items() if _is_toml(each)}
        if values.get("kind") == self.label:
            del values["kind"]
        return tomli_w.dumps({self.label: values})

    def save(self, folder: str | Path) -> ResultFolder:
        """Write settings.toml, tables, figures, metrics and timeline to the result folder `folder`.

        Raises BadInput if the folder exists and is not a fuselog result.
        """
        place = Path(folder)
        check_folder(place, {"input": [path for each in self.replays for path in each.paths]})
        outcome = Outcome(input_sha256=self.replay.input_sha256, kind="tune")
        for each in self.replays:
            found = summarise(each.judge, each.done.coverage)
            outcome.metrics |= found.metrics
            outcome.bounds |= found.bounds
            if each is self.replay:
                outcome.tables, outcome.figures = found.tables, found.figures
        outcome.tables |= {
            name: table
            for name, table in {
                "summary": summary_table(outcome.metrics),
                "parameters": self.parameters,
                "correlation": self.correlation.rename_axis("parameter").reset_index(),
                "profile": self.profile,
                "whiteness": self.whiteness,
                "folds": self.folds,
                "unreadable": table_of(self.unreadable),
            }.items()
            if len(table)
        }
        if self._profiles:
            outcome.figures["profiles"] = self.profile_chart
        tuned = {str(name) for name in self.parameters.get("parameter", ())}
        settings = {
            "title": f"{self.label} tuned by {self.objective.by} over {_named(self.logs)}",
            "logs": [log.name for log in self.logs],
            "held_out": [log.name for log in self.held_out_logs],
            "by": self.objective.by,
            "estimators": json.loads(json.dumps(self.settings, default=str)),
            **setting_of(self.logs[0]),
            "notes": list(self.notes),
            "gap_limit_s": self.objective.gap_limit_s,
            "meanings": {name: words for name, words in self._meanings.items() if name in tuned},
        }
        with result_folder(place) as part:
            for name, text in {SETTINGS: self.toml, **self.files}.items():
                (part / name).write_text(text, encoding="utf-8")
            self.replay.view(save=part / "timeline.rrd")
            return ResultFolder(place, write_outcome(part, "tune", settings, outcome))

    @property
    def _meanings(self) -> Mapping[str, str]:
        """Return the meanings of the estimator's parameters, in a few words each."""
        return next(iter(self.replay.done.meanings.values()), {})

    @property
    def profile_chart(self) -> Chart:
        """Return a chart of the log-likelihood along each parameter, with its 95 % limit."""
        positive = {each.name: each.is_log for each in self.found.coordinates.free}
        panels = [
            Panel(
                x=Axis(
                    label=label_of(each.name, self._meanings.get(each.name, "")), log=positive[each.name]
                ),
                y=Axis(label="log-likelihood relative to its maximum"),
                series=[
                    level("95 %", each.along, -DROP_95),
                    curve("by curvature", each.along, -each.parabola, "dashed", reference=True),
                    curve("log-likelihood", each.along, -each.rise, "line+markers"),
                ],
            )
            for each in self._profiles
        ]
        title = "profiles along each parameter, with all others optimised"
        return Chart(title=title, panels=panels, columns=min(2, len(panels)))


def _is_toml(value: Any) -> bool:
    """Test whether a setting can be written as TOML: None and estimators defined in Python cannot."""
    return isinstance(value, bool | int | float | str | list | dict)


def _named(logs: Sequence[Source]) -> str:
    return logs[0].name if len(logs) == 1 else f"{len(logs)} logs"
