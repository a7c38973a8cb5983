"""Hypotheses on the numbers that are read from a topic: factors, signs, biases, axes, conventions."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.changes import AXES, bare
from fuselog.pipeline.altering.entries import Entry, entries_of
from fuselog.pipeline.diagnosing.advice import Advice, number, precise, rounded
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import (
    Hypothesis,
    in_sense,
    in_topic,
    supposed,
    value_of,
)
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.units import mistaken, unit_of
from fuselog.replay.engine.replaying.estimator import Reading

FACTORS = (-0.02, 0.02, -0.4, 0.4)  # first values of the search for a logarithm
ANGLES_RAD = (-0.03, 0.03, -0.3, 0.3, -1.5, 1.5)
TURNS_RAD = (0.5 * np.pi, -0.5 * np.pi, np.pi)
# first values of the search, relative to the variation of the numbers
SHARES = (-0.001, 0.001, -0.01, 0.01, -0.1, 0.1, -1.0, 1.0)
LARGEST_FACTOR = 12.0  # a logarithm


def of_components(
    stream: Stream, reading: Reading | None, parameters: Parameters | None, first_ns: int
) -> Iterator[Hypothesis]:
    """Yield all faults of the numbers in a topic; a drifting bias begins to grow at `first_ns`."""
    is_control = reading is not None and stream.topic in reading.controls
    entries = entries_of(stream, reading)
    if "latitude_deg" in stream.columns:
        return
    span_s = 1e-9 * float(np.ptp(stream.publish_time_ns)) or 1.0
    for each in entries:
        own = _Own.of(stream, each, reading, parameters)
        if each.is_heading:
            yield from _of_heading(stream.topic, first_ns, span_s)
            continue
        if reading is not None:
            stretch = 0.0 if is_control else 1.0
            yield _factor(stream.topic, each, stretch, own)
            yield _sign(stream.topic, each)
            yield _drift(stream.topic, each, first_ns, span_s)
        yield _bias(stream.topic, each, own)
    for field in dict.fromkeys(each.field for each in entries if each.place is not None):
        places = [int(each.place or 0) for each in entries if each.field == field]
        if field in ("position_m", "velocity_mps") and len(places) > 1:
            yield _turn(stream.topic, field)
        if reading is None or len(places) < 2:
            continue
        whole = Entry(field, None, field, False, None, 1.0)
        yield _factor(stream.topic, whole, 0.0 if is_control else len(places), None)
        if len(places) > 2:  # two swapped axes amount to half a turn
            yield _sign(stream.topic, whole)
        for pair in combinations(places, 2):
            yield _exchange(stream.topic, field, pair)


class _Own(NamedTuple):
    """The parameters for the bias and the factor of a topic's number.

    A bias of the number is multiplied by `bias_sign` to obtain the change of the parameter `bias`, whose
    current value is `bias_value`.
    """

    bias: str
    bias_sign: float
    bias_value: float
    factor: str

    @staticmethod
    def of(
        stream: Stream, entry: Entry, reading: Reading | None, parameters: Parameters | None
    ) -> "_Own | None":
        if reading is None or entry.number is None:
            return None
        key = stream.topic, entry.number
        bias, factor = reading.biases.get(key, ""), reading.factors.get(key, "")
        sign = -1.0 if stream.topic in reading.controls else 1.0
        return _Own(bias, sign, value_of(parameters, bias, stream), factor)


def _factor(topic: str, entry: Entry, stretch: float, own: _Own | None) -> Hypothesis:
    units = mistaken(unit_of(entry.name))
    specials = {float(np.log(size)): f"is in {name}" for name, size in units.items()}
    specials |= {float(-np.log(size)): f"is converted from {name} twice" for name, size in units.items()}

    def words(at: float, low: float, high: float) -> str:
        more = f", as if it {specials[at]}" if at in specials else ""
        ends = [0.0, max(abs(low), abs(high))] if low * high <= 0.0 else sorted((abs(low), abs(high)))
        size = "large" if at > 0.0 else "small"
        factor, least, most = (number(np.exp(each), 4) for each in (abs(at), *ends))
        return f"{topic}: {entry.name} is {factor} times ({least} to {most}) too {size}{more}"

    def remedy(at: float) -> Advice:
        key, free = f"{topic}.{bare(entry.name)}_scale", own.factor if own else ""
        return Advice(key, precise(np.exp(-at)), free=free)

    without = in_topic(topic, alter.multiplied(entry.field, entry.place), stretch)
    return Hypothesis(
        "factor or sign",
        topic,
        entry.name,
        FACTORS,
        LARGEST_FACTOR,
        without,
        words,
        remedy,
        tuple(specials),
        reported=lambda at: float(np.exp(at)),
    )


def _sign(topic: str, entry: Entry) -> Hypothesis:
    turned = alter.scaled(entry.field, entry.place)
    return supposed(
        "factor or sign",
        topic,
        entry.name,
        in_topic(topic, lambda stream, _: turned(stream, -1.0)),
        f"{topic}: {entry.name} has the wrong sign",
        Advice(f"{topic}.{bare(entry.name)}_scale", -1),
        reported=lambda _: -1.0,
    )


def _bias(topic: str, entry: Entry, own: _Own | None) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        is_so, size, least, most = in_sense(at, low, high)
        bias = f"{topic}: {entry.name} is {is_so} by {number(size)} ({number(least)} to {number(most)})"
        if not entry.is_angle:
            return bias
        return f"{bias}, or equivalently the sensor's frame is rotated by {np.degrees(-at):.2g} deg"

    def remedy(at: float) -> Advice:
        if own and own.bias:
            return Advice(own.bias, rounded(own.bias_value + own.bias_sign * at), free=own.bias)
        return Advice(f"{topic}.{bare(entry.name)}_bias", precise(at))

    return Hypothesis(
        "bias or turned frame",
        topic,
        entry.name,
        tuple(entry.varies * share for share in SHARES[: 6 if entry.is_angle else None]),
        np.pi if entry.is_angle else np.inf,
        in_topic(topic, alter.shifted(entry.field, entry.place)),
        words,
        remedy,
    )


def _drift(topic: str, entry: Entry, first_ns: int, span_s: float) -> Hypothesis:
    return _growing(
        topic,
        entry.name,
        tuple(entry.varies * share / span_s for share in SHARES),
        alter.ramped(first_ns, entry.field, entry.place),
    )


def _growing(
    topic: str, name: str, tried: tuple[float, ...], alteration: alter.Alteration
) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        is_so, at, low, high = in_sense(at, low, high)
        return (
            f"{topic}: {name} is {is_so} by {number(at)} ({number(low)} to {number(high)}) more each "
            "second"
        )

    def remedy(at: float) -> Advice:
        return Advice(f"{topic}.{bare(name)}_drift", precise(at))

    kind: Kind = "drifting bias"
    return Hypothesis(kind, topic, name, tried, np.inf, in_topic(topic, alteration), words, remedy)


def _turn(topic: str, field: str) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        at, low, high = (float(np.degrees(each)) for each in (at, low, high))
        size = f"{at:.3g} ({low:.3g} to {high:.3g}) deg"
        return f"{topic}: {field} is rotated about the vertical by {size}"

    def remedy(at: float) -> Advice:
        return Advice(f"{topic}.{bare(field)}_turn", precise(at))

    without = in_topic(topic, alter.turned(field))
    kind: Kind = "bias or turned frame"
    return Hypothesis(kind, topic, field, ANGLES_RAD, np.pi, without, words, remedy, TURNS_RAD)


def _exchange(topic: str, field: str, pair: tuple[int, int]) -> Hypothesis:
    first, second = pair
    order = list(range(max(pair) + 1))
    order[first], order[second] = second, first
    axes = "".join(AXES[each] for each in order)
    names = f"{AXES[first]} and {AXES[second]}"
    return supposed(
        "exchanged axes",
        topic,
        field,
        in_topic(topic, alter.permuted(field, order)),
        f"{topic}: {names} of {field} are swapped",
        Advice(f"{topic}.{bare(field)}_axes", axes),
    )


def _of_heading(topic: str, first_ns: int, span_s: float) -> Iterator[Hypothesis]:
    """Yield faults of the headings of orientations."""

    def words(at: float, low: float, high: float) -> str:
        at, low, high = (float(np.degrees(each)) for each in (at, low, high))
        is_so, at, low, high = in_sense(at, low, high)
        return (
            f"{topic}: the heading is {is_so} by {at:.3g} ({low:.3g} to {high:.3g}) deg: an offset, "
            "the magnetic declination or the sensor's mounting, which have the same effect"
        )

    kind: Kind = "bias or turned frame"
    yield Hypothesis(
        kind,
        topic,
        "heading_rad",
        ANGLES_RAD,
        np.pi,
        in_topic(topic, alter.heading_turned),
        words,
        lambda at: Advice(f"{topic}.heading_bias", precise(at)),
        TURNS_RAD,
    )
    rates = tuple(share / span_s for share in SHARES)
    yield _growing(topic, "heading_rad", rates, alter.heading_ramped(first_ns))
    yield supposed(
        "factor or sign",
        topic,
        "heading_rad",
        in_topic(topic, lambda stream, _: alter.heading_multiplied(stream, -1.0)),
        f"{topic}: the heading has the wrong sign",
        Advice(f"{topic}.heading_scale", -1),
        reported=lambda _: -1.0,
    )
    yield supposed(
        "convention",
        topic,
        "heading_rad",
        in_topic(topic, alter.heading_from_north),
        f"{topic}: the heading is clockwise from north, not anticlockwise from east",
        Advice(f"{topic}.heading_convention", "north"),
    )
