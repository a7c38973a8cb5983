"""The update: a Gaussian through a model's sensor by its derivative, the innovation, the Kalman gain."""

from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.arrays import Floats, Function
from replay.engine.streams.results import ALL_WELL
from replay.inference.kalman.steps import NOT_POSITIVE_DEFINITE, NOTHING_MEASURED, Note, Workspace
from replay.inference.linear_algebra.gaussian import (
    LOG_TWO_PI,
    Innovation,
    add_through,
    kalman_step,
    keep_measured,
    reduce_covariance,
    whiten,
    widen,
    widening,
    wrap,
)
from replay.inference.linear_algebra.linearization import Input, derivative, known_entries
from replay.inference.linear_algebra.sparse import Pattern, measuring_covariance, pattern_of
from replay.inference.linear_algebra.tuples import adding_noise, filling, tuple_of
from replay.inference.model.corrections import correcting, sloping
from replay.inference.model.model import Model, Sensor
from replay.inference.model.stage import Stage


class Reading(NamedTuple):
    """How a sensor's message stands in an event's data: measured, what it is about, its own noise."""

    width: int
    measured: Function
    about: Function
    noise: Function


def reading(sensor: Sensor) -> Reading:
    """Where the numbers of a sensor's message stand; the noise is the rows of a lower triangle."""
    m, about = len(sensor.measured), sensor.about_size
    triangle = m * (m + 1) // 2 if sensor.covariance else 0
    return Reading(m + about + triangle, tuple_of(m), tuple_of(about, m), tuple_of(triangle, m + about))


def sensor_noise(sensor: Sensor) -> Function:
    """`add(spread, data, parameters, work)`: the measurement noise onto a covariance (m, m)."""
    m = len(sensor.measured)
    if sensor.covariance:
        read, add_message = reading(sensor).noise, adding_noise(m)

        def add_read(spread: Floats, data: Floats, parameters: Any, work: Any) -> None:
            add_message(spread, read(data))

        return add_read
    variances = sensor.noise
    assert variances is not None
    if sensor.noises:
        noises, fill = sensor.noises, filling(sensor.noises)

        def add_entering(spread: Floats, data: Floats, parameters: Any, work: Any) -> None:
            fill(work.noise_variance[:noises], variances(parameters))
            add_through(spread, work.noise_gain, work.noise_variance[:noises])

        return add_entering
    add_noise = adding_noise(m)

    def add(spread: Floats, data: Floats, parameters: Any, work: Any) -> None:
        add_noise(spread, variances(parameters))

    return add


def sensor_derivative(model: Model, sensor: Sensor) -> Function:
    """`linearise(state, about, parameters, work)`: fills `predicted`, `rows` and `noise_gain`."""
    if sensor.jacobian is not None:
        measure, jacobian, fill = sensor.measure, sensor.jacobian, filling(len(sensor.measured))

        def by_hand(state: Any, about: Any, parameters: Any, work: Any) -> None:
            jacobian(state, about, parameters, work.rows)
            fill(work.predicted, measure(state, about, parameters))

        return by_hand
    inputs = [Input("state", model.kinds, "rows")]
    if sensor.noises:
        inputs.append(Input("noise", ("linear",) * sensor.noises, "noise_gain", zero=True))
    kinds = tuple(sensor.measured.values())
    return derivative(sensor.measure, inputs, kinds, "predicted")


def linear_sensor(stage: Stage, number: int) -> Function:
    """`innovate(mean, covariance, data, parameters, use, work)` by the derivative at the mean."""
    sensor = stage.sensors[number]
    read_state, read = tuple_of(stage.model.size), reading(sensor)
    read_about = read.about
    linearise = sensor_derivative(stage.model, sensor)
    pattern = pattern_of(known_entries(linearise, "rows"), len(sensor.measured))
    compare = linear_innovation(sensor, number, pattern)

    def innovate(
        mean: Floats, covariance: Floats, data: Floats, parameters: Any, use: int, work: Workspace
    ) -> bool:
        linearise(read_state(mean), read_about(data), parameters, work)
        compare(covariance, data, parameters, work)
        return True

    return innovate


def linear_innovation(sensor: Sensor, number: int, pattern: Pattern | None = None) -> Function:
    """`compare(covariance, data, parameters, work)`: the innovation of a linearised measurement.

    From the workspace's `predicted` and `rows`, of this pattern: v = y - h, C = P H' and S = H C + R.
    """
    m, angular = len(sensor.measured), tuple(kind == "angle" for kind in sensor.measured.values())
    add_noise, measure_covariance = sensor_noise(sensor), measuring_covariance(pattern)

    def compare(covariance: Floats, data: Floats, parameters: Any, work: Workspace) -> None:
        difference, spread, cross = work.innovations[number]
        for i in range(m):
            difference[i] = wrap(data[i] - work.predicted[i], angular[i])
        measure_covariance(covariance, work.rows, cross, spread)
        add_noise(spread, data, parameters, work)

    return compare


def whitening(sensor: Sensor, number: int) -> Function:
    """`whiten_residual(data, parameters, work)`: a linearised measurement in units of its noise.

    From the workspace's `predicted` and `rows`, with R = L L': the innovation's difference becomes
    L^-1 (y - h), its cross-covariance H' L^-T. Returns how many components were measured, and the square
    of the residual, NaN where R is not positive definite.
    """
    m, angular = len(sensor.measured), tuple(kind == "angle" for kind in sensor.measured.values())
    add_noise = sensor_noise(sensor)

    def whiten_residual(data: Floats, parameters: Any, work: Workspace) -> tuple[int, float]:
        innovation = work.innovations[number]
        difference, noise, turned = innovation
        for i in range(m):
            difference[i] = wrap(data[i] - work.predicted[i], angular[i])
            for k in range(len(turned)):
                turned[k, i] = work.rows[i, k]
            for j in range(m):
                noise[i, j] = 0.0
        add_noise(noise, data, parameters, work)
        size = keep_measured(innovation)
        squared, _ = whiten(innovation, size)
        kalman_step(innovation, size, work.step)
        return size, squared

    return whiten_residual


def slots_of(sensors: tuple[Sensor, ...]) -> dict[str, str]:
    """All components that these sensors measure, by name with their kinds: those of the innovations."""
    slots: dict[str, str] = {}
    for sensor in sensors:
        for name, kind in sensor.measured.items():
            if slots.setdefault(name, kind) != kind:
                raise BadInput(
                    f"sensor {sensor.topic}: {name} is {kind} here and {slots[name]} elsewhere"
                )
    return slots


def noting(stage: Stage, number: int) -> Function:
    """`tell(innovation, note)`: the innovation of sensor `number` into the slots of the results."""
    slots = list(slots_of(stage.sensors))
    places = tuple(slots.index(name) for name in stage.sensors[number].measured)

    def tell(innovation: Innovation, note: Note) -> None:
        for i in range(len(places)):
            note.difference[places[i]] = innovation.difference[i]
            for j in range(len(places)):
                missing = np.isnan(innovation.difference[i] + innovation.difference[j])
                entry = np.nan if missing else innovation.covariance[i, j]
                note.covariance[places[i], places[j]] = entry

    return tell


def kalman_update(stage: Stage, number: int, innovate: Function) -> Function:
    """The Kalman update by sensor `number`, after `innovate` has filled its innovation.

    Missing components are left out of v, S and C, and so are those of which the model predicts nothing
    (NaN); the log-likelihood is that of the components present. It is zero where the gate is shut, as it
    is where none is left. `gate` (m + 1,) bounds the NIS by the number of components. What the gate lets
    in may still count less, see `gaussian.widening`.
    """
    model, m, tell = stage.model, len(stage.sensors[number].measured), noting(stage, number)
    find_slope = sloping(model.kinds, model.correct)
    correct = correcting(model.kinds, model.correct)

    def update(
        mean: Floats,
        covariance: Floats,
        data: Floats,
        parameters: Any,
        gate: Floats,
        use: int,
        work: Workspace,
        note: Note,
    ) -> int:
        present = 0
        for i in range(m):
            present += not np.isnan(data[i])
        if present == 0:
            return NOTHING_MEASURED
        innovation = work.innovations[number]
        if not innovate(mean, covariance, data, parameters, use, work):
            return NOT_POSITIVE_DEFINITE
        tell(innovation, note)
        size = keep_measured(innovation)
        squared, determinant = whiten(innovation, size)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        accepted = size > 0 and squared <= gate[size]
        factor = widening(squared, size, parameters)
        if accepted:
            if factor != 1.0:
                widen(innovation, size, factor)
            kalman_step(innovation, size, work.step)
            reduce_covariance(covariance, innovation.cross_covariance, size)
            find_slope(mean, covariance, work.slope)
            correct(mean, covariance, work)
        note_numbers(note, squared, determinant, size, accepted, factor)
        return ALL_WELL

    return update


def note_numbers(
    note: Note, squared: float, determinant: float, size: int, accepted: bool, factor: float
) -> None:
    """Note the NIS, the log-likelihood (zero where the gate is shut) and whether it is.

    The NIS is that of the covariance as predicted, the likelihood of one that is `factor` times larger.
    """
    note.numbers[0] = squared
    note.numbers[1] = 0.0
    note.numbers[2] = 1.0 if accepted else 0.0
    if accepted:
        wider = 0.0
        if factor != 1.0:
            wider = np.log(factor)
        note.numbers[1] = -0.5 * (squared / factor + determinant + size * (LOG_TWO_PI + wider))
