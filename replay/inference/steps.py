"""The steps of a recursive Gaussian filter, made for one model: what a method puts together.

A method passes a Gaussian through motion and sensors: by exact derivatives (`linear_motion`,
`linear_sensor`), by samples (`replay.inference.regression`), or by moments that the model knows. All
work in one workspace, and the Kalman update after them is the same (`kalman_update`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from recorders.errors import BadInput
from replay.engine.arrays import Floats, Function
from replay.engine.results import ALL_WELL
from replay.inference.corrections import correcting, sloping
from replay.inference.gaussian import (
    LOG_TWO_PI,
    Innovation,
    add_through,
    copy_gaussian,
    kalman_step,
    keep_measured,
    moved_covariance,
    no_innovation,
    reduce_covariance,
    whiten,
    widen,
    widening,
    wrap,
)
from replay.inference.generate import (
    Input,
    adding_noise,
    derivative,
    filling,
    tuple_of,
)
from replay.inference.model import Model, Motion, Sensor

FAILURES = (
    "the covariance is no longer positive definite",
    "the estimate is no longer finite",
    "no particle explains what was measured",
    "the truth is not known here",
    "what drives the motion is silent for too long",
)
# indices of FAILURES
NOT_POSITIVE_DEFINITE, NOT_FINITE, NOT_EXPLAINED, NO_TRUTH, NOT_DRIVEN = 0, 1, 2, 3, 4
NOTHING_MEASURED, NOT_STARTED, UNKNOWN = -2, -3, -4  # beside ALL_WELL, -1


class Stage(NamedTuple):
    """A model as a method takes it: its motion, and the sensors that the log has.

    `modes` are the motions of all modes, in their order, for a method that takes all of them.
    """

    model: Model
    motion: Motion
    sensors: tuple[Sensor, ...]
    modes: tuple[Motion, ...] = ()


class Gaussian(NamedTuple):
    """What is believed of the states, first axis = run: means (runs, n), covariances (runs, t, t)."""

    mean: Floats
    covariance: Floats


class Steps(NamedTuple):
    """A recursive filter of one model, as the recursion takes it.

    Attributes:
        memory: (sets) -> what one core works in; `sets` are the samples, one for each of `sampled`.
        predict: (run, belief, control, duration_s, parameters, use, memory) -> whether all is well;
            moves the belief in place. `use` numbers the sets of randomised samples.
        updates: for every sensor, (run, belief, data, parameters, gate, use, memory, note) -> a failure,
            ALL_WELL or NOTHING_MEASURED; see `kalman_update`.
        estimate: (run, belief, estimates, row, memory) fills a row of the results: its mean, its
            covariance, and what the method keeps beside them.
        sampled: the dimensions in which it takes samples, the motion's first.
        resumes: whether it goes on after a gap of the control: `predict` then takes NaN for a control.
    """

    memory: Callable[[tuple[Any, ...]], Any]
    predict: Function
    updates: tuple[Function, ...]
    estimate: Function
    sampled: tuple[int, ...] = ()
    resumes: bool = False


class Note(NamedTuple):
    """What an update tells of itself: one row of the results.

    Attributes:
        difference, covariance: (slots,), (slots, slots) the innovation; a sensor fills its own slots.
        numbers: NIS, log-likelihood, and 1 where the gate let the measurement in, (3,).
    """

    difference: Floats
    covariance: Floats
    numbers: Floats


class Workspace(NamedTuple):
    """What the steps of one core work in.

    Attributes:
        state: (n,), the moved state.
        transition: (t, t).
        product: (t, t), after a prediction the covariance of the moved state with the one before.
        gain, control_variance: (t, controls), (controls,).
        noise_gain, noise_variance: (t or m, noises), (noises,).
        rows, predicted: (m, t), (m,), a measurement's Jacobian and mean.
        step, turned, slope: (t,), the correction of the state, and along what it bends.
        innovations: one for each sensor.
        samples: what `replay.inference.regression` works in, motion first, one for each of `sampled`.
    """

    state: Floats
    transition: Floats
    product: Floats
    gain: Floats
    control_variance: Floats
    noise_gain: Floats
    noise_variance: Floats
    rows: Floats
    predicted: Floats
    step: Floats
    turned: Floats
    slope: Floats
    innovations: tuple[Innovation, ...]
    samples: tuple[Any, ...]


def workspace(stage: Stage, samples: tuple[Any, ...] = ()) -> Workspace:
    """A workspace for a model with the sensors at hand."""
    model, t = stage.model, stage.model.tangent
    m = max((len(sensor.measured) for sensor in stage.sensors), default=0)
    noises = max([stage.motion.noises, *(sensor.noises for sensor in stage.sensors)])
    return Workspace(
        state=np.empty(model.size),
        transition=np.empty((t, t)),
        product=np.empty((t, t)),
        gain=np.empty((t, model.controls)),
        control_variance=np.empty(model.controls),
        noise_gain=np.empty((max(t, m), noises)),
        noise_variance=np.empty(noises),
        rows=np.empty((m, t)),
        predicted=np.empty(m),
        step=np.empty(t),
        turned=np.empty(t),
        slope=np.zeros(t),
        innovations=tuple(no_innovation(t, len(sensor.measured)) for sensor in stage.sensors)
        or (no_innovation(t, 0),),
        samples=samples or ((np.empty(0),),),
    )


def gaussian_filter(
    stage: Stage,
    predict: Function,
    updates: tuple[Function, ...],
    memory: Callable[[tuple[Any, ...]], Any] | None = None,
    sampled: tuple[int, ...] = (),
) -> Steps:
    """The steps of a filter whose belief is one Gaussian.

    `predict(mean, covariance, control, duration_s, parameters, use, work)` and the updates alike take
    one run's mean and covariance.
    """
    lost = stage.motion.lost
    if lost is not None:
        predict = _predicting_lost(stage.model, lost, predict)

    def predict_run(
        run: int, belief: Gaussian, control: Any, duration_s: float, parameters: Any, use: int, work: Any
    ) -> bool:
        mean, covariance = belief.mean[run], belief.covariance[run]
        return predict(mean, covariance, control, duration_s, parameters, use, work)

    def estimate(run: int, belief: Gaussian, estimates: Any, row: int, work: Any) -> None:
        mean, covariance = estimates.mean[row], estimates.covariance[row]
        copy_gaussian(belief.mean[run], belief.covariance[run], mean, covariance)

    return Steps(
        memory or (lambda _: workspace(stage)),
        predict_run,
        tuple(_of_run(update) for update in updates),
        estimate,
        sampled,
        resumes=lost is not None,
    )


def _predicting_lost(model: Model, lost: Function, predict_driven: Function) -> Function:
    """The prediction, which stays where it is and knows less where the control is NaN."""
    read_state, add, t = tuple_of(model.size), adding_noise(model.tangent), model.tangent

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        work: Workspace,
    ) -> bool:
        if not np.isnan(control[0]):
            return predict_driven(mean, covariance, control, duration_s, parameters, use, work)
        for row in range(t):
            for column in range(t):
                work.product[row, column] = covariance[row, column]
        add(covariance, lost(read_state(mean), duration_s, parameters))
        return True

    return predict


def _of_run(update: Function) -> Function:
    def update_run(
        run: int,
        belief: Gaussian,
        data: Floats,
        parameters: Any,
        gate: Floats,
        use: int,
        work: Any,
        note: Note,
    ) -> int:
        mean, covariance = belief.mean[run], belief.covariance[run]
        return update(mean, covariance, data, parameters, gate, use, work, note)

    return update_run


# Motion


def linear_motion(stage: Stage) -> Function:
    """Prediction by the derivative at the mean, which is exact where the motion is linear."""
    model, motion = stage.model, stage.motion
    n, read_control = model.size, tuple_of(model.controls)
    read_state, fill = tuple_of(n), filling(n)
    linearise = motion_derivative(model, motion, by_state=True)
    add_noise = motion_noise(model, motion)

    def predict(
        mean: Floats,
        covariance: Floats,
        control: Floats,
        duration_s: float,
        parameters: Any,
        use: int,
        work: Workspace,
    ) -> bool:
        state = read_state(mean)
        linearise(state, read_control(control), duration_s, parameters, work)
        fill(mean, work.state)
        moved_covariance(covariance, work.transition, work.product)
        add_noise(state, covariance, duration_s, parameters, work)
        return True

    return predict


def motion_derivative(model: Model, motion: Motion, *, by_state: bool) -> Function:
    """`linearise(state, control, duration_s, parameters, work)`: the moved state and what is wanted.

    It fills `work.state`, `transition` where the derivative by the state is wanted, `gain` where the
    control is noisy, and `noise_gain` where noise enters other than by addition.
    """
    if motion.jacobians is not None:
        move, jacobians, fill = motion.move, motion.jacobians, filling(model.size)

        def by_hand(state: Any, control: Any, duration_s: float, parameters: Any, work: Any) -> None:
            jacobians(state, control, duration_s, parameters, work.transition, work.gain)
            fill(work.state, move(state, control, duration_s, parameters))

        return by_hand
    inputs = [
        Input("state", model.kinds, "transition" if by_state else ""),
        Input("control", ("linear",) * model.controls, "gain" if motion.control_noise else ""),
    ]
    if motion.noises:
        inputs.append(Input("noise", ("linear",) * motion.noises, "noise_gain", zero=True))
    return derivative(motion.move, inputs, model.kinds, ("duration_s", "parameters"), "state")


def motion_noise(model: Model, motion: Motion) -> Function:
    """`add(state, covariance, duration_s, parameters, work)`: the noise of a motion, whatever its kind.

    What enters by the control, or other than by addition, does so through the workspace's derivatives.
    """
    pieces: list[Function] = []
    if motion.control_noise is not None:
        pieces.append(_control_noise(motion.control_noise, model.controls))
    if motion.noise is not None and motion.noises:
        pieces.append(_entering_noise(motion.noise, motion.noises))
    elif motion.noise is not None:
        pieces.append(_additive_noise(motion.noise, adding_noise(model.tangent, motion.noise_block)))
    if not pieces:
        return nothing
    return pieces[0] if len(pieces) == 1 else _both(*pieces)


def nothing(*_: Any) -> None:
    """Do nothing, in place of what a model does not need."""
    return


def _both(first: Function, second: Function) -> Function:
    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        first(state, covariance, duration_s, parameters, work)
        second(state, covariance, duration_s, parameters, work)

    return add


def _control_noise(variances: Function, controls: int) -> Function:
    fill = filling(controls)

    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        fill(work.control_variance, variances(duration_s, parameters))
        add_through(covariance, work.gain, work.control_variance)

    return add


def _entering_noise(variances: Function, noises: int) -> Function:
    fill = filling(noises)

    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        fill(work.noise_variance[:noises], variances(state, duration_s, parameters))
        add_through(covariance, work.noise_gain, work.noise_variance[:noises])

    return add


def _additive_noise(noise: Function, add_noise: Function) -> Function:
    def add(state: Any, covariance: Floats, duration_s: float, parameters: Any, work: Any) -> None:
        add_noise(covariance, noise(state, duration_s, parameters))

    return add


# Sensors


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
    return derivative(sensor.measure, inputs, kinds, ("about", "parameters"), "predicted")


def linear_sensor(stage: Stage, number: int) -> Function:
    """`innovate(mean, covariance, data, parameters, use, work)` by the derivative at the mean."""
    sensor = stage.sensors[number]
    read_state, read = tuple_of(stage.model.size), reading(sensor)
    read_about = read.about
    linearise, compare = sensor_derivative(stage.model, sensor), linear_innovation(sensor, number)

    def innovate(
        mean: Floats, covariance: Floats, data: Floats, parameters: Any, use: int, work: Workspace
    ) -> bool:
        linearise(read_state(mean), read_about(data), parameters, work)
        compare(covariance, data, parameters, work)
        return True

    return innovate


def linear_innovation(sensor: Sensor, number: int) -> Function:
    """`compare(covariance, data, parameters, work)`: the innovation of a linearised measurement.

    From the workspace's `predicted` and `rows`, v = y - h, C = P H' and S = H C + R.
    """
    m, angular = len(sensor.measured), tuple(kind == "angle" for kind in sensor.measured.values())
    add_noise = sensor_noise(sensor)

    def compare(covariance: Floats, data: Floats, parameters: Any, work: Workspace) -> None:
        difference, spread, cross = work.innovations[number]
        rows = work.rows
        for i in range(m):
            difference[i] = wrap(data[i] - work.predicted[i], angular[i])
            for row in range(len(covariance)):
                entry = 0.0
                for k in range(len(covariance)):
                    entry += covariance[row, k] * rows[i, k]
                cross[row, i] = entry
            for j in range(i + 1):
                entry = 0.0
                for k in range(len(covariance)):
                    entry += rows[j, k] * cross[k, i]
                spread[i, j] = spread[j, i] = entry
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
    likelihood = -0.5 * (squared / factor + determinant + size * (LOG_TWO_PI + np.log(factor)))
    note.numbers[1] = likelihood if accepted else 0.0
    note.numbers[2] = 1.0 if accepted else 0.0
