"""Observability of the state at the start of a window, from the measurements of the window.

The local Gramian W = sum Phi' H' R^-1 H Phi sums the information of all measurements, propagated back by
the derivatives Phi of the motion along the smoothed trajectory. W is scaled to D W D with the prior's
standard deviations D, so an eigenvalue of 1 means that the measurements contain as much information as
the prior. Along an estimated trajectory, unobservable directions accumulate a small amount of spurious
information; therefore, eigenvalues below 10 are reported as weaker than the prior. F and H are the
Jacobians of the extended Kalman filter.

Chen, Jiang and Hung, IECON 1990 (local observability); Krener and Ide, CDC 2009 (the Gramian).
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from pydantic import PositiveFloat

from fuselog.recorders.compiling.compile import OverRuns, compile_over_runs
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.replaying.estimator import AnyEstimator
from fuselog.replay.engine.streams.blocks import Ragged, copied, run_of_rows
from fuselog.replay.engine.vectors.tangent import named_now, tangent_components
from fuselog.replay.inference.estimators import modelled_by, of_any_model
from fuselog.replay.inference.kalman.methods import Method, MethodParameters
from fuselog.replay.inference.kalman.predict import motion_derivative
from fuselog.replay.inference.kalman.steps import (
    NOTHING_MEASURED,
    InnovationRecord,
    Interval,
    Measurement,
    PredictRun,
    Steps,
    UpdateRun,
    Workspace,
    workspace,
)
from fuselog.replay.inference.kalman.update import (
    innovation_components,
    message_layout,
    sensor_derivative,
    sensor_noise,
)
from fuselog.replay.inference.linear_algebra.gaussian import (
    drop_missing,
    fill_identity,
    kalman_step,
    multiply_into,
    whiten,
)
from fuselog.replay.inference.linear_algebra.manifold import boxminus, is_flat
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.model.bound_model import BoundModel, title_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.settings import reading_settings
from fuselog.replay.inference.run.filtering import FilterState
from fuselog.replay.inference.run.recursion import (
    EstimateRows,
    RunInputs,
    RunResults,
    filled,
    no_results,
    recursion,
)
from fuselog.replay.inference.smoothing.affine import carrying
from fuselog.replay.inference.smoothing.iterated import ITERATED, IteratedSmoother, Way

RANK_TOLERANCE = 1e-10  # relative to the largest eigenvalue, times the number of components
WEAK = 10.0  # eigenvalues in multiples of the prior's information


class ObservabilityParameters(MethodParameters):  # type: ignore[explicit-any]
    """Windows and scales of the observability Gramian.

    Attributes:
        window_s: length of a window; by default, the whole run.
        scales: standard deviations to use instead of the prior's, by component, in the component's unit.
    """

    window_s: PositiveFloat | None = None
    scales: dict[str, PositiveFloat] = {}


class Gramian(NamedTuple):
    """Phi and W up to the current event (runs, t, t), and numbers of messages in W (runs,)."""

    transition: Floats
    information: Floats
    messages: Integers


class LinearizationTrajectory(NamedTuple):
    """States along the trajectory (nodes, n), nodes of events, and memory for a tangent vector."""

    mean: Floats
    node: Integers
    offset: Floats


def gramian_steps(bound_model: BoundModel) -> Steps:
    """Make the steps that sum the Gramian along a trajectory, the only set that `memory` receives."""
    motion = _carried_by_motion(bound_model)
    sensors = tuple(_added_by_sensor(bound_model, number) for number in range(len(bound_model.sensors)))

    def estimate(run: int, belief: Gramian, found: EstimateRows, row: int, _: Workspace) -> None:
        """Store the Gramian as the covariance and its number of messages as the mean; reset both."""
        transition, information = belief.transition[run], belief.information[run]
        found.mean[row, 0] = belief.messages[run]
        belief.messages[run] = 0
        found.covariance[row] = information
        information[:, :] = 0.0
        fill_identity(transition)

    return Steps(lambda sets: workspace(bound_model, sets), motion, sensors, estimate)


def _carried_by_motion(bound_model: BoundModel) -> PredictRun:
    model = bound_model.model
    linearise = motion_derivative(model, bound_model.motion, by_state=True)
    read_state, read_control = tuple_of(model.size), tuple_of(model.controls)
    subtract, flat, carry = boxminus(model.kinds), is_flat(model.kinds), carrying(model.kinds)

    def predict(run: int, belief: Gramian, interval: Interval, work: Workspace) -> bool:
        control, duration_s, parameters, event = interval
        trajectory, transition = work.samples[0], belief.transition[run]
        node = trajectory.node[event]
        linearise(
            read_state(trajectory.mean[node - 1]), read_control(control), duration_s, parameters, work
        )
        if not flat:
            subtract(trajectory.mean[node], work.state, trajectory.offset, 0)
            carry(trajectory.offset[0], work.transition, work.step)
        multiply_into(work.transition, transition, work.product)
        return True

    return predict


def _added_by_sensor(bound_model: BoundModel, number: int) -> UpdateRun:
    model, sensor = bound_model.model, bound_model.sensors[number]
    m, t = len(sensor.measured), model.tangent
    read_state, read_reference = tuple_of(model.size), message_layout(sensor).reference
    linearise, add_noise = sensor_derivative(model, sensor), sensor_noise(sensor)

    def update(
        run: int, belief: Gramian, measurement: Measurement, work: Workspace, record: InnovationRecord
    ) -> int:
        data, parameters, _, event = measurement
        trajectory, innovation = work.samples[0], work.innovations[number]
        cross = innovation.cross_covariance
        linearise(
            read_state(trajectory.mean[trajectory.node[event]]), read_reference(data), parameters, work
        )
        innovation.covariance[:] = 0.0
        add_noise(innovation.covariance, data, parameters, work)
        for i in range(m):
            innovation.difference[i] = data[i] - work.predicted[i]
            for column in range(t):  # (H Phi)'
                entry = 0.0
                for k in range(t):
                    entry += work.rows[i, k] * belief.transition[run, k, column]
                cross[column, i] = entry
        size = drop_missing(innovation)
        squared, _ = whiten(innovation, size)
        if size == 0 or np.isnan(squared):
            return NOTHING_MEASURED
        kalman_step(innovation, size, work.step)
        information = belief.information[run]
        for row in range(t):
            for column in range(t):
                for i in range(size):
                    information[row, column] += cross[row, i] * cross[column, i]
        belief.messages[run] += 1
        return NOTHING_MEASURED

    return update


@lru_cache(maxsize=64)
def _summing(bound_model: BoundModel) -> tuple[OverRuns, Steps]:
    steps = gramian_steps(bound_model)
    settings_of = reading_settings(number_fields(bound_model.model.parameters))
    title = title_of(bound_model.model, "observability")
    return compile_over_runs(recursion(bound_model, steps, settings_of), title=title), steps


class Observability(IteratedSmoother):
    """Smoother that also computes the Gramian of each window of a run along its smoothed trajectory."""

    def finish(self, state: FilterState) -> list[Ragged]:
        """Return one message per window, stamped at the end of the window."""
        state, _ = self.ended(state)
        if not state.kept:
            return []
        way = self.smoothed_once(state)
        scales = self._scales(state)
        window_of = self._windows(way, state.carried.time_ns)
        found, offsets = self._gramians(state, way, window_of)
        run = run_of_rows(offsets)
        spectra = [
            spectrum(each, scale) for each, scale in zip(found.covariance, scales[run], strict=True)
        ]
        is_first = np.ones(len(run), bool)
        is_first[1:] = run[1:] != run[:-1]
        before_ns = np.append(0, found.time_ns[:-1])
        t = self.bound_model.model.tangent
        stream = make_stream(
            f"/estimates/{self.name}/observability",
            schemas.OBSERVABILITY,
            found.time_ns,
            metadata={"components": ",".join(self.components)},
            begin_time_ns=np.where(is_first, state.carried.time_ns[run], before_ns),
            rank=np.array([each.rank for each in spectra], np.int64),
            measurements=found.mean[:, 0].astype(np.int64),
            eigenvalues=np.array([each.eigenvalues for each in spectra]).reshape(-1, t),
            direction=np.array([each.direction for each in spectra]).reshape(-1, t),
        )
        return [Ragged(stream, offsets)]

    @property
    def components(self) -> list[str]:
        """Names of the components of the tangent space."""
        model = self.bound_model.model
        return [name for name, _ in tangent_components(list(model.state), model.kinds)]

    def _scales(self, state: FilterState) -> Floats:
        """Return the scale of every tangent component (runs, t)."""
        scales: Floats = np.sqrt(np.diagonal(state.carried.belief.covariance, axis1=1, axis2=2))
        model = self.bound_model.model
        for name, scale in named_now(self.parameters.scales, list(model.state), model.kinds).items():
            if name not in self.components:
                raise BadInput(
                    f"estimator {self.name}: --scale {name}: the state has no such component; "
                    f"{choices(name, self.components)}"
                )
            scales[:, self.components.index(name)] = scale
        return scales

    def _windows(self, way: Way, start_ns: Integers) -> Integers:
        """Return the number of each node's window; the last window includes all remaining nodes."""
        run = run_of_rows(way.offsets)
        since_ns = way.nodes.time_ns - start_ns[run]
        if self.parameters.window_s is None:
            return np.zeros(len(run), np.int64)
        length_ns = max(round(self.parameters.window_s * 1e9), 1)
        span_ns = np.append(way.nodes.time_ns, 0)[way.offsets[1:] - 1] - start_ns
        last = np.maximum(span_ns // length_ns - 1, 0)
        windows: Integers = np.minimum(np.maximum(since_ns - 1, 0) // length_ns, last[run])
        return windows

    def _gramians(
        self, state: FilterState, way: Way, window_of: Integers
    ) -> tuple[EstimateRows, Integers]:
        """Return the Gramian and the number of messages of every window, and the offsets of the runs."""
        bound_model, offsets, runs = self.bound_model, way.offsets, len(way.offsets) - 1
        t, (loop, steps) = bound_model.model.tangent, _summing(bound_model)
        ends = np.append(np.diff(window_of) != 0, True)[: len(window_of)]
        ends[offsets[1:][np.diff(offsets) > 0] - 1] = True
        events = way.events
        events = events._replace(wants_estimate=events.wants_estimate & ends[way.node])
        due = np.append(0, np.cumsum(ends))[offsets]
        one = np.arange(runs + 1)
        _, innovations = no_results(
            due, one, bound_model.model, len(innovation_components(bound_model.sensors))
        )
        count = due[-1]
        found = EstimateRows(
            due[:-1].copy(), np.empty(count, np.int64), np.empty((count, 1)), np.empty((count, t, t))
        )
        unit = np.repeat(np.eye(t)[None], runs, axis=0)
        carried = copied(
            state.carried._replace(
                belief=Gramian(unit, np.zeros((runs, t, t)), np.zeros(runs, np.int64))
            )
        )
        settings = self.settings_of_runs(state.context, runs)

        def memory() -> Workspace:
            trajectory = LinearizationTrajectory(way.states.mean, way.node, np.empty((1, t)))
            work: Workspace = steps.memory((trajectory,))
            return work

        inputs, results = RunInputs(events, settings, self.gates), RunResults(found, innovations)
        loop(runs, inputs, carried, results, scratch=memory)
        return filled(found, due)


class Spectrum(NamedTuple):
    """Ascending eigenvalues (t,) of a scaled Gramian, its rank, and the weakest direction (t,)."""

    eigenvalues: Floats
    rank: int
    direction: Floats


def spectrum(information: Floats, scales: Floats) -> Spectrum:
    """Compute the rank, the eigenvalues and the weakest direction of D W D.

    The direction is D e for the eigenvector e of the smallest eigenvalue, in state units, normalised to
    length one. A component with a scale of zero is known exactly; it is left out, and its eigenvalue is
    infinite.

    Args:
        information: W (t, t), of the state at the start of a window.
        scales: the diagonal of D, the prior's standard deviations (t,).
    """
    known = scales == 0.0
    scaled = scales[:, None] * information * scales
    values, vectors = np.linalg.eigh(scaled[np.ix_(~known, ~known)])
    direction = np.zeros(len(scales))
    if len(values):
        direction[~known] = scales[~known] * vectors[:, 0]
        direction /= np.linalg.norm(direction)
        direction *= np.sign(direction[np.argmax(np.abs(direction))])
    rank = int(np.sum(values > RANK_TOLERANCE * len(values) * values.max(initial=0.0))) + int(
        known.sum()
    )
    return Spectrum(np.append(values, np.full(known.sum(), np.finfo(float).max)), rank, direction)


def in_words(found: Spectrum, components: Sequence[str]) -> str:
    """Describe the weakest direction in a sentence."""
    largest = np.abs(found.direction).max(initial=0.0)
    moved = [
        f"{share:+.3g} {name}"
        for name, share in zip(components, found.direction, strict=True)
        if abs(share) > 1e-3 * largest
    ]
    weakest = float(found.eigenvalues[0])
    strength = f"as much as {weakest:.3g} priors"
    if found.rank < len(components):
        strength = "not observable, weaker than the prior"
    elif weakest < WEAK:
        strength += ", weaker than the prior"
    return f"{' '.join(moved)}: {strength}"


METHOD = Method(
    "observability of the state from the measurements",
    ObservabilityParameters,
    ITERATED.steps,
    lacks=ITERATED.lacks,
    filtering=Observability,
)
OBSERVABILITY = of_any_model(METHOD)


def observability_of(model: Model) -> AnyEstimator:
    """Make the observability estimator for one model; raise BadInput if the model is unsuitable."""
    return modelled_by(model, METHOD, "observability")
