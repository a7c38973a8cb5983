"""Descriptions of an estimator's inputs: components of topics, and parameters with their roles."""

from functools import partial

import numpy as np

from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import AnyArgument, Floats, Settings
from fuselog.replay.engine.replaying.estimator import Reading
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.geodetic import GEODETIC, in_plane, origins_of
from fuselog.replay.inference.model.binding import Found
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.functions import ModelFunction, OfParameters
from fuselog.replay.inference.model.model import Control, Sensor
from fuselog.replay.inference.model.parameters import number_fields, settings_type
from fuselog.replay.inference.model.settings import TracedParameters, reading_settings
from fuselog.replay.inference.model.validation import trial_state
from fuselog.replay.inference.run.events import control_numbers, with_covariance, without_covariance_of

STEP = 1e-3  # change of parameters and controls for comparing their effects


def reading_of(bound_model: BoundModel, found: Found, settings: Floats) -> Reading:
    """Describe the inputs of an estimator.

    Args:
        bound_model: the bound model before tracing, with the sensors of the log.
        found: its topics.
        settings: (1 + sensors, fields), parameters of motion and sensors.
    """
    model = bound_model.model
    drives: dict[str, Control] = {}
    if model.control is not None and found.control is not None:
        drives[found.control.name] = model.control
        drives |= {topic.name: each for each, topic in found.fallbacks}
    sensors: dict[str, list[Sensor]] = {}
    for sensor, topic in found.sensors:
        sensors.setdefault(topic.name, []).append(sensor)
    kinds = {topic: ("linear",) * len(each.components) for topic, each in drives.items()}
    kinds |= {
        topic: tuple(kind for each in own for kind in each.measured.values())
        for topic, own in sensors.items()
    }

    def numbers(stream: Stream) -> Floats:
        if stream.topic in sensors:
            return np.concatenate([_measured(each, stream) for each in sensors[stream.topic]], axis=1)
        control = drives[stream.topic]
        read = control_numbers(control, gather([stream]))
        if found.control is not None and stream.topic == found.control.name:
            replaced = {name for each, _ in found.fallbacks for name in each.components}
            read = np.where([name in replaced for name in control.components], 0.0, read)
        return read

    biases, factors = _own_errors(bound_model, found)
    key = model.key_of
    return Reading(
        tuple(drives),
        kinds,
        {topic: tuple(name for each in own for name in each.measured) for topic, own in sensors.items()},
        numbers,
        {key(name): topic for name, topic in _noises(bound_model, found).items()},
        {key(name): each for name, each in _augmentable(bound_model, found).items()},
        {place: key(name) for place, name in biases.items()},
        {place: key(name) for place, name in factors.items()},
        {topic.name: key(sensor.delay) for sensor, topic in found.sensors if sensor.delay},
        {key(name): sigma for name, sigma in _calibration(bound_model, found).items()},
        partial(_control_noise, bound_model, found, settings),
    )


def _measured(sensor: Sensor, stream: Stream) -> Floats:
    """Read the measurements (n, m) of a sensor; geodetic fixes are relative to the first one."""
    ragged = gather([stream])
    if stream.schema.full_name == GEODETIC:
        ragged = in_plane(ragged, origins_of(gather([stream.take(slice(0, 1))])))
    return (
        with_covariance(sensor, ragged).value
        if sensor.covariance
        else without_covariance_of(sensor, ragged)
    )


def _noises(bound_model: BoundModel, found: Found) -> dict[str, str]:
    """Return the parameters that are standard deviations, with the topics of their sensors or ""."""
    model = bound_model.model
    names = number_fields(model.parameters)
    state = trial_state(model.kinds)
    of_motion: list[OfParameters] = []
    for motion in bound_model.modes or (bound_model.motion,):
        given = (noise for noise in (motion.noise, motion.gap_noise) if noise is not None)
        of_motion += [partial(noise, state, 1.0) for noise in given]
        if motion.control_noise is not None:
            of_motion.append(partial(motion.control_noise, 1.0))
    noises = {topic.name: sensor.noise for sensor, topic in reversed(found.sensors) if sensor.noise}
    found_noises = {name: topic for topic, noise in noises.items() for name in _squared(noise, names)}
    return found_noises | {name: "" for each in of_motion for name in _squared(each, names)}


def _squared(variances: OfParameters, names: tuple[str, ...]) -> list[str]:
    """List the parameters on whose squares a variance depends linearly."""
    traced, ones = TracedParameters(dict.fromkeys(names)), dict.fromkeys(names, 1.0)
    kind = settings_type(names)
    with np.errstate(all="ignore"):
        variances(traced)
        found = []
        for name in sorted(traced.read, key=names.index):
            none, one, two = (
                np.array(variances(kind(**{**ones, name: value})), float) for value in (0.0, 1.0, 2.0)
            )
            once, twice = one - none, two - none
            if np.any((once > 0.0) & (np.abs(twice - 4.0 * once) < 1e-6 * np.abs(once))):
                found.append(name)
    return found


def _augmentable(bound_model: BoundModel, found: Found) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the parameters that can be estimated, with their kinds and the topics that use them."""
    readers = _readers(bound_model, found)
    by_name = {
        name: (kind, tuple(dict.fromkeys(topic for topic, read in readers if name in read)))
        for name, kind in bound_model.model.augmentable.items()
    }
    return {name: (kind, topics) for name, (kind, topics) in by_name.items() if topics}


def _calibration(bound_model: BoundModel, found: Found) -> dict[str, float]:
    """Return the calibration parameters in use, with the largest useful standard deviation of each."""
    used = set().union(*(read for _, read in _readers(bound_model, found)))
    used |= {sensor.delay for sensor, _ in found.sensors}
    return {name: sigma for name, sigma in bound_model.model.calibration.items() if name in used}


def _readers(bound_model: BoundModel, found: Found) -> list[tuple[str, set[str]]]:
    """List the parameters that the motion (under "") and each sensor (under its topic) read."""
    model = bound_model.model
    names = number_fields(model.parameters)
    state, control = trial_state(model.kinds), (0.0,) * model.controls
    readers: list[tuple[str, set[str]]] = []

    def note(topic: str, function: ModelFunction, *arguments: AnyArgument) -> None:
        traced = TracedParameters(dict.fromkeys(names))
        with np.errstate(all="ignore"):
            function(*arguments, traced)
        readers.append((topic, traced.read))

    for motion in bound_model.modes or (bound_model.motion,):
        entering = ((0.0,) * motion.noises,) if motion.noises else ()
        note("", motion.move, state, control, *entering, 1.0)
    for sensor, topic in found.sensors:
        entering = ((0.0,) * sensor.noises,) if sensor.noises else ()
        note(topic.name, sensor.measure, state, *entering, (1.0,) * sensor.reference_size)
    return readers


def _own_errors(
    bound_model: BoundModel, found: Found
) -> tuple[dict[tuple[str, int], str], dict[tuple[str, int], str]]:
    """Find parameters that act as biases or factors of controls, or as biases of measurements."""
    model = bound_model.model
    kind = settings_type(number_fields(model.parameters))
    ones = kind(*(1.0,) * len(kind._fields))
    state = trial_state(model.kinds)
    biases: dict[tuple[str, int], str] = {}
    factors: dict[tuple[str, int], str] = {}
    control: Floats = 1.7 + np.arange(model.controls, dtype=np.float64)
    entering = ((0.0,) * bound_model.motion.noises,) if bound_model.motion.noises else ()

    def moved(driven: Floats, parameters: Settings) -> Floats:
        return np.array(bound_model.motion.move(state, tuple(driven), *entering, 0.5, parameters), float)

    with np.errstate(all="ignore"):
        for name in model.augmentable:
            more = ones._replace(**{name: 1.0 + STEP})
            for place, of_topic in enumerate(_driving(bound_model, found)):
                unit: Floats = STEP * np.eye(model.controls)[place]
                by_parameter = moved(control, more)
                if np.array_equal(by_parameter, moved(control, ones)):
                    continue
                if np.allclose(by_parameter, moved(control + unit, ones), rtol=0.0, atol=1e-9):
                    biases[of_topic] = name
                elif np.allclose(by_parameter, moved(control * (1.0 + unit), ones), rtol=0.0, atol=1e-9):
                    factors[of_topic] = name
            for number, (sensor, topic) in enumerate(found.sensors):
                before = sum(
                    len(each.measured) for each, of in found.sensors[:number] if of.name == topic.name
                )
                without = ((0.0,) * sensor.noises,) if sensor.noises else ()
                reference = (1.0,) * sensor.reference_size
                added = [
                    np.subtract(
                        sensor.measure(at, *without, reference, more),
                        sensor.measure(at, *without, reference, ones),
                    )
                    / STEP
                    for at in (state, trial_state(model.kinds[::-1])[::-1])
                ]
                places = np.flatnonzero(np.abs(added[0]) > 1e-9)
                if len(places) == 1 and np.allclose([each[places[0]] for each in added], 1.0, atol=1e-6):
                    biases[topic.name, before + int(places[0])] = name
    return biases, factors


def _control_noise(
    bound_model: BoundModel, found: Found, settings: Floats, step_s: float
) -> dict[tuple[str, int], float]:
    """Return the variances of the control's components, for messages that apply for `step_s`."""
    variances = bound_model.motion.control_noise
    if variances is None:
        return {}
    parameters = reading_settings(number_fields(bound_model.model.parameters))(settings, 0)
    return dict(
        zip(_driving(bound_model, found), map(float, variances(step_s, parameters)), strict=True)
    )


def _driving(bound_model: BoundModel, found: Found) -> list[tuple[str, int]]:
    """For each component of the control, list its topic and its index in that topic."""
    control = bound_model.model.control
    if control is None or found.control is None:
        return []
    replacing = {
        name: (topic.name, place)
        for each, topic in found.fallbacks
        for place, name in enumerate(each.components)
    }
    own = found.control.name
    return [replacing.get(name, (own, place)) for place, name in enumerate(control.components)]
