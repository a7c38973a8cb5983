"""Cooperative localization: robots that share position estimates when they see each other.

Every robot follows its odometry; the anchors use the mapped landmarks as well. When a robot sees
another, each of the two takes the sighting as a measurement of itself that rests on the other one:
as if that were independent (naive), or by covariance intersection (Jin, Lee, Hashimoto, DIND networks,
4.2 and 5.2; the sensor's own noise is independent). The joint filter keeps all correlations, as a centre
could.
"""

import copy
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from recorders.errors import BadInput
from recorders.log import Topic, schemas
from recorders.models.planar import drive
from recorders.parameters import Parameters
from replay.distributions import chi2
from replay.engine.arrays import Booleans, Floats, Function, Integers
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.replaying.estimator import Bound, Estimator, Recursive
from replay.engine.streams.blocks import Block, Ragged
from replay.engine.streams.channels import given_or_stated, numbered
from replay.engine.streams.failures import Failure
from replay.engine.streams.priors import Priors, no_priors, priors_of
from replay.engine.streams.results import ALL_WELL, failures_by_run, failures_of, states_in
from replay.estimators.models.landmarks import LANDMARKS, POSE, sight
from replay.estimators.networks.covariance_intersection import Criterion, Stake, blend, sighting_weight
from replay.inference.kalman.steps import FAILURES, NOT_FINITE, NOT_POSITIVE_DEFINITE
from replay.inference.linear_algebra.gaussian import add_through, copy_gaussian, wrap
from replay.inference.linear_algebra.linearization import Input, derivative
from replay.inference.linear_algebra.small_matrices import UpdateMemory, update, update_memory
from replay.inference.run.events import Points, points_of
from replay.tracing.functions import traced

Mode = Literal["alone", "naive", "ci", "joint"]


class CooperativeParameters(Parameters):
    """How robots use their sightings of each other, and which of them use landmarks.

    Noise that is none is what the channels state.

    Attributes:
        mode: how sightings are fused: not at all (alone), as if independent (naive), by covariance
            intersection (ci), or in one filter of all robots (joint).
        criterion: what covariance intersection makes least: the trace of a pose's covariance, in m^2 +
            rad^2, or its determinant.
        anchors: numbers of the robots that know the map.
        forward_noise_density: noise of the forward speed, in m/s/sqrt(Hz): its standard deviation times
            the root of the step.
        turn_noise_density: noise of the turn rate, in rad/s/sqrt(Hz): its standard deviation times the
            root of the step.
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        gate_probability: a measurement whose NIS is beyond this quantile of chi-square is not used; 1
            uses all.
    """

    mode: Mode = "ci"
    criterion: Criterion = "trace"
    anchors: tuple[int, ...] = (3,)
    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


class Carried(NamedTuple):
    """What goes from block to block; first axis = run. `failure` is one of gaussian's.

    The mean (3 n,) and covariance (3 n, 3 n) are of all n robots; only the joint filter has entries
    between robots.
    """

    mean: Floats
    covariance: Floats
    velocity: Floats
    time_ns: Integers
    failure: Integers


class State(NamedTuple):
    """What goes from block to block, and why robots take no part: (runs, robots), "" where they do.

    `told` says of whom that was told, or need not be.
    """

    carried: Carried
    landmarks: Points
    reasons: NDArray[np.str_]
    told: Booleans


class Settings(NamedTuple):
    """Noise of the robots' odometry and sensors, both (n, 2), who is an anchor, and the gate."""

    density: Floats
    variance: Floats
    anchor: Booleans
    gate: Floats


class Fusion(NamedTuple):
    """How a sighting of another robot is used: in one state of all, by an intersection, or naively.

    The weight of an intersection is that of the least trace or else of the least determinant.
    """

    joint: bool
    intersect: bool
    by_trace: bool


class Events(NamedTuple):
    """The events of all runs in order: whose they are, and what they say.

    `robots` (m, 2) are the one that speaks and the one that it sees, -1 where it sees none. Odometry has
    the value (forward, turn) and `is_sighting` false; a sighting has (range, bearing), of a robot or of
    a landmark's `place` (m, 2). `is_due` says that the speaker's estimate is wanted.
    """

    offsets: Integers
    time_ns: Integers
    robots: Integers
    is_sighting: Booleans
    place: Floats
    value: Floats
    is_due: Booleans


class Results(NamedTuple):
    """The speaker's pose (m, 3) and covariance (m, 3, 3) after every event; NaN where none is said."""

    mean: Floats
    covariance: Floats


class Work(NamedTuple):
    """Memory of one run.

    Attributes:
        state, transition, gain, variances: of a drive (3,), (3, 3), (3, 2), (2,).
        predicted, rows: of a sighting (2,), and by the pose that sees (2, 3).
        both: the same by the pose that sees and the one that is seen, (2, 2, 3).
        spread, square: H P H' and H P P H' of both, (2, 2, 2).
        whole: rows by the state of all robots, (2, 3 n).
        product: (3, 3 n).
        update: see `replay.inference.linear_algebra.small_matrices`.
    """

    state: Floats
    transition: Floats
    gain: Floats
    variances: Floats
    predicted: Floats
    rows: Floats
    both: Floats
    spread: Floats
    square: Floats
    whole: Floats
    product: Floats
    update: UpdateMemory


KINDS = tuple(POSE.values())
linear_drive = derivative(
    traced(drive, 3, 2, None),
    [Input("pose", KINDS, "transition"), Input("velocity", ("linear", "linear"), "gain")],
    KINDS,
    "state",
)
linear_sight = derivative(
    traced(sight, 3, 2), [Input("pose", KINDS, "rows")], ("linear", "angle"), "predicted"
)


def advance(carried: Carried, run: int, robot: int, time_ns: int, density: Floats, work: Work) -> None:
    """Move one robot to a time by its odometry, with its correlations."""
    duration_s = (time_ns - carried.time_ns[run, robot]) * 1e-9
    if duration_s <= 0.0:
        return
    carried.time_ns[run, robot] = time_ns
    mean, covariance, first = carried.mean[run], carried.covariance[run], 3 * robot
    velocity = carried.velocity[run, robot]
    pose = (mean[first], mean[first + 1], mean[first + 2])
    linear_drive(pose, (velocity[0], velocity[1]), duration_s, work)
    for k in range(3):
        mean[first + k] = work.state[k]
    for k in range(2):
        work.variances[k] = density[k] * density[k] / duration_s
    for row in range(3):
        for column in range(len(mean)):
            work.product[row, column] = 0.0
            for k in range(3):
                work.product[row, column] += work.transition[row, k] * covariance[first + k, column]
    own = work.product[:, first : first + 3]
    fill_spread(covariance, first, work.transition, own)
    add_through(own, work.gain, work.variances)
    for row in range(3):
        for column in range(len(mean)):
            covariance[first + row, column] = covariance[column, first + row] = work.product[row, column]


def fill_spread(covariance: Floats, first: int, rows: Floats, spread: Floats) -> None:
    """Fill rows P rows' with the block P (3, 3) of one robot; symmetric by construction."""
    for row in range(len(rows)):
        for column in range(row + 1):
            entry = 0.0
            for k in range(3):
                for m in range(3):
                    entry += rows[row, k] * covariance[first + k, first + m] * rows[column, m]
            spread[row, column] = spread[column, row] = entry


def look(
    mean: Floats, robot: int, place: tuple[float, float], value: Floats, difference: Floats, work: Work
) -> None:
    """Fill the innovation of a robot's sighting of a place, and its rows by both robots."""
    first = 3 * robot
    linear_sight((mean[first], mean[first + 1], mean[first + 2]), place, work)
    for row in range(2):
        difference[row] = wrap(value[row] - work.predicted[row], row == 1)
        for k in range(3):
            work.both[0, row, k] = work.rows[row, k]
            work.both[1, row, k] = -work.rows[row, k] if k < 2 else 0.0


def see_through(covariance: Floats, first: int, side: int, work: Work) -> float:
    """Fill what a sighting says of one robot's block of the covariance; returns the block's trace."""
    rows, trace = work.both[side], 0.0
    fill_spread(covariance, first, rows, work.spread[side])
    for k in range(3):
        trace += covariance[first + k, first + k]
        for row in range(2):
            work.rows[row, k] = 0.0
            for m in range(3):
                work.rows[row, k] += covariance[first + k, first + m] * rows[row, m]
    for row in range(2):
        for column in range(2):
            work.square[side, row, column] = 0.0
            for k in range(3):
                work.square[side, row, column] += work.rows[row, k] * work.rows[column, k]
    return trace


def scale(covariance: Floats, first: int, factor: float) -> None:
    """Scale the block of one robot."""
    for row in range(3):
        for column in range(3):
            covariance[first + row, first + column] *= factor


def meet(
    mean: Floats,
    covariance: Floats,
    robots: Integers,
    difference: Floats,
    variance: Floats,
    gate: float,
    fusion: Fusion,
    work: Work,
) -> bool:
    """Use a sighting; False where a covariance is not positive definite."""
    own, noise, traces = np.zeros((2, 2)), np.empty((2, 2)), np.zeros(2)
    first, both = (3 * robots[0], 3 * robots[1]), robots[1] >= 0
    for row in range(2):
        own[row, row] = variance[row]
    for side in range(1 + both):
        traces[side] = see_through(covariance, first[side], side, work)
    for side in range(1 + (both and not fusion.joint)):
        weight, share = 1.0, 0.0
        if both and not fusion.joint:
            share = 1.0
            if fusion.intersect:
                stake = Stake(3, traces[side], work.spread[side], work.square[side])
                weight = sighting_weight(fusion.by_trace, stake, work.spread[1 - side], own)
                share = 1.0 / (1.0 - weight)
        blend(1.0, own, share, work.spread[1 - side], noise)
        scale(covariance, first[side], 1.0 / weight)
        work.whole[:] = 0.0
        for other in range(side, side + 1 + (both and fusion.joint)):
            for row in range(2):
                for k in range(3):
                    work.whole[row, first[other] + k] = work.both[other, row, k]
        squared = update(mean, covariance, difference, work.whole, noise, work.update, gate)
        if np.isnan(squared):
            return False
        if not squared <= gate:
            scale(covariance, first[side], weight)
    return True


def cooperate(
    run: int,
    events: Events,
    settings: Settings,
    fusion: Fusion,
    carried: Carried,
    results: Results,
    work: Work,
) -> None:
    """Move the robots of one run through its events, until these end or an update fails."""
    mean, covariance = carried.mean[run], carried.covariance[run]
    difference = np.empty(2)
    for event in range(events.offsets[run], events.offsets[run + 1]):
        robots, now = events.robots[event], events.time_ns[event]
        robot, seen = robots[0], robots[1]
        if carried.failure[run] != ALL_WELL or now < carried.time_ns[run, robot]:
            continue
        for side in range(2):
            if robots[side] >= 0:
                density = settings.density[robots[side]]
                advance(carried, run, robots[side], now, density, work)
        if events.is_sighting[event]:
            place = (events.place[event, 0], events.place[event, 1])
            if seen >= 0:
                place = (mean[3 * seen], mean[3 * seen + 1])
            look(mean, robot, place, events.value[event], difference, work)
            measured, variance = 0, settings.variance[robot]
            for k in range(2):
                measured += not np.isnan(difference[k])
            gate = settings.gate[measured]
            if measured > 0 and not meet(
                mean, covariance, robots, difference, variance, gate, fusion, work
            ):
                carried.failure[run] = NOT_POSITIVE_DEFINITE
                continue
        else:
            for k in range(2):
                carried.velocity[run, robot, k] = events.value[event, k]
        total = 0.0
        for row in range(len(mean)):
            total += mean[row]
        if not np.isfinite(total):
            carried.failure[run] = NOT_FINITE
        elif events.is_due[event]:
            first, end = 3 * robot, 3 * robot + 3
            found = results.mean[event], results.covariance[event]
            copy_gaussian(mean[first:end], covariance[first:end, first:end], found[0], found[1])


def memory(states: int) -> Work:
    """Memory for one run of so many states."""
    return Work(
        np.empty(3),
        np.empty((3, 3)),
        np.empty((3, 2)),
        np.empty(2),
        np.empty(2),
        np.empty((2, 3)),
        np.empty((2, 2, 3)),
        np.zeros((2, 2, 2)),
        np.empty((2, 2, 2)),
        np.empty((2, states)),
        np.empty((3, states)),
        update_memory(states, 2),
    )


@cache
def _compiled() -> Function:
    return compile_over_runs(cooperate, allocates=False)


def begin(whole: Mapping[str, Ragged], prefixes: tuple[str, ...]) -> State:
    """All robots at their priors, and the maps.

    A robot whose prior cannot be used takes no part, and the others do not use it. Raises BadInput where
    that is so for all, or the map is not planar.
    """
    priors = [_prior(whole[f"{prefix}/prior"]) for prefix in prefixes]
    reasons = np.stack([each.reasons for each in priors], axis=1)
    if (reasons != "").all():
        raise BadInput(f"{reasons[0, 0]}; the filter cannot start")
    runs, size = len(reasons), 3 * len(prefixes)
    covariance = np.zeros((runs, size, size))
    for index, each in enumerate(priors):
        covariance[:, 3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = each.covariance
    carried = Carried(
        np.nan_to_num(np.concatenate([each.mean for each in priors], axis=1)),
        np.nan_to_num(covariance),
        np.zeros((runs, len(prefixes), 2)),
        np.stack([each.time_ns for each in priors], axis=1),
        np.full(runs, ALL_WELL),
    )
    return State(carried, points_of(whole["/landmarks"], LANDMARKS), reasons, reasons == "")


def _prior(prior: Ragged) -> Priors:
    try:
        return priors_of(prior, POSE)
    except BadInput as error:
        return no_priors(prior.runs, POSE, str(error))


def run(
    state: State,
    block: Block,
    *,
    name: str,
    prefixes: tuple[str, ...],
    mode: Mode,
    criterion: Criterion,
    settings: Settings,
) -> tuple[State, list[Ragged]]:
    """Filter a block; see `replay.engine.replaying.estimator.Recursive`."""
    carried = copy.deepcopy(state.carried)
    events = _events(block, state, prefixes, mode, settings)
    count, topic = len(events.time_ns), f"/estimates/{name}"
    results = Results(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan))
    fusion = Fusion(mode == "joint", mode == "ci", criterion == "trace")
    scratch = partial(memory, carried.mean.shape[1])
    _compiled()(len(carried.mean), events, settings, fusion, carried, results, scratch=scratch)
    said = np.isfinite(results.mean[:, 0])
    made = [
        states_in(
            np.flatnonzero(said & (events.robots[:, 0] == robot)),
            f"{topic}{prefix}/pose",
            events.time_ns,
            events.offsets,
            POSE,
            f"{prefix}/truth",
            *results,
        )
        for robot, prefix in enumerate(prefixes)
    ]
    before, failed_ns = state.carried.failure, carried.time_ns.max(axis=1)
    made.append(failures_of(topic, before, carried.failure, failed_ns, FAILURES))
    told = state.told.copy()
    for robot, prefix in enumerate(prefixes):  # who takes no part, each told at its first odometry
        odometry = block.streams[f"{prefix}/odometry"]
        new = np.flatnonzero(~told[:, robot] & (np.diff(odometry.offsets) > 0))
        told[new, robot] = True
        times_ns = odometry.stream.publish_time_ns[odometry.offsets[new]]
        failures = {
            run: Failure(time_ns, str(state.reasons[run, robot]))
            for run, time_ns in zip(new.tolist(), times_ns.tolist(), strict=True)
        }
        made.append(failures_by_run(f"{topic}{prefix}", failures, len(told)))
    return state._replace(carried=carried, told=told), made


def _events(
    block: Block, state: State, prefixes: Sequence[str], mode: Mode, settings: Settings
) -> Events:
    """The block's events as columns; a robot's estimate is due at its odometry."""
    order, is_able = block.events, state.reasons == ""
    value = np.stack(
        [block.column("forward_mps", "range_m"), block.column("turn_radps", "bearing_rad")], axis=1
    )
    target_id = block.column("target_id", missing=0).astype(np.int64)
    run_of = np.repeat(np.arange(len(order.offsets) - 1), np.diff(order.offsets))
    robot, sees = np.divmod(order.topic, 2)
    numbers = np.array([_number(prefix) for prefix in prefixes])
    fellow = np.minimum(np.searchsorted(numbers, target_id), len(numbers) - 1)
    acts = is_able[run_of, robot]
    is_fellow = (sees == 1) & (numbers[fellow] == target_id) & (fellow != robot) & acts
    is_fellow &= is_able[run_of, fellow]
    mapped = state.landmarks.rows(run_of, target_id)
    is_mapped = (sees == 1) & (mapped >= 0) & settings.anchor[robot] & acts
    due = (sees == 0) & (order.time_ns >= state.carried.time_ns[run_of, robot]) & acts
    kept = np.flatnonzero(((sees == 0) & acts) | is_mapped | (is_fellow & (mode != "alone")))
    return Events(
        np.searchsorted(kept, order.offsets),
        order.time_ns[kept],
        np.stack([robot, np.where(is_fellow, fellow, -1)], axis=1)[kept],
        sees[kept] == 1,
        state.landmarks.at(mapped[kept]),
        value[kept],
        due[kept],
    )


def _number(prefix: str) -> int:
    return int(prefix.removeprefix("/robot"))


def _robots(topics: Mapping[str, Topic]) -> tuple[str, ...]:
    """The prefixes of the robots that have what is needed, by number."""
    leaves = {
        "odometry": schemas.ODOMETRY,
        "range_bearing": schemas.RANGE_BEARING,
        "prior": schemas.GAUSSIAN_ESTIMATE,
    }
    found = [numbered(topics, "robot", leaf, schema) for leaf, schema in leaves.items()]
    return tuple(f"/robot{number}" for number in found[0] if all(number in each for each in found))


def _bind(name: str, topics: Mapping[str, Topic], parameters: CooperativeParameters) -> list[Bound]:
    """One filter for all robots; raises BadInput where an anchor is not among them."""
    prefixes = _robots(topics)
    if len(prefixes) < 2 or "/landmarks" not in topics:
        return []
    numbers = [_number(prefix) for prefix in prefixes]
    for anchor in parameters.anchors:
        if anchor not in numbers:
            raise BadInput(
                f"estimator {name}: anchor {anchor} is not one of the robots "
                f"{', '.join(map(str, numbers))}; name those that know the map with --set anchors=[...]"
            )

    def stated(leaf: str, *names: str) -> Floats:
        found = [
            [given_or_stated(parameters, [topics[f"{prefix}/{leaf}"]], each) for each in names]
            for prefix in prefixes
        ]
        return np.array(found)

    settings = Settings(
        stated("odometry", "forward_noise_density", "turn_noise_density"),
        stated("range_bearing", "sigma_range_m", "sigma_bearing_rad") ** 2,
        np.isin(numbers, parameters.anchors),
        np.array([np.inf, *chi2.ppf(parameters.gate_probability, [1, 2])]),
    )
    return [
        Recursive(
            name,
            tuple(f"{prefix}/{leaf}" for prefix in prefixes for leaf in ("odometry", "range_bearing")),
            (*(f"{prefix}/prior" for prefix in prefixes), "/landmarks"),
            partial(begin, prefixes=prefixes),
            partial(
                run,
                name=name,
                prefixes=prefixes,
                mode=parameters.mode,
                criterion=parameters.criterion,
                settings=settings,
            ),
        )
    ]


COOPERATIVE = Estimator(
    "robots that share position estimates when they see each other: alone, naive, ci, joint",
    "/landmarks and, for two robots or more, .../odometry, .../range_bearing and .../prior",
    CooperativeParameters,
    _bind,
    variant="mode",
)
