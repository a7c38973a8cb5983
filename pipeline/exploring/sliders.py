"""Sliders of parameters: the choice of parameters, their ranges, and their values as text."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fuselog.pipeline.output.words import MINUS, scale
from fuselog.pipeline.tuning.tuning import value_at_start
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameter, number_of, numbers_of
from fuselog.recorders.units import parted
from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.inference.model.parameters import number_fields

STEPS = 400  # number of positions between the ends of a slider
# a positive parameter ranges from its own value divided by this to its own value times this
FACTOR = 10.0
# Range of a parameter whose own value is zero, by unit.
REACH = {"m": 1.0, "rad": 0.2, "rad/s": 0.05, "m/s": 1.0, "s": 1.0, "m/s^2": 0.5}
STEPS_OF_TICKS = (1.0, 2.0, 5.0, 10.0)
MOTION, GATE = "motion", "gate"


class Slider(Parameter):
    """A parameter that can be dragged; `default` is its value without a setting.

    Its group is a topic, `MOTION`, `GATE`, or the label of an estimator without a model.
    """

    __slots__ = ()

    @property
    def title(self) -> str:
        """Return the name without its unit, as text for readers.

        >>> Slider("sigma_range_m").title
        'sigma range'
        """
        return parted(self.name)[0].replace("_", " ")

    def place(self, value: float) -> float:
        """Compute the position of a value: 0 to 1 between the ends, otherwise outside that range."""
        value, low, high = (self._straight(each) for each in (value, self.low, self.high))
        return (value - low) / (high - low)

    def value(self, place: float) -> float:
        """Compute the value at a position from 0 to 1, with four digits unless it is the default."""
        low, high = self._straight(self.low), self._straight(self.high)
        there = low + place * (high - low)
        value = float(f"{math.exp(there) if self.is_log else there:.4g}")
        if abs(place - self.place(self.default)) < 0.5 / STEPS:
            return self.default
        return min(max(value, self.low), self.high)

    def values(self, count: int) -> list[float]:
        """Compute `count` values from end to end."""
        return [self.value(place) for place in np.linspace(0.0, 1.0, count).tolist()]

    def _straight(self, value: float) -> float:
        if not self.is_log:
            return value
        return math.log(value) if value > 0.0 else -math.inf

    def words(self, value: float) -> str:
        """Format a value with its unit."""
        return in_words(value, self.unit)


def in_words(value: float, unit: str) -> str:
    """Format a number with its unit.

    >>> in_words(0.1, "m"), in_words(0.02, "rad"), in_words(-0.99, ""), in_words(0.0, "rad")
    ('10 cm', '1.15°', '−0.99', '0°')
    """
    own = scale(unit, value)
    text = f"{value * own.factor:.3g}".replace("-", MINUS)
    return own.signed(own.text(value) if "e" in text else text)


def ticks_between(low: float, high: float, unit: str) -> dict[float, str]:
    """Choose a few round values between two ends, and format them in one unit.

    >>> ticks_between(-0.03, 0.03, "m")
    {-0.02: '−2 cm', 0.0: '0', 0.02: '2 cm'}
    """
    own = scale(unit, max(abs(low), abs(high)))
    first, last = low * own.factor, high * own.factor
    power = 10.0 ** math.floor(math.log10((last - first) / 5))
    step = power * next(each for each in STEPS_OF_TICKS if power * each >= (last - first) / 5)
    places = [place * step for place in range(math.ceil(first / step), math.floor(last / step) + 1)]
    texts = [own.signed(f"{place:.6g}".replace("-", MINUS)) if place else "0" for place in places]
    return {place / own.factor: text for place, text in zip(places, texts, strict=True)}


def sliders_of(source: LogSource | MemorySource, bound: Mapping[str, Bound]) -> list[Slider]:
    """List the parameters of filters that can be dragged, by group.

    For an estimator with a model, these are the parameters that the model's functions use on this log.
    For other estimators, they are all declared numbers, except settings that control how a program is
    run.

    Args:
        source: the log.
        bound: the filters, by label.
    """
    found: dict[str, Slider] = {}
    for label, each in bound.items():
        if each.parameters is None:
            continue
        for name, group in _groups(label, each).items():
            if name not in found and (slider := _slider(name, group, source, each)) is not None:
                found[name] = slider
    groups = dict.fromkeys([slider.group for slider in found.values() if slider.group != GATE])
    return [slider for group in (*groups, GATE) for slider in found.values() if slider.group == group]


def _groups(label: str, bound: Bound) -> dict[str, str]:
    """Return the parameters that have an effect on this log, with their groups."""
    assert bound.parameters is not None
    if not isinstance(bound, Recursive) or bound.reading is None:
        numbers = numbers_of(type(bound.parameters))
        return {name: label for name, each in numbers.items() if each.role != "setting"}
    reading = bound.reading()
    found = {name: topic or MOTION for name, topic in reading.noises.items()}
    for name, (_, topics) in reading.augmentable.items():
        found.setdefault(name, topics[0] or MOTION)
    for (topic, _), name in (*reading.biases.items(), *reading.factors.items()):
        found.setdefault(name, topic)
    found |= {name: topic for topic, name in reading.delays.items()}
    names = number_fields(type(bound.parameters))
    gate = {name: GATE for name in ("gate_probability",) if name in names}
    return dict(sorted(found.items(), key=lambda each: _order(each[1], bound.streams))) | gate


def _order(group: str, topics: Sequence[str]) -> int:
    """Return a sort key for groups: sensors in the order in which they are read, then the motion."""
    return topics.index(group) if group in topics else len(topics)


def _slider(name: str, group: str, source: LogSource | MemorySource, bound: Bound) -> Slider | None:
    """Make the slider of a parameter, or None if it is not a number or has no value on this log."""
    assert bound.parameters is not None
    try:
        each = number_of(type(bound.parameters), name)
        own = float(value_at_start(name, source, bound)[0])
    except BadInput:
        return None
    is_log = False
    if math.isfinite(each.low) and math.isfinite(each.high):
        low, high = min(each.low, own), each.high
        low = max(low, 0.5) if name == "gate_probability" else low
    elif own > 0.0 and each.low >= 0.0:
        low, high, is_log = own / FACTOR, min(own * FACTOR, each.high), True
    elif own == 0.0 and each.low >= 0.0:
        low, high = 0.0, REACH.get(each.unit, 1.0)
    else:
        reach = 0.5 * abs(own) or REACH.get(each.unit, 1.0)
        low, high = max(own - reach, each.low), min(own + reach, each.high)
    return Slider(*each._replace(default=own, low=low, high=high, is_log=is_log, group=group))


def setting_text(values: Mapping[str, float]) -> Iterable[str]:
    """Format values for `--set`.

    >>> list(setting_text({"sigma_range_m": 0.043}))
    ['--set sigma_range_m=0.043']
    """
    return [f"--set {name}={value!r}" for name, value in values.items()]
