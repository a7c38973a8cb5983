"""Hypotheses on parameters of noise, on parameters that can be estimated, and on the gate."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.changes import STATED
from fuselog.pipeline.diagnosing.advice import Advice, number, precise, rounded
from fuselog.pipeline.diagnosing.hypotheses.components import ANGLES_RAD, TURNS_RAD
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import (
    SCALES,
    Hypothesis,
    has,
    size_of,
    supposed,
    times,
)
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.tuning import value_at_start
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import (
    Parameter,
    Parameters,
    field_of,
    in_few_words,
    number_of,
    numbers_of,
)
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.replaying.estimator import Bound, Reading
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.foreign.description import ProgramParameters

GATE = 0.999
REOPENS_S, NEVER_S = 1.0, 1e9
LARGEST_SCALE = 12.0  # a logarithm
# First step of the search for a parameter, by unit; without a unit, the parameter is a factor.
STEPS = {"m": 0.3, "s": 0.05, "rad": 0.03, "rad/s": 0.01, "m/s": 0.1, "m/s^2": 0.1, "": 0.02}


def of_noises(
    bound: Sequence[Bound], source: MemorySource, readings: Mapping[str, Reading]
) -> Iterator[Hypothesis]:
    """Yield hypotheses that noises of the model, which parameters or channels state, are wrong."""
    noises = {name: topic for reading in readings.values() for name, topic in reading.noises.items()}
    parameters = bound[0].parameters
    if parameters is None:
        return
    for name, topic in noises.items():
        value = _value_of(bound, source, name)
        if value > 0.0:
            kind: Kind = "measurement noise" if topic else "process noise"
            yield _scaled(number_of(type(parameters), name), value, kind)


def of_declared(bound: Sequence[Bound], source: MemorySource) -> Iterator[Hypothesis]:
    """Yield hypotheses that an estimator's declared numbers are wrong, if what it reads is unknown.

    Noises and numbers that cannot be negative are multiplied by factors. Positive numbers in the command
    of a program that reads a log are also multiplied by factors, because nothing else is known about
    them.
    """
    parameters = bound[0].parameters
    if parameters is None:
        return
    for name, each in numbers_of(type(parameters)).items():
        value, role = _value_of(bound, source, name), each.role
        if not role or role == "setting" or name == "gate_probability" or np.isnan(value):
            continue
        is_scaled = role != "parameter" or isinstance(parameters, ProgramParameters)
        if value > 0.0 and (is_scaled or each.low >= 0.0):
            yield _scaled(each, value, role)
        elif role == "parameter":
            step = STEPS.get(each.unit, STEPS[""])
            yield _parameters([name], (value,), step, (), is_angle=False)


def _scaled(of: Parameter, value: float, kind: Kind) -> Hypothesis:
    """Make a hypothesis that a positive number is too small or too large by a factor."""
    name, what = of.name, in_few_words(of.meaning)
    named = f"{name} ({what})" if what else name
    letter = {"measurement noise": "R", "process noise": "Q"}.get(kind)

    def without(trial: Trial, logarithm: float) -> Trial:
        return trial.with_settings({name: float(value * np.exp(logarithm))})

    def words(at: float, low: float, high: float) -> str:
        so = f", so that {letter} is too {size_of(at)}" if letter else ""
        return f"{named} is {times(at, low, high)}{so}"

    def remedy(at: float) -> Advice:
        return Advice(name, rounded(value * np.exp(at)), free=name)

    return Hypothesis(kind, name, "", SCALES, LARGEST_SCALE, without, words, remedy, reported=_factor)


def _value_of(bound: Sequence[Bound], source: MemorySource, name: str) -> float:
    """Return a number's set value, otherwise its channel's value, its default, or NaN, in this order."""
    for each in bound:
        with suppress(BadInput):
            value, _ = value_at_start(name, source, each)
            if np.isfinite(value):
                return float(value)
    return np.nan


def of_covariances(stream: Stream) -> Iterator[Hypothesis]:
    """Yield hypotheses that covariances which messages or their channels state are wrong."""
    fields = [
        (field, alter.spread(field))
        for field in ("covariance_m2", "covariance_m2ps2", "covariance")
        if field in stream.columns and np.isfinite(stream[field]).any()
    ]
    if not fields and STATED in stream.metadata and "quaternion" in stream.columns:
        fields = [(STATED, alter.spread_stated(STATED))]
    for field, spread in fields:

        def words(at: float, low: float, high: float, field: str = field) -> str:
            changes = f"the standard deviation of {field} is {times(at, low, high)}"
            return f"{stream.topic}: {changes}, so that R is too {size_of(at)}"

        def remedy(at: float) -> Advice:
            return Advice(f"{stream.topic}.covariance_scale", precise(np.exp(2.0 * at)))

        # a covariance stated too small is corrected by a larger one
        def without(trial: Trial, at: float, spread: alter.Alteration = spread) -> Trial:
            return trial.altered(stream.topic, spread, at)

        kind: Kind = "measurement noise"
        yield Hypothesis(
            kind, stream.topic, "", SCALES, LARGEST_SCALE, without, words, remedy, reported=_factor
        )


def _factor(logarithm: float) -> float:
    """Convert a logarithm to the factor of a standard deviation."""
    return float(np.exp(logarithm))


def of_augmentable(bound: Sequence[Bound], readings: Mapping[str, Reading]) -> Iterator[Hypothesis]:
    """Yield hypotheses that estimable parameters are wrong, jointly for those with the same unit.

    Biases and factors of a topic's numbers are omitted, because they are tried separately. Angles are
    also tried one by one over the full circle, because units are often mounted a quarter turn off about
    one axis.
    """
    parameters = bound[0].parameters
    groups: dict[tuple[Any, ...], list[str]] = {}
    for reading in readings.values():
        own = {*reading.biases.values(), *reading.factors.values()}
        for name, (kind, topics) in reading.augmentable.items():
            value = getattr(parameters, field_of(name), None)
            if name in own or not isinstance(value, int | float):
                continue
            group = groups.setdefault((unit_of(name), kind, topics), [])
            if name not in group:
                group.append(name)
    for (unit, kind, topics), names in groups.items():
        apart = [[name] for name in names] if kind == "angle" and len(names) > 1 else []
        for some in (names, *apart):
            values = tuple(float(getattr(parameters, field_of(name))) for name in some)
            step = STEPS.get(unit, STEPS[""])
            yield _parameters(some, values, step, topics, is_angle=kind == "angle")


def _parameters(
    names: Sequence[str],
    values: tuple[float, ...],
    step: float,
    topics: Sequence[str],
    *,
    is_angle: bool,
) -> Hypothesis:
    """Make a hypothesis that some parameters have other values, with the differences as its values."""
    size = len(names)

    def numbers(by: Any) -> tuple[float, ...]:
        return tuple(by) if size > 1 else (by,)

    def without(trial: Trial, by: Any) -> Trial:
        added = np.add(values, numbers(by)).tolist()
        return trial.with_settings(dict(zip(names, added, strict=True)))

    def words(at: Any, low: Any, high: Any) -> str:
        changes = [
            f"{name} is {number(value + by)} ({number(value + least)} to {number(value + most)})"
            for name, value, by, least, most in zip(
                names, values, numbers(at), numbers(low), numbers(high), strict=True
            )
        ]
        where = " and ".join(topic or "the motion" for topic in topics)
        given = ", ".join(number(value) for value in values)
        return f"{where}{': ' if where else ''}{', '.join(changes)}, not {given}"

    def remedy(at: Any) -> Advice:
        (name, value), *more = zip(
            names, (rounded(each) for each in np.add(values, numbers(at))), strict=True
        )
        return Advice(name, value, free=" ".join(names) if size == 1 else "", more=tuple(more))

    tried: tuple[Any, ...] = ((step,) * size,) if size > 1 else (-step, step, -10.0 * step, 10.0 * step)
    is_round = is_angle and size == 1
    return Hypothesis(
        "parameter",
        names[0],
        ", ".join(names[1:]),
        ANGLES_RAD if is_round else tried,
        np.pi if is_round else np.inf,
        without,
        words,
        remedy,
        TURNS_RAD if is_round else (),
        size,
    )


def of_gate(parameters: Parameters | None) -> Iterator[Hypothesis]:
    """Yield the hypothesis that some measurements are outliers, which a gate would reject.

    The value is the time in seconds after which the gate opens again: `REOPENS_S` for single outliers,
    and `NEVER_S` for stretches of outliers, because a gate that reopens would accept some of them.
    """
    if not has(parameters, "gate_probability"):
        return
    reopens = has(parameters, "gate_reopens_s")

    def without(trial: Trial, reopens_s: float) -> Trial:
        reopening = {"gate_reopens_s": reopens_s} if reopens else {}
        return trial.with_settings({"gate_probability": GATE, **reopening})

    def words(reopens_s: float, *_: float) -> str:
        which = "some measurements" if reopens_s == REOPENS_S else "whole stretches of measurements"
        return f"{which} are outliers: they are false, or belong to another object"

    found = supposed("outliers", "gate_probability", "", without, "", Advice("gate_probability", GATE))
    yield replace(found, words=words, specials=(REOPENS_S, NEVER_S) if reopens else (REOPENS_S,))
