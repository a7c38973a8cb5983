"""Steps of extended and sampling filters, composed of parts for one form of covariances.

A filter stores a mean and some form of its covariance; see `Form`. Plain filters store the covariance
itself; the parts for square-root filters are in `fuselog.replay.inference.kalman.square_root`.
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
from fuselog.replay.inference.model.stage import Stage


class Parts(NamedTuple):
    """Parts of the filters of one form; each part makes a function for a bound model.

    Attributes:
        form: the form in which covariances are stored.
        linear_motion, sampled_motion: (stage), (stage, samples) -> `predict`; see `gaussian_filter`.
        linear_update, sampled_update: (stage, number), (stage, number, samples) -> update by a sensor.
        gap_motion: (stage) -> prediction in a gap of the control.
    """

    form: Form
    linear_motion: Callable[[Stage], Predict]
    sampled_motion: Callable[[Stage, int], Predict]
    linear_update: Callable[[Stage, int], Update]
    sampled_update: Callable[[Stage, int, int], Update]
    gap_motion: Callable[[Stage], Predict]


def _linear_update(stage: Stage, number: int) -> Update:
    return kalman_update(stage, number, linear_sensor(stage, number))


def _sampled_update(stage: Stage, number: int, samples: int) -> Update:
    return kalman_update(stage, number, sampled_sensor(stage, number, samples))


PLAIN = Parts(COVARIANCES, linear_motion, sampled_motion, _linear_update, _sampled_update, keeping)


def extended(stage: Stage, parts: Parts = PLAIN) -> Steps:
    """Make the steps of an extended Kalman filter."""
    updates = tuple(parts.linear_update(stage, number) for number in range(len(stage.sensors)))
    return gaussian_filter(
        stage, parts.linear_motion(stage), updates, form=parts.form, gap_motion=parts.gap_motion
    )


def sampled(stage: Stage, parts: Parts = PLAIN) -> Steps:
    """Make the steps of a filter by regression at samples; linear functions are applied exactly."""
    model, motion = stage.model, stage.motion
    dimensions: list[int] = []
    shapes: list[tuple[int, tuple[str, ...]]] = []
    if motion.linear:
        predict = parts.linear_motion(stage)
    else:
        predict = parts.sampled_motion(stage, 0)
        dimensions.append(model.tangent + motion.noises)
        shapes.append((motion.noises, model.kinds))
    updates = []
    for number, sensor in enumerate(stage.sensors):
        if sensor.linear:
            updates.append(parts.linear_update(stage, number))
        else:
            updates.append(parts.sampled_update(stage, number, len(shapes)))
            dimensions.append(model.tangent + sensor.noises)
            shapes.append((sensor.noises, tuple(sensor.measured.values())))

    def memory(sets: tuple[Samples, ...]) -> Workspace:
        made = (
            sample_memory(each, model.kinds, noises, outputs)
            for each, (noises, outputs) in zip(sets, shapes, strict=True)
        )
        return workspace(stage, tuple(made))

    of_form = parts.form, parts.gap_motion
    return gaussian_filter(stage, predict, tuple(updates), memory, tuple(dimensions), *of_form)
