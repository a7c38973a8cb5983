"""Augmentation of a state by persistent measurement errors for each point of a map.

The errors model measurement noise that is not white: for example, the error of ranges to one anchor, or
between an anchor and a tag, may stay the same for seconds. This is a transformation of models: each
point or pair of points gets a component of the state, which is added to the measurements of the point or
pair. The component is a random walk or a first-order Gauss-Markov process with mean zero. Bar-Shalom, Li
and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.2.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import AnyArgument, Numbers, Settings
from fuselog.replay.inference.model.corrections import correcting_more
from fuselog.replay.inference.model.gauss_markov import (
    added_variance,
    remaining_share,
    with_gauss_markov_parameters,
)
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.settings import trial_parameters
from fuselog.replay.inference.model.validation import trial_state

Names = tuple[str, ...]


class PointError(NamedTuple):
    """Error of the `measured` component for the points with these numbers, one point per map."""

    measured: str
    numbers: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the state component for this error."""
        return "_".join(["error", self.measured, *map(str, self.numbers)])


Errors = tuple[PointError, ...]


def point_errors(where: str, model: Model, asks: str) -> list[PointError]:
    """Return the errors that an entry of `estimate` names; empty if the entry names a parameter.

    `range_m[3]` is the error of range_m for point 3; `range_m[0:8]` are the errors for points 0 to 7;
    `range_m[0:8,0:3]` are the errors for all pairs of these points with points 0 to 2 of the second map.

    Args:
        where: the estimator and option, for error messages.
        model: model with the sensors that have these errors.
        asks: the entry, such as `range_m[0:8]`.

    Raises BadInput if the model has no such measurement of points of maps.
    """
    found = re.fullmatch(r"(\w+)\[([^\[\]]*)\]", asks)
    if found is None:
        return []
    measured, numbers = found.groups()
    spans = [re.fullmatch(r" *(\d+)(?::(\d+))? *", each) for each in numbers.split(",")]
    ranges = [range(int(each[1]), int(each[2] or int(each[1]) + 1)) for each in spans if each]
    maps = max((len(each.maps) for each in model.sensors if measured in each.measured), default=0)
    if len(spans) > maps or len(ranges) < len(spans) or not all(ranges):
        raise BadInput(
            f"{where}: expected NUMBER or FIRST:END in the brackets, with a comma before those of a "
            f"second map; this model measures {measured} about the points of {maps} maps"
        )
    return [PointError(measured, pair) for pair in product(*ranges)]


@lru_cache(maxsize=64)
def with_point_errors(model: Model, errors: Errors) -> Model:
    """Return the model with these errors in its state."""
    kinds = {name: kind for each in model.sensors for name, kind in each.measured.items()}
    return replace(
        model,
        state={**model.state, **{each.name: kinds[each.measured] for each in errors}},
        parameters=with_gauss_markov_parameters(model.parameters, _names(errors)),
        sensors=tuple(sensor_with_errors(model, sensor, errors) for sensor in model.sensors),
        motion=motion_with_errors(model, model.motion, errors),
        correct=correcting_more(model, len(errors)),
        modes=model.modes
        and {name: motion_with_errors(model, each, errors) for name, each in model.modes.items()},
    )


@lru_cache(maxsize=256)
def motion_with_errors(model: Model, motion: Motion, errors: Errors) -> Motion:
    """Return the motion with these errors, which change independently."""
    n, t = model.size, model.tangent
    noises, names, inner, noise_of = motion.noises, _names(errors), motion.move, motion.noise
    given = noise_of(trial_state(model.kinds), 1.0, trial_parameters(model)) if noise_of else ()
    entries = len(given) or t

    def move(state: Numbers, control: Numbers, *others: AnyArgument) -> Numbers:
        *entering, duration_s, parameters = others
        own = (each[:noises] for each in entering)
        moved = list(inner(state[:n], control, *own, duration_s, parameters))
        for index, name in enumerate(names):
            stay = remaining_share(name, duration_s, parameters) * state[n + index]
            moved.append(stay + entering[0][noises + index] if noises else stay)
        return tuple(moved)

    def noise(state: Numbers, duration_s: float, parameters: Settings) -> Numbers:
        found = noise_of(state[:n], duration_s, parameters) if noise_of else (0.0,) * t
        return (*found, *(added_variance(name, duration_s, parameters) for name in names))

    return replace(
        motion,
        move=move,
        noise=noise,
        noises=noises + len(errors) if noises else 0,
        noise_block=t if not noises and entries != t else 0,
        jacobians=None,
        moments=None,
    )


@lru_cache(maxsize=256)
def sensor_with_errors(model: Model, sensor: Sensor, errors: Errors) -> Sensor:
    """Return the sensor with these errors added to the measurements of their points."""
    own = [
        (model.size + index, list(sensor.measured).index(each.measured), each.numbers)
        for index, each in enumerate(errors)
        if each.measured in sensor.measured
    ]
    n, size, inner = model.size, sensor.reference_size, sensor.measure

    def measure(state: Numbers, *others: AnyArgument) -> Numbers:
        *entering, reference, parameters = others
        seen = list(inner(state[:n], *entering, reference[:size], parameters))
        for place, row, numbers in own:
            seen[row] = seen[row] + _same(reference[size:], numbers) * state[place]
        return tuple(seen)

    return replace(
        sensor,
        measure=measure,
        is_numbered=bool(own),
        jacobian=None,
        log_likelihood=None if own else sensor.log_likelihood,
        moments=None,
    )


def _same(reference: Numbers, numbers: Sequence[int]) -> float:
    """Return 1 if a message refers to these points, otherwise 0."""
    found = 1.0
    for index, number in enumerate(numbers):
        found = found * (reference[index] == number)
    return found


def _names(errors: Errors) -> Names:
    return tuple(each.name for each in errors)
