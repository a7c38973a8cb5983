"""A log in memory with filters, their replays, and the verdicts on them, without server or browser."""

import json
import math
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Literal, NamedTuple

import numpy as np
import tomli_w

from fuselog.pipeline.altering.changes import is_of_topic
from fuselog.pipeline.altering.sources import setting_of, split_settings
from fuselog.pipeline.api.planning import Log, Named, settings_of, sources_of
from fuselog.pipeline.api.replays import replay as replayed
from fuselog.pipeline.diagnosing.diagnosis import diagnose
from fuselog.pipeline.exploring.curves import Case, cases_of
from fuselog.pipeline.exploring.sliders import Slider, setting_text, sliders_of
from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.words import quantity
from fuselog.pipeline.runs.settings import parameters_by_label, with_settings
from fuselog.pipeline.runs.trials import Trial, with_values
from fuselog.pipeline.tuning.objective import log_in_memory
from fuselog.pipeline.tuning.tuning import OPEN, gate_of, tune
from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import field_of, flat, merge
from fuselog.replay.engine.replaying.estimator import Estimator, bind
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.foreign.naming import allowed, name_of
from fuselog.replay.inference.all_methods import METHODS, modelled
from fuselog.replay.inference.estimators import model_of
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.verdicts import Consistency, Squares, decisive

Values = Mapping[str, float]
MOST = 2  # largest number of filters side by side
NO_FILTERS = ("bound",)  # methods that have no estimates

LIKELIHOOD = "log-likelihood, open gate"
Level = Literal["good", "doubtful", "failed"]


class Summary(NamedTuple):
    """A verdict in words.

    Attributes:
        level: its severity.
        headline: the verdict in a few words.
        detail: its evidence.
    """

    level: Level
    headline: str
    detail: str


def verdict_of(case: Case, alarms: Sequence[Finding], failures: Sequence[str]) -> Summary:
    """Judge a filter by its NEES, NIS and warnings in one case of a log."""
    if failures:
        return Summary("failed", "It stopped.", failures[0])
    own = [each for each in alarms if each.part in ("", case.name)]
    by = decisive(_squares_of(case))
    has_other_cause = bool(own) and {"errors", "innovations"}.isdisjoint(each.kind for each in own)
    if by is None or by.verdict == Consistency.CONSISTENT or has_other_cause:
        if own:
            return Summary("doubtful", "Doubtful.", own[0].sentence)
        return Summary("good", "No problem found.", _evidence(case))
    times = "times what" if by.verdict == Consistency.OVERCONFIDENT else "of what"
    detail = f"Its {by.name} are {by.factor:.2g} {times} it states."
    return Summary("doubtful", f"{by.verdict.capitalize()}.", detail)


def _squares_of(case: Case) -> list[Squares]:
    """Return NEES and NIS of one log, if available."""
    found = []
    if case.errors is not None and np.isfinite(case.errors.nees).any():
        nees, size = float(np.nanmean(case.errors.nees)), len(case.errors.components)
        found.append(Squares("errors", Interval(nees), size, chi_square_interval(size, 1)))
    if not math.isnan(nis := mean_nis(case)):
        size = sum(each.size for each in case.whiteness.values() if np.isfinite(each.mean_square))
        low, high = chi_square_interval(size, 1)
        found.append(Squares("innovations", Interval(nis), 1.0, (low / size, high / size)))
    return found


def mean_nis(case: Case) -> float:
    """Compute the mean square of the whitened innovations; NaN if there are no innovations."""
    known = {name: each for name, each in case.whiteness.items() if np.isfinite(each.mean_square)}
    count = sum(each.size for each in known.values())
    if not count:
        return math.nan
    return sum(each.size * each.mean_square for each in known.values()) / count


def _evidence(case: Case) -> str:
    words = {"innovations": "NIS is {:.2f} per component", "errors": "NEES is {:.2f} for {:.0f}"}
    facts = [words[each.name].format(each.found.value, each.aim) for each in _squares_of(case)[::-1]]
    within = "within its interval" if len(facts) == 1 else "within their intervals"
    return (
        f"{' and '.join(facts)}, {within}."
        if facts
        else "There is neither a truth nor an innovation by which to judge the estimator."
    )


def numbers_of(case: Case) -> Mapping[str, tuple[float, str]]:
    """Return the numbers at the top of the page by name, each with its unit."""
    found: dict[str, tuple[float, str]] = {}
    if case.errors is not None and len(case.errors.nees):
        main = case.errors.main
        squared = case.errors.error[:, main.columns] ** 2
        unit = quantity(main.rmse).unit
        found["error, RMS"] = main.scale * math.sqrt(float(np.mean(squared.sum(axis=1)))), unit
        found[f"NEES, aim {len(case.errors.components)}"] = float(np.nanmean(case.errors.nees)), ""
    if not math.isnan(nis := mean_nis(case)):
        found["NIS, aim 1"] = nis, ""
    if not math.isnan(case.log_likelihood):
        found[LIKELIHOOD] = case.log_likelihood, ""
    return found


@dataclass(frozen=True)
class Played:
    """One filter's replay with some settings.

    Attributes:
        label: the filter's label.
        values: the values of the parameters that were set.
        cases: the curves, by the name of the estimated object.
        verdicts: the verdicts, by the same names.
        seconds: the time in s that the replay and its judgement took.
    """

    label: str
    values: Values
    cases: Mapping[str, Case]
    verdicts: Mapping[str, Summary]
    seconds: float


@dataclass
class Session:
    """One log with one or more filters.

    Attributes:
        source: the log, with the requested alterations.
        filters: settings by label.
        gap_limit_s: the longest gap over which the truth is interpolated.
        estimated: parameters that are part of the state, with their initial standard deviations.
    """

    source: LogSource | MemorySource
    filters: dict[str, dict[str, Any]]
    gap_limit_s: float = 0.2
    estimated: Mapping[str, float] = field(default_factory=dict)
    _log: Ensemble[MemorySource] = field(init=False)
    sliders: list[Slider] = field(init=False)

    def __post_init__(self) -> None:
        """Bind all filters, and read their topics into memory; raise BadInput as a replay does."""
        bound = {
            label: bind(label, [self.source], {"kind": label, **self.settings(label, {})})
            for label in self.filters
        }
        self._log = log_in_memory(self.source, chain.from_iterable(bound.values()))
        self.sliders = sliders_of(self.source, {label: each[0] for label, each in bound.items()})

    @property
    def log(self) -> MemorySource:
        """Return the part of the log that is in memory."""
        return self._log[0]

    def slider(self, name: str) -> Slider:
        """Return the slider of a parameter; raise BadInput if it has none."""
        found = next((each for each in self.sliders if each.name == name), None)
        if found is None:
            raise BadInput(f"no slider '{name}'; {choices(name, [each.name for each in self.sliders])}")
        return found

    def has(self, name: str) -> bool:
        """Test whether a parameter has a slider."""
        return any(each.name == name for each in self.sliders)

    def like_first(self, method: str) -> dict[str, Any]:
        """Copy the first filter's settings for another method, with the same model."""
        like = next(iter(self.filters.values()))
        kind = like.get("kind")
        model = model_of(kind) if isinstance(kind, Estimator) else None
        return {**like, "kind": modelled(model, method) if model else method}

    @property
    def methods(self) -> list[str]:
        """Return the methods that can replay the log with the first filter's settings."""
        found = []
        for method in METHODS:
            with suppress(BadInput):
                if method not in NO_FILTERS and bind(method, [self.source], self.like_first(method)):
                    found.append(method)
        return found

    def with_filters(self, filters: Mapping[str, dict[str, Any]]) -> "Session":
        """Make a session of the same log with other filters; raise BadInput if any cannot replay it."""
        return Session(self.source, dict(filters), self.gap_limit_s)

    def with_estimated(self, names: Sequence[str]) -> "Session":
        """Make a session with these parameters in the state.

        Their initial standard deviation is a quarter of the slider's range. Raises BadInput if a filter
        cannot estimate one of the parameters.
        """
        for label in self.filters:
            if names and not self._takes(label, "estimate"):
                raise BadInput(f"{label}: no model defines what can be estimated in the state")
        sigmas = {name: 0.25 * (self.slider(name).high - self.slider(name).low) for name in names}
        return Session(self.source, self.filters, self.gap_limit_s, sigmas)

    def play(self, label: str, values: Values) -> Played:
        """Replay one filter with these parameters, and judge it.

        The log-likelihood is computed with an open gate, as in `likelihoods`. Raises BadInput if the
        filter refuses the parameters, or cannot begin.
        """
        begin = time.perf_counter()
        trial = self._trial(label, values)
        bound, outputs = trial.bind(), trial.outputs()
        judge = Judge(self._log, gap_limit_s=self.gap_limit_s)
        judged = judge.add(outputs)
        estimated = self.settings(label, values).get("estimate", ())
        cases = cases_of(outputs, judged.errors, self.source.epoch_ns, estimated)
        if gate_of(bound) < 1.0:
            opened = self._likelihoods(label, {**values, **OPEN})
            cases = {name: replace(case, log_likelihood=opened[name]) for name, case in cases.items()}
        parameters = bound[0].parameters
        stated = {label: parameters.model_dump()} if parameters is not None else {}
        alarms, failures = alarms_of(judge, stated), judge.failures
        verdicts = {name: verdict_of(case, alarms, failures) for name, case in cases.items()}
        return Played(label, dict(values), cases, verdicts, time.perf_counter() - begin)

    def likelihoods(
        self, label: str, values: Values, name: str, count: int = 15
    ) -> Iterator[tuple[float, Mapping[str, float]]]:
        """Yield the log-likelihood of each case along one parameter, in ascending order.

        The current value is included. The gate is open, because likelihoods of different measurements
        cannot be compared.
        """
        slider = self.slider(name)
        opened = OPEN if name not in OPEN and self._takes(label, *OPEN) else {}
        for value in sorted({*slider.values(count), values.get(name, slider.default)}):
            with suppress(BadInput):
                yield value, self._likelihoods(label, {**values, **opened, name: value})

    def _likelihoods(self, label: str, values: Values) -> dict[str, float]:
        """Compute the log-likelihood of each case with a replay that is not judged."""
        cases = cases_of(self._trial(label, values).outputs(), [], self.source.epoch_ns)
        return {name: case.log_likelihood for name, case in cases.items()}

    def tuned(self, label: str, values: Values, free: Sequence[str]) -> tuple[dict[str, float], str]:
        """Tune some parameters, and return all values and the criterion of the search.

        Raises BadInput as `tune` does.
        """
        found = tune(
            self.source, {label: self.settings(label, values)}, free, gap_limit_s=self.gap_limit_s
        )
        best = found.parameters.set_index("parameter")["value"]
        return {**values, **{name: float(f"{best[name]:.4g}") for name in free}}, found.objective.by

    def diagnosed(self, label: str, values: Values) -> list[str]:
        """Return the sentences of a diagnosis; raise BadInput as `diagnose` does."""
        found = diagnose(
            self.source, {label: self.settings(label, values)}, gap_limit_s=self.gap_limit_s
        )
        return found.told

    def view(self, values: Values, at_s: float | None) -> None:
        """Show the timeline of all filters in the viewer at an instant, until the viewer is closed.

        Raises BadInput if there is no screen, or if the viewer cannot run.
        """
        from fuselog.replay.timeline import viewer  # slow to import

        with scratch_folder("fuselog-explore") as folder:
            rrd = folder / "timeline.rrd"
            chosen = {label: {"kind": label, **self.settings(label, values)} for label in self.filters}
            replayed(self.source, chosen, gap_limit_s=self.gap_limit_s).view(save=rrd)
            viewer.view(rrd, at_s=at_s)

    def settings(self, label: str, values: Values) -> dict[str, Any]:
        """Return the settings of a filter, with values for those parameters that it has."""
        taken = {name: value for name, value in values.items() if self._takes(label, name)}
        own = with_values(self.filters[label], taken)
        if self.estimated:
            own = merge(own, {"estimate": [*self.estimated], "estimate_sigma": dict(self.estimated)})
        return own

    def toml(self, values: Values) -> str:
        """Write the settings of all filters as a settings file for `--settings`.

        Raises BadInput for an estimator defined in Python, which cannot be written as text.
        """
        tables = {}
        for label in self.filters:
            settings = self.settings(label, values)
            if not isinstance(settings.get("kind", label), str):
                raise BadInput(f"{label}: an estimator defined in Python cannot be written to a file")
            tables[label] = {
                name: each for name, each in settings.items() if (name, each) != ("kind", label)
            }
        return tomli_w.dumps(tables)

    def command(self, values: Values) -> str:
        """Write a command for the same replay; raise BadInput for an estimator defined in Python."""
        place = self.source.log.path if isinstance(self.source, LogSource) else self.source.name
        words = ["fuselog replay", shlex.quote(str(place))]
        for label, own in self.filters.items():
            name, rest = name_of(label, {"kind": label, **own})
            words.append(f"-e {shlex.quote(name)}")
            words += [
                f"--set {shlex.quote(f'{label}.{key}={_set_to(label, value)}')}"
                for key, value in flat(rest)
                if key not in values and value is not None
            ]
        words += [
            f"--set {shlex.quote(f'{key}={value}')}" for key, value in setting_of(self.source).items()
        ]
        if self.estimated:
            words.append(f"--set {shlex.quote(f'estimate={[*self.estimated]}')}")
            sigmas = {field_of(name): sigma for name, sigma in self.estimated.items()}
            words += [f"--set estimate_sigma.{name}={sigma!r}" for name, sigma in sigmas.items()]
        return " ".join([*words, *setting_text(values)])

    def _trial(self, label: str, values: Values) -> Trial:
        return Trial(label, self._log, {"kind": label, **self.settings(label, values)})

    def _takes(self, label: str, name: str) -> bool:
        [names] = parameters_by_label({label: self.filters[label]}).values()
        return ("of_topics" if is_of_topic(name) else name.partition(".")[0]) in names


def _set_to(label: str, value: Any) -> str:
    """Format a setting for `--set`; texts, numbers and lists in JSON are valid TOML."""
    if isinstance(value, Estimator):
        raise BadInput(f"{label}: an estimator defined in Python cannot be named in a command")
    return json.dumps(value)


def open_session(
    log: Log,
    estimators: Named,
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    gap_limit_s: float = 0.2,
) -> Session:
    """Start to explore one log.

    Args:
        log: a path, an opened log, or a recording.
        estimators: the filters, in the form that `replay` accepts.
        set: parameters of the filters and alterations of topics, in the form that `replay` accepts.
        gap_limit_s: the longest gap over which the truth is interpolated.

    Raises BadInput if there are several logs or too many filters, or if one cannot follow the log.
    """
    alterations, given = split_settings(set or {})
    sources = sources_of(log, alterations)
    if len(sources) > 1:
        raise BadInput(
            f"{len(sources)} logs: give one log, such as {sources[0].name}; explore takes one at a time"
        )
    chosen = settings_of(estimators)
    if len(chosen) > MOST:
        raise BadInput(
            f"{', '.join(chosen)}: explore takes at most {MOST} filters at a time; remove some"
        )
    return Session(sources[0], with_settings(chosen, allowed(given)) if given else chosen, gap_limit_s)
