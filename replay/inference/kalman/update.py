"""Update of a Gaussian by a sensor: linearisation, innovation, and Kalman gain."""

from typing import NamedTuple, Protocol

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats, Numbers, Settings
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.steps import (
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    CoreMemory,
    Innovate,
    InnovationRecord,
    Measurement,
    Update,
    Workspace,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    LOG_TWO_PI,
    Innovation,
    add_through,
    downdate,
    drop_missing,
    kalman_step,
    whiten,
    whiten_kept,
    wrap,
)
from fuselog.replay.inference.linear_algebra.inflation import inflate, inflation
from fuselog.replay.inference.linear_algebra.linearization import Input, derivative, known_entries
from fuselog.replay.inference.linear_algebra.sparse import Pattern, measuring_covariance, pattern_of
from fuselog.replay.inference.linear_algebra.tuples import ReadTuple, adding_noise, filling, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.corrections import correcting, sloping
from fuselog.replay.inference.model.model import Model, Sensor


class MessageLayout(NamedTuple):
    """Layout of a sensor's message in the data of an event: measurement, reference, and stated noise."""

    width: int
    measured: ReadTuple
    reference: ReadTuple
    noise: ReadTuple


class Subtract(Protocol):
    """Function that fills measurement minus prediction (m,); the measurement is first in the data."""

    def __call__(self, data: Floats, predicted: Floats, difference: Floats, /) -> None: ...


class MeasurementNoise(Protocol):
    """Function that adds the measurement noise R to S (m, m)."""

    def __call__(
        self, spread: Floats, data: Floats, parameters: Settings, work: CoreMemory, /
    ) -> None: ...


class LineariseSensor(Protocol):
    """Function that fills the workspace's `predicted` h (m,), `rows` H (m, t) and `noise_gain`."""

    def __call__(
        self, state: Numbers, reference: Numbers, parameters: Settings, work: CoreMemory, /
    ) -> None: ...


class CompareLinear(Protocol):
    """Function that computes the innovation of a linearised measurement; see `linear_innovation`."""

    def __call__(
        self, covariance: Floats, data: Floats, parameters: Settings, work: Workspace, /
    ) -> None: ...


class WhitenResidual(Protocol):
    """Function that expresses a linearised measurement in units of its noise; see `whitening`."""

    def __call__(self, data: Floats, parameters: Settings, work: Workspace, /) -> tuple[int, float]: ...


class WriteInnovation(Protocol):
    """Function that writes the innovation of a sensor to the slots of its components in the record."""

    def __call__(self, innovation: Innovation, record: InnovationRecord, /) -> None: ...


def message_layout(sensor: Sensor) -> MessageLayout:
    """Return the layout of a sensor's message; the noise is stored as rows of a lower triangle."""
    m, reference = len(sensor.measured), sensor.reference_size
    triangle = m * (m + 1) // 2 if sensor.covariance else 0
    return MessageLayout(
        m + reference + triangle, tuple_of(m), tuple_of(reference, m), tuple_of(triangle, m + reference)
    )


def residual_of(sensor: Sensor) -> Subtract:
    """Make `subtract(data, predicted, difference)`: measurement minus prediction, (m,).

    Differences of angles are wrapped to at most half a turn.
    """
    angular = tuple(kind == "angle" for kind in sensor.measured.values())

    def subtract(data: Floats, predicted: Floats, difference: Floats) -> None:
        for i in range(len(angular)):
            difference[i] = wrap(data[i] - predicted[i], angular[i])

    return subtract


def sensor_noise(sensor: Sensor) -> MeasurementNoise:
    """Make `add(spread, data, parameters, work)`, which adds the measurement noise R to S (m, m)."""
    m = len(sensor.measured)
    if sensor.covariance:
        read, add_message = message_layout(sensor).noise, adding_noise(m)

        def add_read(spread: Floats, data: Floats, parameters: Settings, work: CoreMemory) -> None:
            add_message(spread, read(data))

        return add_read
    variances = sensor.noise
    assert variances is not None
    if sensor.noises:
        noises, fill = sensor.noises, filling(sensor.noises)

        def add_entering(spread: Floats, data: Floats, parameters: Settings, work: CoreMemory) -> None:
            fill(work.noise_variance[:noises], variances(parameters))
            add_through(spread, work.noise_gain, work.noise_variance[:noises])

        return add_entering
    add_noise = adding_noise(m)

    def add(spread: Floats, data: Floats, parameters: Settings, work: CoreMemory) -> None:
        add_noise(spread, variances(parameters))

    return add


def sensor_derivative(model: Model, sensor: Sensor) -> LineariseSensor:
    """Make `linearise(state, reference, parameters, work)`, which computes the derivatives of a sensor.

    It fills `predicted` (m,), `rows` (m, t) and `noise_gain` in the workspace.

    Args:
        model: the model, for the kinds of the state.
        sensor: the sensor, with m measured components.
    """
    if sensor.jacobian is not None:
        measure, jacobian, fill = sensor.measure, sensor.jacobian, filling(len(sensor.measured))

        def by_hand(state: Numbers, reference: Numbers, parameters: Settings, work: CoreMemory) -> None:
            jacobian(state, reference, parameters, work.rows)
            fill(work.predicted, measure(state, reference, parameters))

        return by_hand
    inputs = [Input("state", model.kinds, "rows")]
    if sensor.noises:
        inputs.append(Input("noise", ("linear",) * sensor.noises, "noise_gain", zero=True))
    kinds = tuple(sensor.measured.values())
    return derivative(sensor.measure, inputs, kinds, "predicted")


def linear_sensor(bound_model: BoundModel, number: int) -> Innovate:
    """Make the function that computes the innovation by the derivative at the mean.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.

    Returns:
        `innovate(mean, covariance, measurement, work)`, which fills the sensor's innovation in
        `work.innovations`.
    """
    sensor = bound_model.sensors[number]
    read_state, read_reference = tuple_of(bound_model.model.size), message_layout(sensor).reference
    linearise = sensor_derivative(bound_model.model, sensor)
    pattern = pattern_of(known_entries(linearise, "rows"), len(sensor.measured))
    compare = linear_innovation(sensor, number, pattern)

    def innovate(mean: Floats, covariance: Floats, measurement: Measurement, work: Workspace) -> bool:
        data, parameters, _, _ = measurement
        linearise(read_state(mean), read_reference(data), parameters, work)
        compare(covariance, data, parameters, work)
        return True

    return innovate


def linear_innovation(sensor: Sensor, number: int, pattern: Pattern | None = None) -> CompareLinear:
    """Make the function that computes the innovation of a linearised measurement.

    Args:
        sensor: the sensor, with m measured components.
        number: index of its innovation in the workspace.
        pattern: known entries of H; None if no entry is known.

    Returns:
        `compare(covariance, data, parameters, work)`. From the workspace's `predicted` h (m,) and `rows`
        H (m, t), it fills v = y - h, C = P H' and S = H C + R.
    """
    subtract, add_noise = residual_of(sensor), sensor_noise(sensor)
    measure_covariance = measuring_covariance(pattern)

    def compare(covariance: Floats, data: Floats, parameters: Settings, work: Workspace) -> None:
        difference, spread, cross = work.innovations[number]
        subtract(data, work.predicted, difference)
        measure_covariance(covariance, work.rows, cross, spread)
        add_noise(spread, data, parameters, work)

    return compare


def whitening(sensor: Sensor, number: int) -> WhitenResidual:
    """Make the function that expresses a linearised measurement in units of its noise.

    Args:
        sensor: the sensor, with m measured components.
        number: index of its innovation in the workspace.

    Returns:
        `whiten_residual(data, parameters, work)`. From the workspace's `predicted` and `rows`, with R =
        L L', it sets the innovation's difference to L^-1 (y - h) and its cross-covariance to H' L^-T. It
        returns the number of measured components and the squared residual, NaN if R is not positive
        definite.
    """
    m, subtract, add_noise = len(sensor.measured), residual_of(sensor), sensor_noise(sensor)

    def whiten_residual(data: Floats, parameters: Settings, work: Workspace) -> tuple[int, float]:
        innovation = work.innovations[number]
        difference, noise, turned = innovation
        subtract(data, work.predicted, difference)
        turned[:, :] = work.rows[:m].T
        noise[:, :] = 0.0
        add_noise(noise, data, parameters, work)
        size = drop_missing(innovation)
        squared, _ = whiten(innovation, size)
        kalman_step(innovation, size, work.step)
        return size, squared

    return whiten_residual


def innovation_components(sensors: tuple[Sensor, ...]) -> dict[str, str]:
    """Return the names and kinds of all measured components; raise BadInput if two kinds conflict."""
    components: dict[str, str] = {}
    for sensor in sensors:
        for name, kind in sensor.measured.items():
            if components.setdefault(name, kind) != kind:
                raise BadInput(
                    f"sensor {sensor.topic}: {name} is {kind}, but {components[name]} in another sensor"
                )
    return components


def writing_innovation(bound_model: BoundModel, number: int) -> WriteInnovation:
    """Make `write_innovation(innovation, record)`, which writes to the slots of sensor `number`."""
    components = list(innovation_components(bound_model.sensors))
    places = tuple(components.index(name) for name in bound_model.sensors[number].measured)

    def write_innovation(innovation: Innovation, record: InnovationRecord) -> None:
        for i in range(len(places)):
            record.difference[places[i]] = innovation.difference[i]
            for j in range(len(places)):
                missing = np.isnan(innovation.difference[i] + innovation.difference[j])
                entry = np.nan if missing else innovation.covariance[i, j]
                record.covariance[places[i], places[j]] = entry

    return write_innovation


def is_unmeasured(data: Floats, components: int) -> bool:
    """Test whether a message lacks all components of a sensor.

    Args:
        data: data of the message, NaN for missing components; the components come first.
        components: number of components.
    """
    measured = 0
    for i in range(components):
        measured += not np.isnan(data[i])
    return measured == 0


def kalman_update(bound_model: BoundModel, number: int, innovate: Innovate) -> Update:
    """Make the Kalman update by a sensor: x (+) K v and P - K S K', with K = C S^-1.

    The gain K is not computed explicitly. With S = L L' and W = C L^-T, K v = W L^-1 v (see
    `gaussian.kalman_step`) and K S K' = W W' (see `gaussian.downdate`).

    Components that are missing, or that the model predicts as NaN, are removed from v, S and C; the
    log-likelihood is computed from the remaining components. The log-likelihood is zero if the gate
    rejects the measurement or if no component remains. Accepted measurements may still be down-weighted;
    see `inflation`.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        innovate: `innovate(mean, covariance, measurement, work)` fills the innovation v (m,), S (m, m),
            C (t, m) of the sensor and returns whether the covariance was positive definite.

    Returns:
        `update(mean, covariance, measurement, work, record)`, which updates a mean (n,) and a covariance
        (t, t) in place. It returns ALL_WELL, NOTHING_MEASURED or NOT_POSITIVE_DEFINITE.
    """
    model, m, write_innovation = (
        bound_model.model,
        len(bound_model.sensors[number].measured),
        writing_innovation(bound_model, number),
    )
    find_slope = sloping(model.kinds, model.correct)
    correct = correcting(model.kinds, model.correct)

    def reduce(covariance: Floats, innovation: Innovation, size: int, work: Workspace) -> None:
        kalman_step(innovation, size, work.step)
        downdate(covariance, innovation.cross_covariance, size)

    def update(
        mean: Floats,
        covariance: Floats,
        measurement: Measurement,
        work: Workspace,
        record: InnovationRecord,
    ) -> int:
        data, parameters, gate, _ = measurement
        if is_unmeasured(data, m):
            return NOTHING_MEASURED
        innovation = work.innovations[number]
        if not innovate(mean, covariance, measurement, work):
            return NOT_POSITIVE_DEFINITE
        write_innovation(innovation, record)
        size = drop_missing(innovation)
        squared, determinant = whiten_kept(innovation, size, m)
        if np.isnan(squared):
            return NOT_POSITIVE_DEFINITE
        accepted = size > 0 and squared <= gate[size]
        factor = inflation(squared, size, parameters)
        if accepted:
            if factor != 1.0:
                inflate(innovation, size, factor)
            if size == m:  # a number that the kernel knows, so that it needs no loops
                reduce(covariance, innovation, m, work)
            else:
                reduce(covariance, innovation, size, work)
            find_slope(mean, covariance, work.slope)
            correct(mean, covariance, work)
        write_numbers(record, squared, determinant, size, accepted, factor)
        return ALL_WELL

    return update


def write_numbers(
    record: InnovationRecord,
    squared: float,
    determinant: float,
    size: int,
    accepted: bool,
    factor: float,
) -> None:
    """Write the NIS, the log-likelihood (zero if rejected), and whether the measurement is accepted.

    The NIS uses the predicted covariance; the likelihood uses `factor` times this covariance.
    """
    record.numbers[0] = squared
    record.numbers[1] = 0.0
    record.numbers[2] = 1.0 if accepted else 0.0
    if accepted:
        wider = 0.0
        if factor != 1.0:
            wider = np.log(factor)
        record.numbers[1] = -0.5 * (squared / factor + determinant + size * (LOG_TWO_PI + wider))
