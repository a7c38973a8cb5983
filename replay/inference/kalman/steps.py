"""Steps of a recursive filter for one model, as made by methods, and their working memory.

A method propagates a Gaussian through motion and sensors by exact derivatives (`linear_motion`,
`linear_sensor`), by samples (`fuselog.replay.inference.kalman.regression`), or by exact moments that the
model provides. All methods fill the same workspace, from which the same Kalman update
(`update.kalman_update`) follows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.inference.linear_algebra.covariances import COVARIANCES, Form
from fuselog.replay.inference.linear_algebra.gaussian import (
    Innovation,
    copy_gaussian,
    no_innovation,
)
from fuselog.replay.inference.linear_algebra.tuples import adding_noise, tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel

FAILURES = (
    "the covariance is no longer positive definite",
    "the estimate is no longer finite",
    "no particle explains the measurement",
    "the truth is unknown at this time",
    "the control is missing for too long",
)
# indices of FAILURES
NOT_POSITIVE_DEFINITE, NOT_FINITE, NOT_EXPLAINED, NO_TRUTH, NOT_DRIVEN = 0, 1, 2, 3, 4
NOTHING_MEASURED, NOT_STARTED, UNKNOWN = -2, -3, -4  # in addition to ALL_WELL, -1

# The belief of a method in all runs, the working memory of a core, the estimates, and the samples, such
# as `Gaussian`, `Workspace`, `recursion.EstimateRows` and `SampleMemory`. Each method defines these
# types; the loop over events only passes them on.
Belief = Any  # type: ignore[explicit-any]
CoreMemory = Any  # type: ignore[explicit-any]
EstimatesToFill = Any  # type: ignore[explicit-any]
Samples = Any  # type: ignore[explicit-any]


class Gaussian(NamedTuple):
    """Gaussian of every run: means (runs, n) and covariances (runs, t, t).

    The covariances are stored in the filter's form; see `Steps.form`.
    """

    mean: Floats
    covariance: Floats


class Interval(NamedTuple):
    """Inputs of a prediction in addition to the belief.

    Attributes:
        control: (controls,) control; NaN in a gap.
        duration_s: duration of the step.
        parameters: parameters of the motion.
        event: index of the event at the end of the interval, which also selects the set of random
            samples.
    """

    control: Floats
    duration_s: float
    parameters: Settings
    event: int


class Measurement(NamedTuple):
    """Inputs of an update in addition to the belief.

    Attributes:
        data: contents of the message; see `update.message_layout`.
        parameters: parameters of the sensor.
        gate: (m + 1,), the largest NIS that the gate accepts, by number of components.
        event: index of the event; see `Interval`.
    """

    data: Floats
    parameters: Settings
    gate: Floats
    event: int


# (sets of samples, one for each of `Steps.sampled`) -> working memory of one core.
MakeMemory = Callable[[tuple[Samples, ...]], CoreMemory]


class PredictRun(Protocol):
    """Function that predicts a run's belief over an interval, in place; it returns False on failure."""

    def __call__(self, run: int, belief: Belief, interval: Interval, memory: CoreMemory, /) -> bool: ...


class UpdateRun(Protocol):
    """Function that updates the belief of a run in place.

    It returns ALL_WELL, NOTHING_MEASURED or a failure.
    """

    def __call__(
        self,
        run: int,
        belief: Belief,
        measurement: Measurement,
        memory: CoreMemory,
        record: "InnovationRecord",
        /,
    ) -> int: ...


class EstimateRun(Protocol):
    """Function that fills a row of the estimates from the belief of a run."""

    def __call__(
        self, run: int, belief: Belief, estimates: EstimatesToFill, row: int, memory: CoreMemory, /
    ) -> None: ...


class Predict(Protocol):
    """Function that predicts a mean (n,) and covariance (t, t) over an interval, in place.

    It returns whether it succeeded.
    """

    def __call__(
        self, mean: Floats, covariance: Floats, interval: Interval, work: CoreMemory, /
    ) -> bool: ...


class Innovate(Protocol):
    """Function that fills a sensor's innovation in the workspace.

    The function does not change the mean (n,) or the covariance (t, t). It returns whether the
    covariance was positive definite.
    """

    def __call__(
        self, mean: Floats, covariance: Floats, measurement: Measurement, work: CoreMemory, /
    ) -> bool: ...


class Update(Protocol):
    """Function that updates a mean (n,) and covariance (t, t) in place; see `UpdateRun` for results."""

    def __call__(
        self,
        mean: Floats,
        covariance: Floats,
        measurement: Measurement,
        work: CoreMemory,
        record: "InnovationRecord",
        /,
    ) -> int: ...


class Steps(NamedTuple):
    """Steps of a recursive filter for one model, as the recursion calls them.

    Attributes:
        memory: (sets) -> working memory of one core; `sets` has a set of samples for each dimension in
            `sampled`.
        predict: (run, belief, interval, memory) -> whether it succeeded; moves the belief in place.
        updates: for every sensor, (run, belief, measurement, memory, record) -> a failure, ALL_WELL or
            NOTHING_MEASURED; see `kalman_update`.
        estimate: (run, belief, estimates, row, memory) fills a row of the results: mean, covariance, and
            further results of the method.
        sampled: dimensions of the samples of each sampled function, with the motion first.
        resumes_after_gap: whether the filter continues after a gap of the control; `predict` is then
            called with NaN as the control.
        form: form in which beliefs store covariances; estimates contain the covariances themselves.
    """

    memory: MakeMemory
    predict: PredictRun
    updates: tuple[UpdateRun, ...]
    estimate: EstimateRun
    sampled: tuple[int, ...] = ()
    resumes_after_gap: bool = False
    form: Form = COVARIANCES


class InnovationRecord(NamedTuple):
    """Innovation of one update: one row of the results.

    Attributes:
        difference, covariance: (slots,), (slots, slots) the innovation and its covariance; a sensor
            fills its own slots.
        numbers: (3,) NIS, log-likelihood, and 1 if the gate accepted the measurement.
    """

    difference: Floats
    covariance: Floats
    numbers: Floats


class Workspace(NamedTuple):
    """Working arrays of the steps, for one core.

    Attributes:
        state: (n,) moved state.
        transition: (t, t) derivative with respect to the state.
        product: (t, t) after a prediction, the covariance between the new and the old state.
        rest: (t, t) further values that `factors` needs to reverse a prediction.
        gain, control_variance: (t, controls), (controls,).
        noise_gain, noise_variance: (t or m, noises), (noises,).
        rows, predicted: (m, t), (m,) Jacobian and mean of a measurement.
        step, turned, slope: (t,) correction of the state, an auxiliary vector, and the slope of a
            correction along a curve.
        innovations: one innovation for each sensor.
        samples: memory of `fuselog.replay.inference.kalman.regression` for each of `sampled`, motion
            first.
    """

    state: Floats
    transition: Floats
    product: Floats
    rest: Floats
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
    samples: tuple[Samples, ...]


def workspace(bound_model: BoundModel, samples: tuple[Samples, ...] = ()) -> Workspace:
    """Allocate the workspace of a bound model.

    Args:
        bound_model: the bound model, with n state components, t tangent components, and at most m
            components of a sensor.
        samples: memories of `regression`, one for each of `Steps.sampled`, with the motion first.
    """
    model, t = bound_model.model, bound_model.model.tangent
    m = max((len(sensor.measured) for sensor in bound_model.sensors), default=0)
    noises = max([bound_model.motion.noises, *(sensor.noises for sensor in bound_model.sensors)])
    return Workspace(
        state=np.empty(model.size),
        transition=np.empty((t, t)),
        product=np.empty((t, t)),
        rest=np.empty((t, t)),
        gain=np.empty((t, model.controls)),
        control_variance=np.empty(model.controls),
        noise_gain=np.empty((max(t, m), noises)),
        noise_variance=np.empty(noises),
        rows=np.empty((m, t)),
        predicted=np.empty(m),
        step=np.empty(t),
        turned=np.empty(t),
        slope=np.zeros(t),
        innovations=tuple(no_innovation(t, len(sensor.measured)) for sensor in bound_model.sensors)
        or (no_innovation(t, 0),),
        samples=samples or ((np.empty(0),),),
    )


def gaussian_filter(
    bound_model: BoundModel,
    predict: Predict,
    updates: tuple[Update, ...],
    memory: MakeMemory | None = None,
    sampled: tuple[int, ...] = (),
    form: Form = COVARIANCES,
    gap_motion: Callable[[BoundModel], Predict] | None = None,
) -> Steps:
    """Make the steps of a filter whose belief is one Gaussian.

    Args:
        bound_model: the bound model.
        predict: `predict(mean, covariance, interval, work)` predicts the mean (n,) and covariance (t, t)
            of one run in place and returns whether it succeeded.
        updates: for every sensor, `update(mean, covariance, measurement, work, record)`; see
            `kalman_update`.
        memory: (sets) -> the workspace; `workspace(bound_model)` by default.
        sampled: see `Steps.sampled`.
        form: form in which covariances are stored.
        gap_motion: (bound_model) -> prediction in a gap of the control; `keeping` by default.

    Returns:
        The steps; they continue after gaps of the control if the motion has a `gap_noise`.
    """
    has_gaps, to_covariance = bound_model.motion.gap_noise is not None, form.to_covariance
    if has_gaps:
        predict = _predicting_gap((gap_motion or keeping)(bound_model), predict)

    def predict_run(run: int, belief: Gaussian, interval: Interval, work: CoreMemory) -> bool:
        mean, covariance = belief.mean[run], belief.covariance[run]
        return predict(mean, covariance, interval, work)

    def estimate(
        run: int, belief: Gaussian, estimates: EstimatesToFill, row: int, work: CoreMemory
    ) -> None:
        mean, covariance = estimates.mean[row], estimates.covariance[row]
        copy_gaussian(belief.mean[run], belief.covariance[run], mean, covariance)
        to_covariance(covariance)

    return Steps(
        memory or (lambda _: workspace(bound_model)),
        predict_run,
        tuple(_of_run(update) for update in updates),
        estimate,
        sampled,
        resumes_after_gap=has_gaps,
        form=form,
    )


def _predicting_gap(predict_gap: Predict, predict_driven: Predict) -> Predict:
    """Make the prediction that calls the first function if the control is NaN, otherwise the second."""

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        if np.isnan(interval.control[0]):
            return predict_gap(mean, covariance, interval, work)
        return predict_driven(mean, covariance, interval, work)

    return predict


def keeping(bound_model: BoundModel) -> Predict:
    """Make the prediction in a gap of the control; it keeps the mean and adds the gap noise."""
    model, gap_noise = bound_model.model, bound_model.motion.gap_noise
    assert gap_noise is not None
    read_state, add = tuple_of(model.size), adding_noise(model.tangent)

    def keep(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        work.product[:, :] = covariance
        add(covariance, gap_noise(read_state(mean), interval.duration_s, interval.parameters))
        return True

    return keep


def _of_run(update: Update) -> UpdateRun:
    def update_run(
        run: int, belief: Gaussian, measurement: Measurement, work: CoreMemory, record: InnovationRecord
    ) -> int:
        mean, covariance = belief.mean[run], belief.covariance[run]
        return update(mean, covariance, measurement, work, record)

    return update_run
