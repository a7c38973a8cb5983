"""Prediction and update of the covariance of a filter that linearises at the true states."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.inference.kalman.predict import motion_derivative, motion_noise
from fuselog.replay.inference.kalman.steps import (
    NO_TRUTH,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    InnovationRecord,
    Interval,
    Measurement,
    Samples,
    Steps,
    UpdateRun,
    Workspace,
    workspace,
)
from fuselog.replay.inference.kalman.update import linear_sensor, sensor_noise
from fuselog.replay.inference.linear_algebra.gaussian import (
    cholesky,
    downdate,
    drop_missing,
    fill_identity,
    kalman_step,
    multiply_into,
    propagate_covariance,
    whiten,
)
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel


class TrueTrajectory(NamedTuple):
    """Results along the true trajectories; the first axis is the run.

    Attributes:
        mean: (runs, n) true state.
        covariance: (runs, t, t) covariance of a filter that linearises at the true state.
        transition, noise: (runs, t, t) transition and noise since the last node.
        information: (runs, t, t) information of the measurements since the last node, the sum of H' R^-1
            H.
    """

    mean: Floats
    covariance: Floats
    transition: Floats
    noise: Floats
    information: Floats


class Nodes(NamedTuple):
    """Estimates that the recursion fills, with the step to each; see `TrueTrajectory`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    transition: Floats
    noise: Floats
    information: Floats


class BoundMemory(NamedTuple):
    """Working memory of one core: true states at events (events, n), and noise (m, m) per sensor."""

    truth: Floats
    noise: tuple[Floats, ...]
    work: Workspace


def bound_steps(bound_model: BoundModel) -> Steps:
    """Make the steps of an extended Kalman filter that linearises at the true states."""
    model, motion = bound_model.model, bound_model.motion
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    linearise = motion_derivative(model, motion, by_state=True)
    add_noise = motion_noise(model, motion)

    def predict(run: int, trajectory: TrueTrajectory, interval: Interval, memory: BoundMemory) -> bool:
        control, duration_s, parameters, event = interval
        mean, work = trajectory.mean[run], memory.work
        state = read_state(mean)
        linearise(state, read_control(control), duration_s, parameters, work)
        multiply_into(work.transition, trajectory.transition[run], work.product)
        propagate_covariance(trajectory.noise[run], work.transition, work.product)
        add_noise(state, trajectory.noise[run], duration_s, parameters, work)
        propagate_covariance(trajectory.covariance[run], work.transition, work.product)
        add_noise(state, trajectory.covariance[run], duration_s, parameters, work)
        mean[:] = memory.truth[event]
        return True

    def estimate(run: int, trajectory: TrueTrajectory, nodes: Nodes, row: int, _: BoundMemory) -> None:
        nodes.mean[row] = trajectory.mean[run]
        nodes.covariance[row], nodes.noise[row] = trajectory.covariance[run], trajectory.noise[run]
        nodes.transition[row] = trajectory.transition[run]
        nodes.information[row] = trajectory.information[run]
        fill_identity(trajectory.transition[run])
        trajectory.noise[run], trajectory.information[run] = 0.0, 0.0

    def memory(sets: tuple[Samples, ...]) -> BoundMemory:
        sizes = [len(sensor.measured) for sensor in bound_model.sensors] or [0]
        return BoundMemory(sets[0], tuple(np.empty((m, m)) for m in sizes), workspace(bound_model))

    updates = tuple(bound_update(bound_model, number) for number in range(len(bound_model.sensors)))
    return Steps(memory, predict, updates, estimate)


def bound_update(bound_model: BoundModel, number: int) -> UpdateRun:
    """Make the update by sensor `number` with a zero innovation, which does not change the state."""
    innovate, add_noise = linear_sensor(bound_model, number), sensor_noise(bound_model.sensors[number])
    m = len(bound_model.sensors[number].measured)

    def update(
        run: int,
        trajectory: TrueTrajectory,
        measurement: Measurement,
        memory: BoundMemory,
        record: InnovationRecord,
    ) -> int:
        mean, covariance, work = trajectory.mean[run], trajectory.covariance[run], memory.work
        if np.isnan(mean[0]):
            return NO_TRUTH
        innovate(mean, covariance, measurement, work)
        innovation, noise = work.innovations[number], memory.noise[number]
        noise[:, :] = 0.0
        add_noise(noise, measurement.data, measurement.parameters, work)
        size = 0
        for i in range(m):
            if not np.isnan(innovation.difference[i]):
                work.rows[size] = work.rows[i]
                noise[size] = noise[i]
                noise[:, size] = noise[:, i]
                size += 1
        add_information(trajectory.information[run], work.rows, noise, size)
        drop_missing(innovation)
        innovation.difference[:size] = 0.0
        if np.isnan(whiten(innovation, size)[0]):
            return NOT_POSITIVE_DEFINITE
        kalman_step(innovation, size, work.step)
        downdate(covariance, innovation.cross_covariance, size)
        return NOTHING_MEASURED  # no innovation is recorded

    return update


def add_information(information: Floats, rows: Floats, noise: Floats, size: int) -> None:
    """Add H' R^-1 H of the first rows of H; the result is NaN if R is not positive definite.

    Args:
        information: (t, t), to which the information is added in place.
        rows: H (at least size, t), overwritten.
        noise: R, whose first `size` rows and columns are used; it is replaced by its factor.
        size: number of measured components.
    """
    t = len(information)
    if not cholesky(noise, noise, size):
        information[0, 0] = np.nan
    for i in range(size):
        for k in range(t):
            for j in range(i):
                rows[i, k] -= noise[i, j] * rows[j, k]
            rows[i, k] /= noise[i, i]
        for row in range(t):
            for column in range(t):
                information[row, column] += rows[i, row] * rows[i, column]
