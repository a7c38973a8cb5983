"""The noise of a sensor at rest, with its terms, intervals, Allan deviation and notes.

Begin here. `noise` processes the columns of a log's topics, and `_analysed` processes a single column.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.api.planning import Log, sources_of
from fuselog.pipeline.sensing import preparing
from fuselog.pipeline.sensing.allan import allan_deviation, degrees_of_freedom, interval, multiples_of
from fuselog.pipeline.sensing.fitting import choose, intervals, walk_below
from fuselog.pipeline.sensing.outcome import MISFIT, ColumnNoise, SensorNoise
from fuselog.pipeline.sensing.preparing import Drift, Grid, block_means, samples_of
from fuselog.recorders import units
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.log import Stream
from fuselog.recorders.units import unit_of
from fuselog.replay.judging.intervals import Interval

Floats = NDArray[np.float64]
# probability that a fitted curve is in this interval at each of thirty times
_DOUBTFUL = 0.999
_FEWEST_DEGREES = 3.0
_BLOCK = 1 << 18  # number of messages that are read together
# Meaning of a data sheet's number by its unit; {} is replaced by the unit of the column.
_STATED = {"white": "{}/sqrt(Hz)", "walk": "{}/sqrt(s)"}
_USUAL = "rad/s", "m/s^2"  # units for columns whose names contain no unit


@without_warnings_of_numbers()
def noise(
    log: Log,
    topics: str | Iterable[str] = (),
    *,
    sheet: Mapping[str, str] | None = None,
    taus: Iterable[float] = (),
) -> SensorNoise:
    """Estimate the noise of sensors at rest, as maximum-likelihood terms with intervals.

    Args:
        log: a path, an opened log, or a recording, of a unit at rest.
        topics: topics such as `/imu` or single fields such as `/imu.turn_rate_radps`; by default all
            inertial units, or the only topic with numbers.
        sheet: values from a data sheet, by the name of a field: `{"turn_rate_radps": "0.007
            deg/s/sqrt(Hz)"}`.
        taus: times in s for which the Allan deviation is also reported.

    Returns:
        The noise of every column with 95 % intervals: its terms, and its Allan deviations.

    Raises BadInput if a unit moves, the log is too short, a column is constant, stamps decrease, too
    many messages are lost, a time is longer than a third of the log, or a unit belongs to another
    quantity.
    """
    (source,) = _one(sources_of(log))
    stated = {name: (text, *parse_sheet(name, text)) for name, text in (sheet or {}).items()}
    wanted = [topics] if isinstance(topics, str) else list(topics)
    found: list[ColumnNoise] = []
    for topic, fields in _chosen(source, wanted).items():
        fields = fields or _numbers(source.empty(topic))
        grid, columns = _read(source, topic, fields)
        for name in list(columns):
            values = columns.pop(name)  # the memory of a field is released when it has been analysed
            for place, column in enumerate(values):
                if np.isfinite(column).any():
                    component = "xyz"[place] if len(values) == 3 else str(place)
                    where = topic, name, component if source.empty(topic)[name].ndim > 1 else ""
                    found.append(_analysed(where, column, grid, stated.get(name), list(taus)))
    unknown = set(stated) - {each.field for each in found}
    if unknown:
        name = min(unknown)
        raise BadInput(f"--sheet {name}: {choices(name, sorted({each.field for each in found}))}")
    return SensorNoise(source.name, found)


def parse_sheet(field: str, text: str) -> tuple[str, float]:
    """Parse a value from a data sheet to `white` or `walk` and a number in our units.

    A one-sided density, as spectrum analysers show it, is sqrt(2) times the two-sided one.

    Raises BadInput if the text is not a number with a unit, or the unit belongs to another quantity.
    """
    found = re.fullmatch(r"\s*((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s+(\S.*?)\s*(one-sided)?\s*", text)
    value = float(found[1]) if found else 0.0
    if found is None or not 0.0 < value < math.inf:
        example = "expected a number and a unit, such as '0.007 deg/s/sqrt(Hz)'"
        raise BadInput(f"--sheet {field}={text}: {example}")
    written = found[2].replace("°", "deg").replace("µ", "u")
    try:
        here = units.unit(written)
    except BadInput as error:
        raise BadInput(f"--sheet {field}={text}: {error}") from None
    own = unit_of(field)
    for column, (term, of) in product([own] if own else _USUAL, _STATED.items()):
        there = units.unit(of.format(column))
        if here.powers == there.powers:
            return term, value * here.size / there.size / (math.sqrt(2) if found[3] else 1.0)
    wanted = " or ".join(of.format(own or "UNIT") for of in _STATED.values())
    raise BadInput(f"--sheet {field}={text}: {written} is not {wanted}; give a unit of that kind")


def _one(sources: Sequence[Any]) -> Sequence[Any]:
    if len(sources) != 1:
        raise BadInput(f"{len(sources)} logs: give one log; noise analyses one at a time")
    return sources


def _chosen(source: Any, wanted: Sequence[str]) -> dict[str, list[str]]:
    """Choose the topics and their fields, if fields are given."""
    chosen: dict[str, list[str]] = {}
    for text in wanted:
        topic, _, name = (text, "", "") if text in source.topics else text.rpartition(".")
        if topic not in source.topics:
            raise BadInput(f"{source.name}: has no topic {text}; {choices(text, list(source.topics))}")
        if name and name not in _numbers(source.empty(topic)):
            known = _numbers(source.empty(topic))
            raise BadInput(f"{topic}: has no numeric field {name}; {choices(name, known)}")
        chosen.setdefault(topic, []).extend([name] if name else [])
    if wanted:
        return chosen
    usable = {topic: _numbers(source.empty(topic)) for topic in source.topics}
    units = [topic for topic, names in usable.items() if "specific_force_mps2" in names]
    candidates = units or [topic for topic, names in usable.items() if names]
    if not candidates or (len(candidates) > 1 and not units):
        raise BadInput(
            f"{source.name}: has no inertial unit; choose with --topic from: {', '.join(candidates)}"
        )
    return {topic: [] for topic in candidates}


def _numbers(stream: Stream) -> list[str]:
    """List the fields with real numbers, except covariances."""
    return [
        name
        for name, column in stream.columns.items()
        if column.dtype.kind == "f" and "covariance" not in name
    ]


def _read(source: Any, topic: str, fields: Sequence[str]) -> tuple[Grid, dict[str, Floats]]:
    """Read the grid of a topic, and those fields (components, n) that are not NaN throughout.

    Every block is copied directly into the result, because many arrays of blocks would leave gaps in
    memory.
    """
    most, count = source.topics[topic].messages, 0
    stamps, position = np.empty((2, most), np.int64)
    columns: dict[str, Floats] = {}
    for block in source.blocks([topic], "publish_time", _BLOCK):
        if topic in block:
            part, rows = block[topic], slice(count, count + len(block[topic]))
            stamps[rows], position[rows] = part.publish_time_ns, part.position
            for name in fields:
                values = part[name].reshape(len(part), -1).T
                if name not in columns and np.isfinite(values).any():
                    columns[name] = np.full((len(values), most), np.nan)
                if name in columns:
                    columns[name][:, rows] = values
            count = rows.stop
    found = {name: columns[name][:, :count] for name in fields if name in columns}
    return preparing.grid_of(topic, stamps[:count], position[:count]), found


def _analysed(
    where: tuple[str, str, str],
    column: Floats,
    grid: Grid,
    stated: tuple[str, str, float] | None,
    taus_s: Sequence[float],
) -> ColumnNoise:
    topic, name, component = where
    title = f"{topic}.{name}" + (f".{component}" if component else "")
    unit = unit_of(name) or "unit"
    values, step_s, notes = preparing.on_grid(column, grid), grid.step_s, []
    preparing.check_at_rest(title, name, values, step_s)
    if grid.lost:
        notes.append(f"{100 * grid.lost:.2g} % of the messages are lost; gaps are found from the stamps")
    if line := preparing.find_vibration(values, step_s):
        notes.append(f"vibrates at {line[0]:.4g} Hz with {line[1]:.2g} {unit}; the numbers include this")
    values = values - values[np.isfinite(values)][0]
    drift = preparing.find_drift(values, step_s)
    if drift is not None:
        notes.append(_drifts(drift, unit))
        values = values - drift.over(step_s * np.arange(len(values), dtype=float))
    block = preparing.white_block(values, step_s)
    samples = samples_of(block_means(values, block), step_s * block)
    if block > preparing.fewest_block(len(values)):
        notes.append(
            f"samples are correlated; means of {block} samples ({block * step_s:.3g} s) are white"
        )
    fitted = choose(samples)
    numbers = {
        name: Interval(getattr(fitted.terms, name), *ends)
        for name, ends in intervals(samples, fitted).items()
    }
    if not {"walk", "markov"} & set(fitted.free):
        numbers["walk"] = Interval(0.0, 0.0, walk_below(samples, fitted))
        notes.append(f"no random walk found; K < {numbers['walk'].high:.2g} {unit}/sqrt(s)")
    if drift is not None and not drift.offset:
        reach = 1.96 * drift.rate_sigma
        numbers["ramp"] = Interval(drift.rate, drift.rate - reach, drift.rate + reach)
    multiples = multiples_of(len(values))
    measured = allan_deviation(values, step_s, multiples)
    degrees = np.array(
        [
            degrees_of_freedom(fitted.terms, step_s, int(m), int(pairs)) if pairs else np.nan
            for m, pairs in zip(multiples, measured.pairs, strict=True)
        ]
    )
    found = ColumnNoise(*where, step_s, block, numbers, fitted, measured, degrees, ())
    notes += [*_misfits(found), *_read_at(found, taus_s, values), _least(found, unit)]
    if stated is not None:
        notes.append(_against(stated, numbers, unit))
    return replace(found, notes=[f"{title}: {each}" for each in notes])


def _drifts(drift: Drift, unit: str) -> str:
    if drift.offset:
        return (
            f"warms up: {drift.offset:.2g} {unit} decays with a time constant of {drift.time_s:.3g} "
            f"s, plus {drift.rate:.2g} {unit}/s; both are removed from all numbers (log-likelihood "
            f"+{drift.gain:.3g})"
        )
    return (
        f"drifts by {drift.rate:.3g} {unit}/s; this is removed from all numbers "
        f"(log-likelihood +{drift.gain:.3g})"
    )


def _misfits(found: ColumnNoise) -> list[str]:
    """Report where the fitted model's curve is outside the interval of the measured one."""
    low, high = interval(found.curve.deviations, found.degrees, _DOUBTFUL)
    model, taus_s = found.model_deviations, found.curve.taus_s
    is_seen = (found.degrees > _FEWEST_DEGREES) & (taus_s > 0.99 * found.block * found.step_s)
    beyond = is_seen & ((model < low) | (model > high))
    if not beyond.any():
        return []
    ratio = model / found.curve.deviations
    worst = int(np.argmax(np.where(beyond, np.abs(np.log(ratio)), 0.0)))
    return [
        f"{MISFIT}{found.fitted.words} does not explain it: at {taus_s[worst]:.3g} s the model's Allan "
        f"deviation is {ratio[worst]:.2g} times the measured one, outside its 99.9 % interval at "
        f"{int(beyond.sum())} of {int(is_seen.sum())} times; do not trust the numbers at these times"
    ]


def _read_at(found: ColumnNoise, taus_s: Sequence[float], values: Floats) -> list[str]:
    longest_s = len(values) // 3 * found.step_s
    sentences = []
    for tau_s in taus_s:
        m = round(tau_s / found.step_s)
        if not 1 <= m <= len(values) // 3:
            raise BadInput(
                f"--tau {tau_s:g}: the log allows {found.step_s:.3g} to {longest_s:.4g} s (a third of "
                "its length); give a time in this range"
            )
        at = allan_deviation(values, found.step_s, np.array([m]))
        degrees = degrees_of_freedom(found.fitted.terms, found.step_s, m, int(at.pairs[0]))
        low, high = interval(at.deviations, np.array([degrees]))
        sentences.append(
            f"Allan deviation at {at.taus_s[0]:.4g} s: {at.deviations[0]:.4g} "
            f"({low[0]:.4g} to {high[0]:.4g}) {unit_of(found.field) or 'unit'}"
        )
    return sentences


def _least(found: ColumnNoise, unit: str) -> str:
    """Report the minimum of the curve, which data sheets call bias instability, in both conventions."""
    least = int(np.nanargmin(np.where(found.degrees > _FEWEST_DEGREES, found.curve.deviations, np.inf)))
    value = float(found.curve.deviations[least])
    return (
        f"minimum Allan deviation {value:.3g} {unit} at {found.curve.taus_s[least]:.3g} s (as flicker "
        f"noise, divided by 0.664: {value / 0.664283:.3g}); white noise with a random walk has a "
        "minimum too"
    )


def _against(stated: tuple[str, str, float], numbers: Mapping[str, Interval], unit: str) -> str:
    text, term, value = stated
    if term not in numbers:
        return f"the data sheet states {text}, but no {term} was found to compare with"
    yours = numbers[term].rising(lambda each: each / value)
    ends = f"{yours.low:.3g} to {yours.high:.3g}"
    kind = "sqrt(Hz)" if term == "white" else "sqrt(s)"
    return (
        f"the data sheet states {text} ({value:.4g} {unit}/{kind}); the estimate is {yours.value:.3g} "
        f"({ends}) times this value"
    )
