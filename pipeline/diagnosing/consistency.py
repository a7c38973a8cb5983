"""Tests of whether NIS and NEES are those of a consistent filter."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.api.replays import Replay
from fuselog.pipeline.output.alarming import unseen
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import MetricValue, split_metric
from fuselog.pipeline.output.summary import nis_over_time
from fuselog.pipeline.output.words import listed
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.consistency.consistency import CONSISTENT
from fuselog.replay.judging.consistency.whiteness import whitened, whiteness
from fuselog.replay.judging.errors.evaluation import chi_square_interval, split_topic
from fuselog.replay.judging.metrics.measuring import metric_key

# share of messages in which the truth equals the filter's input, so that both are the same data
SAME = 0.9
# ratio of mean to root mean square of innovations, above which half of their power is a bias
BIASED = 0.7


def unseen_errors(done: Replay, *, has_causes: bool) -> Iterator[Finding]:
    """Yield errors that innovations do not show; if causes were found, these may explain the errors."""
    remedy = "estimate a bias as a state, or see fuselog observability LOG"
    if has_causes:
        remedy = "fix the causes above first, then check again"
    for each in unseen(done.judge):
        words = f"{each.part or 'the estimate'}: {each.evidence}"
        yield replace(each, where=_truth(each.part), part="", evidence=words, otherwise=remedy)


def judged_by_itself(source: LogSource | MemorySource, streamed: Sequence[str]) -> dict[str, str]:
    """Find truths that are the same data as the positions that the filter used, and describe each."""
    sentences = {}
    for topic, about in source.topics.items():
        if about.schema_name != schemas.TRUTH_STATE.full_name or topic.startswith("/estimates/"):
            continue
        truth = source.read([topic])[topic]
        if not len(truth):
            continue
        columns = [truth.components.index(name) for name in ("x_m", "y_m") if name in truth.components]
        for used in streamed if len(columns) == 2 else ():
            stream = source.read([used])[used]
            if "position_m" not in stream.columns or not len(stream):
                continue
            _, here, there = np.intersect1d(
                stream.publish_time_ns, truth.publish_time_ns, return_indices=True
            )
            apart = np.abs(stream["position_m"][here, :2] - truth["state"][there][:, columns])
            if len(here) >= SAME * len(stream) and np.mean((apart < 1e-6).all(axis=1)) >= SAME:
                sentences[topic] = (
                    f"{topic} equals {used}, which the filter used: errors and NEES against it mean "
                    "nothing; give an independent reference"
                )
    return sentences


def unnamed(
    done: Replay, innovations: Mapping[str, Stream], tried: int, no_judges: Collection[str]
) -> Iterator[Finding]:
    """Yield NIS and NEES outside the range that a consistent filter has in most logs (CONSISTENT).

    NIS includes all innovations, even those that a gate rejects. Truths in `no_judges` are ignored.
    Errors are correlated over a run, so the mean NEES has the interval of a single step.
    """
    faults = f"none of the {tried} faults tried explains it" if tried else "no fault was tried"
    for topic, stream in innovations.items():
        case = split_topic(topic)[1]
        normalised = whitened(stream)
        squares, counts = np.nansum(normalised**2, axis=0), np.isfinite(normalised).sum(axis=0)
        low, high = chi_square_interval(int(counts.sum()), 1, CONSISTENT)
        if counts.any() and not low <= squares.sum() <= high:
            of_each = ", ".join(
                f"{square / count:.3g} of {name}"
                for name, square, count in zip(stream.components, squares, counts, strict=True)
                if count
            )
            evidence = (
                f"NIS per component is {squares.sum() / counts.sum():.3g} ({of_each}), outside the "
                f"range of a consistent filter, {low / counts.sum():.3g} to {high / counts.sum():.3g}"
            )
            yield _unnamed(topic, case, float(squares.sum() / counts.sum()), evidence, faults)
    metrics = done.judge.metrics
    for key, (low, high) in done.judge.intervals(CONSISTENT).items():
        _, quantity, case = split_metric(key)
        value = metrics[key]
        if quantity == "nees" and not low <= value <= high and _truth(case) not in no_judges:
            evidence = (
                f"NEES is {value:.3g}, outside the range of a consistent filter, {low:.3g} to {high:.3g}"
            )
            yield _unnamed(_truth(case), case, value, evidence, faults)


class _Seen(NamedTuple):
    """A component whose innovations do not have their stated variances, and a possible correction."""

    name: str
    nis: float
    low: float
    high: float
    remedy: str

    @property
    def times(self) -> float:
        """Return the factor by which the innovations are larger or smaller than stated."""
        deviation = float(np.sqrt(self.nis))
        return 1.0 / deviation if self.is_small else deviation

    @property
    def is_small(self) -> bool:
        """Test whether the innovations are too small."""
        return self.nis < self.low


def of_each_component(innovations: Mapping[str, Stream]) -> Iterator[Finding]:
    """Yield findings on each sensor's innovations, for an estimator that cannot be replayed.

    Autocorrelated innovations point to the motion or a delay; other inconsistencies point to the noise
    of the sensor. If a channel states which parameter of the estimator sets this noise, the finding
    names that parameter. Components with the same finding share one sentence.
    """
    for topic, stream in innovations.items():
        case, alike = split_topic(topic)[1], dict[tuple[bool, str], list[_Seen]]()
        for each in _inconsistent(stream):
            alike.setdefault((each.is_small, each.remedy), []).append(each)
        for (is_small, remedy), some in alike.items():
            less = "smaller" if is_small else "larger"
            times, nis = (
                " to ".join(dict.fromkeys(f"{value:.3g}" for value in (min(values), max(values))))
                for values in ([each.times for each in some], [each.nis for each in some])
            )
            low, high = min(each.low for each in some), max(each.high for each in some)
            yield Finding(
                "measurement noise",
                topic,
                listed([each.name for each in some]),
                max(each.times for each in some),
                f"{case}: the innovations of {listed([each.name for each in some])} are {times} times "
                f"{less} than their variances state (NIS is {nis}, consistent from {low:.3g} to "
                f"{high:.3g}): {remedy}",
            )


def _inconsistent(stream: Stream) -> Iterator[_Seen]:
    """Yield the components whose mean square is inconsistent."""
    stated = stream.metadata.get("noise", "")
    noise = f"its noise ({stated})" if stated else "its noise"
    for name, column in zip(stream.components, whitened(stream).T, strict=True):
        tested = whiteness([column])
        if not np.isfinite(tested.mean_square):
            continue
        low, high = (each / tested.size for each in chi_square_interval(tested.size, 1, CONSISTENT))
        if low <= tested.mean_square <= high:
            continue
        mean = float(np.nanmean(column))
        if abs(mean) > BIASED * max(np.sqrt(tested.mean_square), 1.0):
            remedy = f"their mean is {mean:.3g} standard deviations: the sensor is biased"
        elif tested.mean_square < low:
            remedy = f"{noise} is stated too large"
        elif tested.correlation[0] > tested.bound:
            remedy = "they are autocorrelated: the sensor is late, or the process noise is too small"
        else:
            remedy = f"{noise} is stated too small"
        yield _Seen(name, tested.mean_square, low, high, remedy)


def nis_charts(label: str, innovations: Mapping[str, Stream], epoch_ns: int) -> dict[str, Chart]:
    """Draw NIS per component over time, by case."""
    charts: dict[str, Chart] = {}
    for stream in innovations.values():
        case = split_topic(stream.topic)[1]
        nis = stream["normalised_innovation_squared"]
        degrees = np.isfinite(stream["innovation"]).sum(axis=1)
        used = (degrees > 0) & np.isfinite(nis)
        times_s = 1e-9 * (stream.publish_time_ns[used] - epoch_ns)
        middle_s, mean, *_ = nis_over_time(times_s, nis[used], degrees[used])
        panel = Panel(x=Axis(label="time (s)"), y=Axis(label="NIS per component", log=True))
        panel.series.append(curve(label, middle_s, mean, "line+markers"))
        panel.series.append(level("if consistent", middle_s, 1.0))
        name = " ".join(filter(None, ("NIS", case)))
        charts[name.lower().replace(" ", "-")] = Chart(title=name, panels=[panel])
    return charts


def comparable(metrics: Mapping[str, MetricValue], log_likelihood: float) -> dict[str, MetricValue]:
    """Replace the likelihood of accepted measurements by that of all measurements.

    A likelihood of accepted measurements grows with the number of measurements that a gate rejects, so
    it cannot be compared.
    """
    found = dict(metrics)
    for key in metrics:
        label, quantity, case = split_metric(key)
        if quantity == "log_likelihood" and metrics.get(metric_key(label, "gated_share", case)):
            del found[key]
            if np.isfinite(log_likelihood):
                found[metric_key(label, "open_gate_log_likelihood", "")] = log_likelihood
    return found


def _unnamed(topic: str, case: str, value: float, evidence: str, faults: str) -> Finding:
    return Finding(
        "unnamed",
        topic,
        "",
        value,
        f"{case or 'the estimate'}: something is wrong, but the cause is unknown: {evidence} (in 999 of "
        f"1,000 logs); {faults}",
    )


def _truth(case: str) -> str:
    return f"/{case}/truth" if case else "/truth"
