"""Defines the steps of a recursive filter, which methods make for one model, and their memory.

A method passes a Gaussian through motion and sensors: by exact derivatives (`linear_motion`,
`linear_sensor`), by samples (`fuselog.replay.inference.kalman.regression`), or by moments that the model
knows. All work in one workspace, and the Kalman update after them is the same (`update.kalman_update`).
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
from fuselog.replay.inference.model.stage import Stage

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

# What a method believes of all runs, what one core works in, the estimates that it fills in, and its
# samples, such as `Gaussian`, `Workspace`, `recursion.EstimateRows` and `SampleMemory`. All are the
# method's own; a loop over events only hands them on.
Belief = Any  # type: ignore[explicit-any]
CoreMemory = Any  # type: ignore[explicit-any]
EstimatesToFill = Any  # type: ignore[explicit-any]
Samples = Any  # type: ignore[explicit-any]


class Gaussian(NamedTuple):
    """Holds a Gaussian of every run, first axis = run: means (runs, n), covariances (runs, t, t).

    What stands for the covariances is up to the filter, see `Steps.form`.
    """

    mean: Floats
    covariance: Floats


class Interval(NamedTuple):
    """Holds what a prediction goes by, beside the belief.

    Attributes:
        control: (controls,), what drives the state; NaN in a gap.
        duration_s: how long it goes.
        parameters: the motion's.
        event: the number of the event that it leads to, which numbers sets of randomised samples too.
    """

    control: Floats
    duration_s: float
    parameters: Settings
    event: int


class Measurement(NamedTuple):
    """Holds what an update goes by, beside the belief.

    Attributes:
        data: the numbers of the message, see `update.message_layout`.
        parameters: the sensor's.
        gate: (m + 1,), bounds of the NIS by the number of components.
        event: the number of the event, see `Interval`.
    """

    data: Floats
    parameters: Settings
    gate: Floats
    event: int


# (sets of samples, one for each of `Steps.sampled`) -> what one core works in.
MakeMemory = Callable[[tuple[Samples, ...]], CoreMemory]


class PredictRun(Protocol):
    """Moves the belief of a run in place over an interval; returns whether all is well."""

    def __call__(self, run: int, belief: Belief, interval: Interval, memory: CoreMemory, /) -> bool: ...


class UpdateRun(Protocol):
    """Updates the belief of a run in place; returns ALL_WELL, NOTHING_MEASURED or a failure."""

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
    """Fills a row of the estimates from the belief of a run."""

    def __call__(
        self, run: int, belief: Belief, estimates: EstimatesToFill, row: int, memory: CoreMemory, /
    ) -> None: ...


class Predict(Protocol):
    """Moves a mean (n,) and a covariance (t, t) in place over an interval; returns if all is well."""

    def __call__(
        self, mean: Floats, covariance: Floats, interval: Interval, work: CoreMemory, /
    ) -> bool: ...


class Innovate(Protocol):
    """Fills a sensor's innovation in the workspace; returns whether its covariance was one.

    Of a mean (n,) and a covariance (t, t), both unchanged.
    """

    def __call__(
        self, mean: Floats, covariance: Floats, measurement: Measurement, work: CoreMemory, /
    ) -> bool: ...


class Update(Protocol):
    """Updates a mean (n,) and a covariance (t, t) in place; returns as `UpdateRun`."""

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
    """Holds the steps of a recursive filter of one model, as the recursion calls them.

    Attributes:
        memory: (sets) -> what one core works in; `sets` are the samples, one for each of `sampled`.
        predict: (run, belief, interval, memory) -> whether all is well; moves the belief in place.
        updates: for every sensor, (run, belief, measurement, memory, record) -> a failure, ALL_WELL or
            NOTHING_MEASURED; see `kalman_update`.
        estimate: (run, belief, estimates, row, memory) fills a row of the results: its mean, its
            covariance, and what the method keeps beside them.
        sampled: the dimensions in which it takes samples, the motion's first.
        resumes_after_gap: whether it goes on after a gap of the control: `predict` then takes NaN for a
            control.
        form: what stands for the covariances in beliefs; the estimates have the covariances themselves.
    """

    memory: MakeMemory
    predict: PredictRun
    updates: tuple[UpdateRun, ...]
    estimate: EstimateRun
    sampled: tuple[int, ...] = ()
    resumes_after_gap: bool = False
    form: Form = COVARIANCES


class InnovationRecord(NamedTuple):
    """Holds the innovation of one update: one row of the results.

    Attributes:
        difference, covariance: (slots,), (slots, slots) the innovation; a sensor fills its own slots.
        numbers: NIS, log-likelihood, and 1 where the gate let the measurement in, (3,).
    """

    difference: Floats
    covariance: Floats
    numbers: Floats


class Workspace(NamedTuple):
    """Holds the arrays that the steps of one core work in.

    Attributes:
        state: (n,), the moved state.
        transition: (t, t).
        product: (t, t), after a prediction the covariance of the moved state with the one before.
        rest: (t, t), what `factors` needs besides to retrace a prediction.
        gain, control_variance: (t, controls), (controls,).
        noise_gain, noise_variance: (t or m, noises), (noises,).
        rows, predicted: (m, t), (m,), a measurement's Jacobian and mean.
        step, turned, slope: (t,), the correction of the state, and along what it bends.
        innovations: one for each sensor.
        samples: what `fuselog.replay.inference.kalman.regression` works in, motion first, one for each
            of `sampled`.
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


def workspace(stage: Stage, samples: tuple[Samples, ...] = ()) -> Workspace:
    """Make the workspace of a model with the sensors at hand.

    Args:
        stage: the model, with n components of the state, t of the tangent space, m of a sensor at most.
        samples: the memories of `regression`, motion first, one for each of `Steps.sampled`.
    """
    model, t = stage.model, stage.model.tangent
    m = max((len(sensor.measured) for sensor in stage.sensors), default=0)
    noises = max([stage.motion.noises, *(sensor.noises for sensor in stage.sensors)])
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
        innovations=tuple(no_innovation(t, len(sensor.measured)) for sensor in stage.sensors)
        or (no_innovation(t, 0),),
        samples=samples or ((np.empty(0),),),
    )


def gaussian_filter(
    stage: Stage,
    predict: Predict,
    updates: tuple[Update, ...],
    memory: MakeMemory | None = None,
    sampled: tuple[int, ...] = (),
    form: Form = COVARIANCES,
    gap_motion: Callable[[Stage], Predict] | None = None,
) -> Steps:
    """Make the steps of a filter whose belief is one Gaussian.

    Args:
        stage: the model as a method takes it.
        predict: `predict(mean, covariance, interval, work)` moves one run's mean (n,) and covariance
            (t, t) in place; returns whether all is well.
        updates: for every sensor, `update(mean, covariance, measurement, work, record)`; see
            `kalman_update`.
        memory: (sets) -> the workspace; `workspace(stage)` unless given.
        sampled: see `Steps.sampled`.
        form: what stands for the covariance.
        gap_motion: (stage) -> the prediction in a gap of the control; `keeping` unless given.

    Returns the steps, which pass over gaps of the control where the motion has a `gap_noise`.
    """
    has_gaps, to_covariance = stage.motion.gap_noise is not None, form.to_covariance
    if has_gaps:
        predict = _predicting_gap((gap_motion or keeping)(stage), predict)

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
        memory or (lambda _: workspace(stage)),
        predict_run,
        tuple(_of_run(update) for update in updates),
        estimate,
        sampled,
        resumes_after_gap=has_gaps,
        form=form,
    )


def _predicting_gap(predict_gap: Predict, predict_driven: Predict) -> Predict:
    """Make the prediction of one kind where the control is NaN, else of the other."""

    def predict(mean: Floats, covariance: Floats, interval: Interval, work: Workspace) -> bool:
        if np.isnan(interval.control[0]):
            return predict_gap(mean, covariance, interval, work)
        return predict_driven(mean, covariance, interval, work)

    return predict


def keeping(stage: Stage) -> Predict:
    """Make the prediction in a gap of the control: it keeps the mean and adds the gap noise."""
    model, gap_noise = stage.model, stage.motion.gap_noise
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
