"""Steps of extended and sampling filters, built from parts for one representation of covariances.

A filter stores a mean and a representation of its covariance; see `Form`. Plain filters store the
covariance itself; the parts for square-root filters are in
`fuselog.replay.inference.kalman.square_root`.
"""

from collections.abc import Callable
from typing import NamedTuple

from fuselog.replay.inference.kalman.predict import linear_motion
from fuselog.replay.inference.kalman.regression import sample_memory, sampled_motion, sampled_sensor
from fuselog.replay.inference.kalman.steps import (
    Predict,
    Samples,
    Steps,
    Update,
    Workspace,
    gaussian_filter,
    keeping,
    workspace,
)
from fuselog.replay.inference.kalman.update import kalman_update, linear_sensor
from fuselog.replay.inference.linear_algebra.covariances import COVARIANCES, Form
from fuselog.replay.inference.model.bound_model import BoundModel


class Parts(NamedTuple):
    """Functions that make a filter's parts for a bound model, for one representation of covariances.

    Attributes:
        form: the representation of covariances.
        linear_motion, sampled_motion: (bound_model), (bound_model, samples) -> `predict`; see
            `gaussian_filter`.
        linear_update, sampled_update: (bound_model, number), (bound_model, number, samples) -> update by
            a sensor.
        gap_motion: (bound_model) -> prediction in a gap of the control.
    """

    form: Form
    linear_motion: Callable[[BoundModel], Predict]
    sampled_motion: Callable[[BoundModel, int], Predict]
    linear_update: Callable[[BoundModel, int], Update]
    sampled_update: Callable[[BoundModel, int, int], Update]
    gap_motion: Callable[[BoundModel], Predict]


def _linear_update(bound_model: BoundModel, number: int) -> Update:
    return kalman_update(bound_model, number, linear_sensor(bound_model, number))


def _sampled_update(bound_model: BoundModel, number: int, samples: int) -> Update:
    return kalman_update(bound_model, number, sampled_sensor(bound_model, number, samples))


PLAIN = Parts(COVARIANCES, linear_motion, sampled_motion, _linear_update, _sampled_update, keeping)


def extended(bound_model: BoundModel, parts: Parts = PLAIN) -> Steps:
    """Make the steps of an extended Kalman filter."""
    updates = tuple(
        parts.linear_update(bound_model, number) for number in range(len(bound_model.sensors))
    )
    return gaussian_filter(
        bound_model,
        parts.linear_motion(bound_model),
        updates,
        form=parts.form,
        gap_motion=parts.gap_motion,
    )


def sampled(bound_model: BoundModel, parts: Parts = PLAIN) -> Steps:
    """Make the steps of a filter with regression at samples; linear functions are applied exactly."""
    model, motion = bound_model.model, bound_model.motion
    dimensions: list[int] = []
    shapes: list[tuple[int, tuple[str, ...]]] = []
    if motion.linear:
        predict = parts.linear_motion(bound_model)
    else:
        predict = parts.sampled_motion(bound_model, 0)
        dimensions.append(model.tangent + motion.noises)
        shapes.append((motion.noises, model.kinds))
    updates = []
    for number, sensor in enumerate(bound_model.sensors):
        if sensor.linear:
            updates.append(parts.linear_update(bound_model, number))
        else:
            updates.append(parts.sampled_update(bound_model, number, len(shapes)))
            dimensions.append(model.tangent + sensor.noises)
            shapes.append((sensor.noises, tuple(sensor.measured.values())))

    def memory(sets: tuple[Samples, ...]) -> Workspace:
        made = (
            sample_memory(each, model.kinds, noises, outputs)
            for each, (noises, outputs) in zip(sets, shapes, strict=True)
        )
        return workspace(bound_model, tuple(made))

    of_form = parts.form, parts.gap_motion
    return gaussian_filter(bound_model, predict, tuple(updates), memory, tuple(dimensions), *of_form)
