"""Finds what is unusual in innovations and messages, and needs no replay to be seen.

Thresholds are far from what chance does to a log that is as its model says; each is beside its name.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fuselog.pipeline.diagnosing.advice import number
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Kind
from fuselog.recorders.checks.finding import Cause
from fuselog.recorders.checks.losses import MOST_LOST
from fuselog.recorders.checks.plausibility import BLOCK, findings_in
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import field_of
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, is_sensed
from fuselog.replay.judging.consistency.divergence import find_divergence
from fuselog.replay.judging.consistency.whiteness import whitened, whiteness
from fuselog.replay.judging.errors.evaluation import split_topic

Floats = NDArray[np.float64]
FIRST = ("lost messages", "stamps")  # what stands before causes: it is seen without any filter
TAIL = 3.0  # standard deviations
LOCKED_OUT = 20  # measurements in a row that a gate keeps out
KEPT_OUT = 0.05  # of measurements that a gate keeps out, though they are no outliers
LOST = 0.02  # of the steps of a regular topic, which are longer than usual
REGULAR = 0.8  # of the steps between stamps that are the usual one, or a multiple of it
LONG_GAP = 20.0  # usual steps
PAUSES = 0.95  # of the steps, which may be the pauses between bursts, as of ranges to many anchors
REPEATED = 0.001  # of the messages
SATURATED = 0.005  # of the values that are the greatest, or the least
FEWEST = 20
COARSE = 0.5  # quanta above this many standard deviations of the innovation
FLOOR = 0.1  # of the estimates whose variance is the least
FLOOR_STEP = 1e-4  # relative, from the least variance to the next


class Finding(NamedTuple):
    """Describes something unusual: its kind, topic, a sentence with evidence, its begin, its mend."""

    kind: Kind
    topic: str
    words: str
    time_ns: int | None = None
    setting: str = ""


# Of what is told without a filter, the kind that it is here.
KINDS: Mapping[Cause, Kind] = {
    "stamps": "stamps",
    "lost messages": "lost messages",
    "clock": "clock drift",
    "delay": "delay",
    "unit": "values",
    "scale": "values",
    "sign": "values",
    "gravity": "values",
    "quaternion": "values",
    "mounting": "bias or turned frame",
    "covariance": "measurement noise",
    "values": "values",
    "magnetometer": "values",
    "place": "values",
    "name": "values",
}


def without_filter(
    source: LogSource | MemorySource,
    streamed: Collection[str],
    undone: Collection[tuple[Kind, str]] = (),
) -> list[Finding]:
    """Find what an estimator's topics say by themselves, each once: the worst of the log first.

    But for kinds of topics that are `undone`.
    """
    implausible = [
        each for each in of_plausibility(source, streamed) if (each.kind, each.topic) not in undone
    ]
    known = [(each.kind, each.topic) for each in implausible]
    of_topics = of_messages((source.read([topic])[topic] for topic in streamed), source.epoch_ns)
    return [*implausible, *(each for each in of_topics if (each.kind, each.topic) not in known)]


def undone_by(bound: Sequence[Bound]) -> list[tuple[Kind, str]]:
    """List what the estimator's parameters undo already: the delay or the factor of a topic."""
    found = list[tuple[Kind, str]]()
    for each in bound:
        if not isinstance(each, Recursive) or each.reading is None or each.parameters is None:
            continue
        reading, fields = each.reading(), type(each.parameters).model_fields
        named: list[tuple[str, Kind, str]] = [
            *((name, "delay", topic) for topic, name in reading.delays.items()),
            *((name, "values", topic) for (topic, _), name in reading.factors.items()),
        ]
        found += [
            (kind, topic)
            for name, kind, topic in named
            if getattr(each.parameters, field_of(name)) != fields[name.rpartition(".")[2]].default
        ]
    return found


def of_plausibility(source: LogSource | MemorySource, streamed: Collection[str]) -> Iterator[Finding]:
    """Yield what a log says of its own faults without a filter, of topics an estimator reads."""
    topics = [topic for topic in source.topics if is_sensed(source, topic)]
    for each in findings_in(source.blocks(topics, "publish_time", BLOCK)):
        if each.topic in streamed:
            setting = f"{each.key}={each.setting}" if each.key else ""
            yield Finding(KINDS[each.cause], each.topic, each.mended, None, setting)


def component_table(innovations: Mapping[str, Stream]) -> pd.DataFrame:
    """Return a row per measured component.

    Of the normalised innovations: how many there are, their mean with its 95 % interval, mean square,
    the share beyond 3 standard deviations (0.27 % of a Gaussian), the excess kurtosis, the correlation
    with the next, and how probable a larger Ljung-Box Q is if they are white.
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
    """Compute that beyond a normal distribution's, of values that are not all one (n,)."""
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
    """Yield what the gate (its probability, if it is ours) keeps out, and where a filter diverges.

    Outliers that come in stretches are kept out for long, as they should be.
    """
    for topic, stream in innovations.items():
        case = split_topic(topic)[1] or "the estimate"
        is_in = stream["accepted"] != 0
        times_ns = stream.publish_time_ns
        share = float(np.mean(~is_in)) if len(stream) else 0.0
        of_all, reopened, opened = f"{number(100.0 * share, 2)} % of the measurements", "", ""
        if gate is not None:
            of_all += f", where {100.0 * (1.0 - gate):.2g} % are expected"
            reopened = "; --set gate_probability=1, or gate_reopens_s=1"
            opened = "; --set gate_probability=1 until the cause is mended"
        locked_out = [] if in_stretches else _long_runs(~is_in, LOCKED_OUT)
        if locked_out:
            begin, end = locked_out[0]
            more = f" and {_times(len(locked_out) - 1)} again" if len(locked_out) > 1 else ""
            yield Finding(
                "gate",
                topic,
                f"{case}: the gate keeps out all {end - begin} measurements from "
                f"{_at(times_ns[begin], epoch_ns)} to {_at(times_ns[end - 1], epoch_ns)}{more}, "
                f"{of_all}: also what would correct the filter{reopened}",
                int(times_ns[begin]),
            )
        elif share > KEPT_OUT and not has_outliers:
            yield Finding(
                "gate",
                topic,
                f"{case}: the gate keeps out {of_all}, and they are no outliers{opened}",
            )
        yield from _divergence(topic, case, stream, epoch_ns)


def _divergence(topic: str, case: str, stream: Stream, epoch_ns: int) -> Iterator[Finding]:
    """Yield where a filter diverges, and after what."""
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
        f"{case}: diverges at {_at(found.time_ns, epoch_ns)}, after {about}: NIS per component is "
        f"{found.nis_per_component:.3g} from there on, and was as expected before",
        found.time_ns,
    )


def _long_runs(flags: NDArray[np.bool_], least: int) -> list[tuple[int, int]]:
    """Find where flags are set so many times in a row, and more: from and to."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= least]


def of_messages(streams: Iterable[Stream], epoch_ns: int) -> Iterator[Finding]:
    """Find lost, repeated and late messages, values that saturate or are coarse."""
    for stream in streams:
        if len(stream) >= FEWEST:
            yield from _of_stamps(stream, epoch_ns)
            yield from _of_values(stream)


def _of_stamps(stream: Stream, epoch_ns: int) -> Iterator[Finding]:
    stamps_ns = np.unique(stream.publish_time_ns)
    steps = np.diff(stamps_ns)
    if len(steps) >= FEWEST:
        least = float(np.quantile(steps, 0.1))
        usual = float(np.median(steps[steps < 1.5 * least]))  # also where half of the messages are lost
        multiples = np.rint(steps / usual)
        is_regular = np.abs(steps / usual - multiples) < 0.2
        gaps = np.flatnonzero(is_regular & (multiples > 1) & (multiples <= LONG_GAP))
        lost = int(np.sum(multiples[gaps] - 1))
        share = lost / (lost + len(stamps_ns))
        is_lossy = len(gaps) > LOST * len(steps) and share <= MOST_LOST
        if np.mean(is_regular) > REGULAR and is_lossy and not _are_bursts(gaps):
            yield Finding(
                "lost messages",
                stream.topic,
                f"{stream.topic}: {number(100.0 * share, 2)} % of its messages are lost: {lost} are "
                f"missing from steps of {usual * 1e-9:.3g} s, in {len(gaps)} gaps; look for them where "
                "the log is recorded",
                int(stamps_ns[gaps[0]]),
            )
        longest = int(np.argmax(steps))
        sees_targets = "target_id" in stream.columns  # and is silent where there are none
        usual = max(usual, float(np.quantile(steps, PAUSES)))
        if steps[longest] > LONG_GAP * usual and not sees_targets:
            yield Finding(
                "lost messages",
                stream.topic,
                f"{stream.topic}: silent for {steps[longest] * 1e-9:.3g} s from "
                f"{_at(stamps_ns[longest], epoch_ns)} on, where the usual step is {usual * 1e-9:.3g} s",
                int(stamps_ns[longest]),
            )
    repeated = _repeated(stream)
    if repeated > REPEATED * len(stream):
        yield Finding(
            "stamps",
            stream.topic,
            f"{stream.topic}: {repeated} message{' is' if repeated == 1 else 's are'} there twice, "
            "with equal stamp and content; leave the second of each out where the log is written",
        )
    in_order = stream.publish_time_ns[np.argsort(stream.log_time_ns, kind="stable")]
    behind = np.maximum.accumulate(in_order) - in_order
    if np.mean(behind > 0) > REPEATED:
        yield Finding(
            "stamps",
            stream.topic,
            f"{stream.topic}: {int(np.sum(behind > 0))} messages came after newer ones, up to "
            f"{behind.max() * 1e-9:.3g} s behind; in the order of arrival replay with --late rewind:"
            f"{np.ceil(behind.max() * 1e-8) / 10:.2g}",
        )


def _are_bursts(gaps: NDArray[np.integer]) -> bool:
    """Tell whether gaps come after so many messages each time, as between bursts of a sensor."""
    counts = np.diff(gaps)
    return len(counts) >= FEWEST and bool(np.mean(counts == np.median(counts)) > REGULAR)


def _repeated(stream: Stream) -> int:
    """Count the messages that equal the one before in stamp and content."""
    same = np.diff(stream.publish_time_ns) == 0
    for column in stream.columns.values():
        step = column[1:] == column[:-1]
        same &= step if step.ndim == 1 else step.all(axis=1)
    return int(same.sum())


def _of_values(stream: Stream) -> Iterator[Finding]:
    for entry in stream.schema:
        if entry.kind not in ("real", "vector") or entry.name.startswith("covariance"):
            continue
        column = stream[entry.name]
        for place, values in enumerate(column.reshape(len(column), -1).T):
            known = values[np.isfinite(values)]
            distinct = np.unique(known)
            if len(distinct) < FEWEST:
                continue
            name = entry.name if column.ndim == 1 else f"{entry.name}[{place}]"
            for extreme, what in ((distinct[0], "least"), (distinct[-1], "greatest")):
                count = int(np.sum(known == extreme))
                usual = len(known) / len(distinct)
                if count > max(SATURATED * len(known), 5.0 * usual, 5.0):
                    yield Finding(
                        "values",
                        stream.topic,
                        f"{stream.topic}: {name} saturates: {count} values are {extreme:.6g}, the "
                        f"{what}; leave these out where the log is written",
                    )
            steps = np.diff(distinct)
            quantum = float(np.median(steps))
            is_coarse = len(distinct) < 0.5 * len(known) and np.allclose(
                steps / quantum, np.rint(steps / quantum), atol=1e-3
            )
            noise = float(np.median(np.abs(np.diff(known)))) / 0.954  # of white noise: 0.954 sigma
            if is_coarse and quantum > COARSE * noise:
                yield Finding(
                    "values",
                    stream.topic,
                    f"{stream.topic}: {name} is rounded to {quantum:.3g}, more than half of its noise; "
                    "state a noise that holds the rounding, or record more digits",
                )


def of_estimates(estimates: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find variances that stop at a floor."""
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
                    f"{split_topic(topic)[1] or topic}: the variance of component {place} is "
                    f"{distinct[0]:.3g} in {100.0 * share:.2g} % of the estimates, and never smaller: a "
                    "floor that no measurement gets below",
                )


def _at(time_ns: int, epoch_ns: int) -> str:
    return f"{(int(time_ns) - epoch_ns) * 1e-9:.4g} s"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
