"""Findings on unusual innovations and estimates, and on the log itself.

The thresholds are listed here with their meaning. The thresholds are far from the values that occur by
chance in a log that follows its model.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fuselog.pipeline.diagnosing.advice import number
from fuselog.recorders.checks.finding import Finding, Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import field_of
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.linting import lint_source
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.consistency.divergence import find_divergence
from fuselog.replay.judging.consistency.whiteness import whitened, whiteness
from fuselog.replay.judging.errors.evaluation import Floats, split_topic

# kinds of findings that precede causes, because they need no filter
FIRST = ("lost messages", "gap", "stamps")
TAIL = 3.0  # standard deviations
LOCKED_OUT = 20  # measurements in a row that a gate rejects
REJECTED = 0.05  # share of measurements that a gate rejects although they are not outliers
FEWEST = 20
FLOOR = 0.1  # share of estimates with the smallest variance
FLOOR_STEP = 1e-4  # relative step from the smallest variance to the next


# Kinds of findings that a factor of a topic corrects.
FACTORS: tuple[Kind, ...] = ("unit", "scale", "sign", "gravity")


def of_log(
    source: LogSource | MemorySource,
    streamed: Collection[str],
    corrected: Collection[tuple[Kind, str]] = (),
) -> list[Finding]:
    """List findings in the log on an estimator's topics, except those that its parameters correct."""
    return [
        each
        for each in lint_source(source)
        if each.where in streamed and (each.kind, each.where) not in corrected
    ]


def is_told(found: Finding) -> bool:
    """Test whether a finding is a sentence of a diagnosis; hints are notes instead."""
    return found.severity != "hint" or found.kind in FIRST


def corrected_by(bound: Sequence[Bound]) -> list[tuple[Kind, str]]:
    """List what the estimator's parameters already correct, such as the delay or factor of a topic."""
    found = list[tuple[Kind, str]]()
    for each in bound:
        if not isinstance(each, Recursive) or each.reading is None or each.parameters is None:
            continue
        reading, fields = each.reading(), type(each.parameters).model_fields
        named: list[tuple[str, tuple[Kind, ...], str]] = [
            *((name, ("delay",), topic) for topic, name in reading.delays.items()),
            *((name, FACTORS, topic) for (topic, _), name in reading.factors.items()),
        ]
        found += [
            (kind, topic)
            for name, kinds, topic in named
            if getattr(each.parameters, field_of(name)) != fields[name.rpartition(".")[2]].default
            for kind in kinds
        ]
    return found


def component_table(innovations: Mapping[str, Stream]) -> pd.DataFrame:
    """Compute a table with a row per measured component.

    The columns describe the normalised innovations: their number, mean with its 95 % interval, mean
    square, the share beyond 3 standard deviations (0.27 % of a Gaussian), excess kurtosis, the
    correlation of successive innovations, and the probability that white innovations have a larger
    Ljung-Box Q.
    """
    rows = []
    for topic, stream in innovations.items():
        for name, column in zip(stream.components, whitened(stream).T, strict=True):
            known = column[np.isfinite(column)]
            if len(known) < 2:
                continue
            tested = whiteness([column])
            mean, error = float(known.mean()), float(known.std() / np.sqrt(len(known)))
            rows.append(
                {
                    "case": split_topic(topic)[1],
                    "component": name,
                    "innovations": len(known),
                    "mean": mean,
                    "mean_low": mean - 1.96 * error,
                    "mean_high": mean + 1.96 * error,
                    "mean_square": tested.mean_square if tested.size else np.nan,
                    "beyond_3_sigma": float(np.mean(np.abs(known) > TAIL)),
                    "kurtosis": _kurtosis(known) if known.std() > 0.0 else np.nan,
                    "next_correlation": tested.correlation[0],
                    "probability_white": tested.probability,
                }
            )
    return pd.DataFrame(rows)


def _kurtosis(values: Floats) -> float:
    """Compute the excess kurtosis of values (n,) that are not all equal."""
    deviations = values - values.mean()
    return float(np.mean(deviations**4) / np.mean(deviations**2) ** 2) - 3.0


def of_innovations(
    innovations: Mapping[str, Stream],
    gate: float | None,
    epoch_ns: int,
    *,
    has_outliers: bool,
    in_stretches: bool = False,
) -> Iterator[Finding]:
    """Yield findings on rejected measurements and on divergence of the filter.

    `gate` is the probability of the estimator's gate, if it is a gate of fuselog. If outliers come in
    stretches, the gate rightly rejects measurements for a long time.
    """
    for topic, stream in innovations.items():
        case = split_topic(topic)[1] or "the estimate"
        is_in = stream["accepted"] != 0
        times_ns = stream.publish_time_ns
        share = float(np.mean(~is_in)) if len(stream) else 0.0
        of_all, reopened, opened = f"{number(100.0 * share, 2)} % of the measurements", "", ""
        if gate is not None:
            of_all += f" ({100.0 * (1.0 - gate):.2g} % expected)"
            reopened = "--set gate_probability=1, or gate_reopens_s=1"
            opened = "--set gate_probability=1 until the cause is fixed"
        locked_out = [] if in_stretches else _long_runs(~is_in, LOCKED_OUT)
        if locked_out:
            begin, end = locked_out[0]
            more = f" and {_times(len(locked_out) - 1)} more" if len(locked_out) > 1 else ""
            yield Finding(
                "gate",
                topic,
                "",
                share,
                f"{case}: the gate rejects all {end - begin} measurements from "
                f"{_at(times_ns[begin], epoch_ns)} to {_at(times_ns[end - 1], epoch_ns)}{more}, "
                f"{of_all}, including those that would correct the filter",
                otherwise=reopened,
                time_ns=int(times_ns[begin]),
            )
        elif share > REJECTED and not has_outliers:
            yield Finding(
                "gate",
                topic,
                "",
                share,
                f"{case}: the gate rejects {of_all}, although they are not outliers",
                otherwise=opened,
            )
        yield from _divergence(topic, case, stream, epoch_ns)


def _divergence(topic: str, case: str, stream: Stream, epoch_ns: int) -> Iterator[Finding]:
    """Yield a finding with the stamp at which a filter diverges, and the measurement before it."""
    found = find_divergence(stream)
    if found is None:
        return
    row = found.row
    there = np.isfinite(stream["innovation"][row])
    about = ", ".join(np.array(stream.components)[there])
    if stream["target_id"][row]:
        about = f"{about} of {int(stream['target_id'][row])}"
    yield Finding(
        "divergence",
        topic,
        "",
        found.nis_per_component,
        f"{case}: diverges at {_at(found.time_ns, epoch_ns)}, after {about}: from there on, NIS per "
        f"component is {found.nis_per_component:.3g}; before, it was as expected",
        time_ns=found.time_ns,
    )


def _long_runs(flags: NDArray[np.bool_], least: int) -> list[tuple[int, int]]:
    """Find runs of at least `least` set flags, and return where they begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= least]


def of_estimates(estimates: Mapping[str, Stream]) -> Iterator[Finding]:
    """Yield findings on components whose smallest variance occurs in many of the estimates."""
    for topic, stream in estimates.items():
        if len(stream) < FEWEST or not stream.components:
            continue
        size = round(stream["covariance"].shape[1] ** 0.5)
        variances = np.diagonal(stream["covariance"].reshape(-1, size, size), axis1=1, axis2=2)
        for place, column in enumerate(variances.T):
            distinct = np.unique(column[np.isfinite(column)])
            if len(distinct) < 2 or distinct[0] <= 0.0:
                continue
            share = float(np.mean(column == distinct[0]))
            if share > FLOOR and distinct[1] > distinct[0] * (1.0 + FLOOR_STEP):
                yield Finding(
                    "covariance floor",
                    topic,
                    str(place),
                    share,
                    f"{split_topic(topic)[1] or topic}: the variance of component {place} is "
                    f"{distinct[0]:.3g} in {100.0 * share:.2g} % of the estimates and never smaller: "
                    "measurements do not reduce it below a floor",
                )


def _at(time_ns: int, epoch_ns: int) -> str:
    return f"{(int(time_ns) - epoch_ns) * 1e-9:.4g} s"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
