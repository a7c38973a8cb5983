"""Iterated updates: the sensor is linearised again at every iterate until convergence."""

import numpy as np

from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.kalman.steps import (
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    InnovationRecord,
    Measurement,
    Update,
    Workspace,
)
from fuselog.replay.inference.kalman.update import (
    is_unmeasured,
    linear_innovation,
    message_layout,
    sensor_derivative,
    write_numbers,
    writing_innovation,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    downdate,
    drop_missing,
    kalman_step,
    whiten,
)
from fuselog.replay.inference.linear_algebra.inflation import inflate, inflation
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.corrections import correcting, relinearising, sloping

ITERATIONS = 50
SETTLED = 1e-12  # largest component of the last step at convergence


def iterated_update(bound_model: BoundModel, number: int) -> Update:
    """Make the update that relinearises at every iterate (Gauss-Newton on the posterior).

    Bell and Cathey, IEEE TAC 38(2), 1993; on manifolds, the Jacobian is H at x (+) d times the right
    Jacobian at d. The gate and the weight of the measurement are computed at the prediction; the
    innovation and the likelihood are computed at the last iterate.

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
    """
    model, sensor = bound_model.model, bound_model.sensors[number]
    n, t, m = model.size, model.tangent, len(sensor.measured)
    read_state, read_reference = tuple_of(n), message_layout(sensor).reference
    linearise, compare = sensor_derivative(model, sensor), linear_innovation(sensor, number)
    write_innovation, correct = (
        writing_innovation(bound_model, number),
        correcting(model.kinds, model.correct),
    )
    find_slope = sloping(model.kinds, model.correct)
    step_to, chain = relinearising(model)

    def relinearise(
        mean: Floats, covariance: Floats, data: Floats, parameters: Settings, work: Workspace
    ) -> None:
        """Compute the innovation about the mean from the Jacobian at mean (+) step."""
        innovation, step, rows = work.innovations[number], work.step, work.rows
        step_to(mean, work)
        linearise(read_state(work.state), read_reference(data), parameters, work)
        chain(rows[:m], work)
        compare(covariance, data, parameters, work)
        for i in range(m):
            for k in range(t):
                innovation.difference[i] += rows[i, k] * step[k]

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
        innovation, step, factor = work.innovations[number], work.step, 1.0
        find_slope(mean, covariance, work.slope)
        step[:] = 0.0
        for iteration in range(ITERATIONS):
            relinearise(mean, covariance, data, parameters, work)
            write_innovation(innovation, record)
            size = drop_missing(innovation)
            squared, determinant = whiten(innovation, size)
            if np.isnan(squared):
                return NOT_POSITIVE_DEFINITE
            if iteration == 0:
                factor = inflation(squared, size, parameters)
            if size == 0 or (iteration == 0 and not squared <= gate[size]):
                write_numbers(record, squared, determinant, size, False, 1.0)
                return ALL_WELL
            inflate(innovation, size, factor)
            work.turned[:] = step
            kalman_step(innovation, size, step)
            change = 0.0
            for row in range(t):
                change = max(change, abs(step[row] - work.turned[row]))
            if change < SETTLED:
                break
        downdate(covariance, innovation.cross_covariance, size)
        correct(mean, covariance, work)
        write_numbers(record, squared, determinant, size, True, factor)
        return ALL_WELL

    return update
