"""Cooperative localization: robots that share position estimates when they see each other.

Every robot follows its odometry; the anchors use the mapped landmarks as well. When a robot sees
another, each of the two takes the sighting as a measurement of itself that rests on the other one:
as if that were independent (naive), or by covariance intersection (Jin, Lee, Hashimoto, DIND networks,
4.2 and 5.2; the sensor's own noise is independent). The joint filter keeps all correlations, as a centre
could.
"""

import copy
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Topic
from recorders.models.planar import drive, range_bearing
from recorders.parameters import Parameters
from replay.engine.blocks import Block, Ragged
from replay.engine.compile import compile_over_runs
from replay.engine.estimator import Bound, Estimator, Recursive
from replay.engine.failures import Failure
from replay.engine.priors import no_priors, read_priors
from replay.engine.results import ALL_WELL, failures_by_run, failures_of, state_stream
from replay.estimators.covariance_intersection import Criterion, Stake, blend, sighting_weight
from replay.estimators.landmarks import LANDMARKS, POSE, LocalizationParameters
from replay.inference.binding import stated
from replay.inference.gaussian import (
    Floats,
    Function,
    Innovation,
    add_through,
    kalman_step,
    keep_measured,
    reduce_covariance,
    whiten,
    wrap,
)
from replay.inference.generate import Input, derivative
from replay.inference.happenings import Points, points_of
from replay.inference.steps import FAILURES, NOT_FINITE, NOT_POSITIVE_DEFINITE

Integers = NDArray[np.int64]
Mode = Literal["alone", "naive", "ci", "joint"]


class CooperativeParameters(Parameters):
    """How sightings of robots are used, and who uses landmarks; None takes what the channels state.

    `criterion` is what CI makes least: the trace of a pose's covariance, in m^2 + rad^2, or its
    determinant.
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
    told: NDArray[np.bool_]


class Settings(NamedTuple):
    """Noise of the robots' odometry and sensors, both (n, 2), who is an anchor, and the gate."""

    density: Floats
    variance: Floats
    anchor: NDArray[np.bool_]
    gate: Floats


class Events(NamedTuple):
    """The events of all runs in order: whose they are, and what they say.

    `robots` (m, 2) are the one that speaks and the one that it sees, -1 where it sees none. Odometry has
    the value (forward, turn) and `is_sighting` false; a sighting has (range, bearing), of a robot or of
    the map's row `place`. `emit` is the row of the output that an event fills, -1 for none.
    """

    offsets: Integers
    time_ns: Integers
    robots: Integers
    is_sighting: NDArray[np.bool_]
    place: Integers
    value: Floats
    emit: Integers


class Results(NamedTuple):
    """Poses (m, 3) and covariances (m, 3, 3), NaN after a failure."""

    mean: Floats
    covariance: Floats


class Sighting(NamedTuple):
    """What is worked out of a sighting; first axis = the robot that sees, the one that is seen.

    The innovation (2,), its rows (2, 2, 3) by both poses and its spreads (2, 2, 2) by both covariances.
    """

    innovation: Floats
    rows: Floats
    spread: Floats


class Linear(NamedTuple):
    """A robot's drive, linearised: the end (3,), by the pose (3, 3) and by the velocity (3, 2)."""

    state: Floats
    transition: Floats
    gain: Floats


class Seen(NamedTuple):
    """Range and bearing of a place (2,), and by the pose (2, 3)."""

    predicted: Floats
    rows: Floats


KINDS = tuple(POSE.values())
linear_drive = derivative(
    drive,
    [Input("pose", KINDS, "transition"), Input("velocity", ("linear", "linear"), "gain")],
    KINDS,
    ("duration_s",),
    "state",
)
linear_sight = derivative(
    range_bearing, [Input("pose", KINDS, "rows")], ("linear", "angle"), ("place",), "predicted"
)


def advance(carried: Carried, run: int, robot: int, time_ns: int, density: Floats) -> None:
    """Move one robot to a time by its odometry, with its correlations."""
    duration_s = (time_ns - carried.time_ns[run, robot]) * 1e-9
    if duration_s <= 0.0:
        return
    carried.time_ns[run, robot] = time_ns
    mean, covariance, first = carried.mean[run], carried.covariance[run], 3 * robot
    velocity = carried.velocity[run, robot]
    pose = (mean[first], mean[first + 1], mean[first + 2])
    work = Linear(np.empty(3), np.empty((3, 3)), np.empty((3, 2)))
    transition, variances = work.transition, np.empty(2)
    linear_drive(pose, (velocity[0], velocity[1]), duration_s, work)
    for k in range(3):
        mean[first + k] = work.state[k]
    for k in range(2):
        variances[k] = density[k] * density[k] / duration_s
    moved = np.empty(3)
    for other in range(len(mean)):  # F P, and beside it P F'
        if first <= other < first + 3:
            continue
        for row in range(3):
            moved[row] = 0.0
            for k in range(3):
                moved[row] += transition[row, k] * covariance[first + k, other]
        for row in range(3):
            covariance[first + row, other] = covariance[other, first + row] = moved[row]
    own = np.empty((3, 3))
    fill_spread(covariance, first, transition, own)
    add_through(own, work.gain, variances)
    for row in range(3):
        for column in range(3):
            covariance[first + row, first + column] = own[row, column]


def fill_spread(covariance: Floats, first: int, rows: Floats, spread: Floats) -> None:
    """Fill rows P rows' with the block P (3, 3) of one robot; symmetric by construction."""
    for row in range(len(rows)):
        for column in range(row + 1):
            entry = 0.0
            for k in range(3):
                for m in range(3):
                    entry += rows[row, k] * covariance[first + k, first + m] * rows[column, m]
            spread[row, column] = spread[column, row] = entry


def fill_square(covariance: Floats, first: int, rows: Floats, square: Floats) -> float:
    """Fill rows P P rows' with the block P (3, 3) of one robot; returns its trace."""
    cross, trace = np.empty((3, 2)), 0.0
    for k in range(3):
        trace += covariance[first + k, first + k]
        for row in range(2):
            cross[k, row] = 0.0
            for m in range(3):
                cross[k, row] += covariance[first + k, first + m] * rows[row, m]
    for row in range(2):
        for column in range(2):
            square[row, column] = 0.0
            for k in range(3):
                square[row, column] += cross[k, row] * cross[k, column]
    return trace


def scale(covariance: Floats, first: int, factor: float) -> None:
    """Scale the block of one robot."""
    for row in range(3):
        for column in range(3):
            covariance[first + row, first + column] *= factor


def look(
    mean: Floats, robot: int, place: tuple[float, float], value: Floats, sighting: Sighting
) -> None:
    """Fill the innovation of a robot's sighting of a place, and its rows."""
    first = 3 * robot
    pose = (mean[first], mean[first + 1], mean[first + 2])
    work = Seen(np.empty(2), sighting.rows[0])
    linear_sight(pose, place, work)
    sighting.innovation[0] = value[0] - work.predicted[0]
    sighting.innovation[1] = wrap(value[1] - work.predicted[1], True)
    for row in range(2):
        for k in range(2):
            sighting.rows[1, row, k] = -sighting.rows[0, row, k]
        sighting.rows[1, row, 2] = 0.0


def update(
    mean: Floats,
    covariance: Floats,
    first: Integers,
    sides: tuple[int, int],
    sighting: Sighting,
    noise: Floats,
    gate: Floats,
) -> tuple[float, bool]:
    """The extended Kalman filter's update of the robots on these sides: NIS, and whether it was made."""
    cross, spread, difference = np.zeros((len(mean), 2)), np.empty((2, 2)), np.empty(2)
    for row in range(2):
        difference[row] = sighting.innovation[row]
        for side in range(sides[0], sides[1]):
            for other in range(len(mean)):
                for k in range(3):
                    cross[other, row] += covariance[other, first[side] + k] * sighting.rows[side, row, k]
    for row in range(2):
        for column in range(2):
            entry = noise[row, column]
            for side in range(sides[0], sides[1]):
                for k in range(3):
                    entry += sighting.rows[side, row, k] * cross[first[side] + k, column]
            spread[row, column] = entry
    innovation, step = Innovation(difference, spread, cross), np.empty(len(mean))
    size = keep_measured(innovation)
    squared, _ = whiten(innovation, size)
    if not squared <= gate[size]:
        return squared, False
    kalman_step(innovation, size, step)
    reduce_covariance(covariance, cross, size)
    for row in range(len(mean)):
        mean[row] += step[row]
    return squared, True


def cooperation(joint: bool, intersect: bool, by_trace: bool) -> Function:
    """The loop over the events of one run."""

    def meet(
        mean: Floats,
        covariance: Floats,
        robots: Integers,
        sighting: Sighting,
        variance: Floats,
        gate: Floats,
    ) -> bool:
        """Use a sighting; False where a covariance is not positive definite."""
        own, noise, square = np.zeros((2, 2)), np.empty((2, 2)), np.empty((2, 2))
        for row in range(2):
            own[row, row] = variance[row]
        first, both = 3 * robots, robots[1] >= 0
        for side in range(1 + both):
            fill_spread(covariance, first[side], sighting.rows[side], sighting.spread[side])
        for side in range(1 + (both and not joint)):
            weight, share = 1.0, 0.0
            if both and not joint:
                share = 1.0
                if intersect:
                    trace = fill_square(covariance, first[side], sighting.rows[side], square)
                    stake = Stake(3, trace, sighting.spread[side], square)
                    weight = sighting_weight(by_trace, stake, sighting.spread[1 - side], own)
                    share = 1.0 / (1.0 - weight)
            blend(1.0, own, share, sighting.spread[1 - side], noise)
            scale(covariance, first[side], 1.0 / weight)
            sides = (side, side + 1 + (both and joint))
            squared, used = update(mean, covariance, first, sides, sighting, noise, gate)
            if np.isnan(squared):
                return False
            if not used:
                scale(covariance, first[side], weight)
        return True

    def cooperate(
        run: int, events: Events, places: Floats, settings: Settings, carried: Carried, results: Results
    ) -> None:
        mean, covariance = carried.mean[run], carried.covariance[run]
        sighting = Sighting(np.empty(2), np.empty((2, 2, 3)), np.zeros((2, 2, 2)))
        for event in range(events.offsets[run], events.offsets[run + 1]):
            robots, now = events.robots[event], events.time_ns[event]
            robot, seen = robots[0], robots[1]
            if carried.failure[run] != ALL_WELL or now < carried.time_ns[run, robot]:
                continue
            for side in range(2):
                if robots[side] >= 0:
                    density = settings.density[robots[side]]
                    advance(carried, run, robots[side], now, density)
            if events.is_sighting[event]:
                if seen >= 0:
                    place = (mean[3 * seen], mean[3 * seen + 1])
                else:
                    place = (places[events.place[event], 0], places[events.place[event], 1])
                look(mean, robot, place, events.value[event], sighting)
                variance = settings.variance[robot]
                if not meet(mean, covariance, robots, sighting, variance, settings.gate):
                    carried.failure[run] = NOT_POSITIVE_DEFINITE
                    continue
            else:
                for k in range(2):
                    carried.velocity[run, robot, k] = events.value[event, k]
            if not np.isfinite(mean.sum()):
                carried.failure[run] = NOT_FINITE
            elif events.emit[event] >= 0:
                for row in range(3):
                    results.mean[events.emit[event], row] = mean[3 * robot + row]
                    for column in range(3):
                        results.covariance[events.emit[event], row, column] = covariance[
                            3 * robot + row, 3 * robot + column
                        ]

    return cooperate


@lru_cache(maxsize=8)
def _compiled(mode: Mode, criterion: Criterion) -> Function:
    return compile_over_runs(cooperation(mode == "joint", mode == "ci", criterion == "trace"))


def begin(whole: Mapping[str, Ragged], prefixes: tuple[str, ...]) -> State:
    """All robots at their priors, and the maps.

    A robot whose prior cannot be used takes no part, and the others do not use it. Raises BadInput where
    that is so for all, or the map is not planar.
    """
    priors, errors = [], []
    for prefix in prefixes:
        prior = whole[f"{prefix}/prior"]
        try:
            priors.append(read_priors(prior, POSE))
        except BadInput as error:
            errors.append(error)
            priors.append(no_priors(prior.runs, POSE, str(error)))
    if len(errors) == len(prefixes):
        raise errors[0]
    runs, size = len(priors[0].mean), 3 * len(prefixes)
    covariance = np.zeros((runs, size, size))
    for index, each in enumerate(priors):
        covariance[:, 3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = each.covariance
    mean = np.concatenate([each.mean for each in priors], axis=1)
    carried = Carried(
        np.nan_to_num(mean),
        np.nan_to_num(covariance),
        np.zeros((runs, len(prefixes), 2)),
        np.stack([each.time_ns for each in priors], axis=1),
        np.full(runs, ALL_WELL),
    )
    reasons = np.stack([each.reasons for each in priors], axis=1)
    return State(carried, points_of(whole["/landmarks"], LANDMARKS), reasons, reasons == "")


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
    """Filter a block; see `replay.engine.estimator.Recursive`."""
    before, landmarks, reasons, told = state
    carried = copy.deepcopy(before)
    is_able = reasons == ""
    events = _events(block, landmarks, prefixes, mode, settings, carried.time_ns, is_able)
    count = int(events.emit.max(initial=-1)) + 1
    results = Results(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan))
    loop = _compiled(mode, criterion)
    loop(len(carried.mean), events, landmarks.places, settings, carried, results)
    poses = [_poses(name, prefixes, robot, events, results) for robot in range(len(prefixes))]
    failed_ns = carried.time_ns.max(axis=1)
    failures = failures_of(f"/estimates/{name}", before.failure, carried.failure, failed_ns, FAILURES)
    told, excluded = _excluded(name, prefixes, block, reasons, told)
    return State(carried, landmarks, reasons, told), [*poses, failures, *excluded]


def _excluded(
    name: str,
    prefixes: tuple[str, ...],
    block: Block,
    reasons: NDArray[np.str_],
    told: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], list[Ragged]]:
    """Who takes no part (runs, robots) was told of, each at its first odometry; and these failures."""
    told, outputs = told.copy(), []
    for robot, prefix in enumerate(prefixes):
        odometry = block.streams[f"{prefix}/odometry"]
        new = np.flatnonzero(~told[:, robot] & (np.diff(odometry.offsets) > 0))
        told[new, robot] = True
        times_ns = odometry.stream.publish_time_ns[odometry.offsets[new]]
        failures = {
            run: Failure(time_ns, str(reasons[run, robot]))
            for run, time_ns in zip(new.tolist(), times_ns.tolist(), strict=True)
        }
        outputs.append(failures_by_run(f"/estimates/{name}{prefix}", failures, len(told)))
    return told, outputs


def _poses(name: str, prefixes: tuple[str, ...], robot: int, events: Events, results: Results) -> Ragged:
    """The estimates of one robot, up to a failure of its run."""
    rows = np.flatnonzero((events.emit >= 0) & (events.robots[:, 0] == robot))
    rows = rows[np.isfinite(results.mean[events.emit[rows], 0])]
    mean, covariance = (part[events.emit[rows]] for part in results)
    prefix = prefixes[robot]
    topic = f"/estimates/{name}{prefix}/pose"
    stream = state_stream(topic, events.time_ns[rows], POSE, f"{prefix}/truth", mean, covariance)
    return Ragged(stream, np.searchsorted(rows, events.offsets))


def _events(
    block: Block,
    landmarks: Points,
    prefixes: tuple[str, ...],
    mode: Mode,
    settings: Settings,
    start_ns: Integers,
    is_able: NDArray[np.bool_],
) -> Events:
    """The block's events as columns; a robot's estimate is due at its odometry.

    `is_able` (runs, robots) says who takes part.
    """
    order = block.events
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
    place = landmarks.rows(run_of, target_id)
    is_mapped = (sees == 1) & (place >= 0) & settings.anchor[robot] & acts
    due = (sees == 0) & (order.time_ns >= start_ns[run_of, robot]) & acts
    kept = np.flatnonzero(((sees == 0) & acts) | is_mapped | (is_fellow & (mode != "alone")))
    return Events(
        np.searchsorted(kept, order.offsets),
        order.time_ns[kept],
        np.stack([robot, np.where(is_fellow, fellow, -1)], axis=1)[kept],
        sees[kept] == 1,
        place[kept],
        value[kept],
        np.where(due, np.cumsum(due) - 1, -1)[kept],
    )


def _number(prefix: str) -> int:
    return int(prefix.removeprefix("/robot"))


def _robots(topics: Mapping[str, Topic]) -> tuple[str, ...]:
    """The prefixes of the robots that have what is needed, by number."""
    found = (topic.removesuffix("/odometry") for topic in topics if topic.endswith("/odometry"))
    able = [
        prefix
        for prefix in found
        if prefix.removeprefix("/robot").isdigit()
        and {f"{prefix}/range_bearing", f"{prefix}/prior"} <= topics.keys()
    ]
    return tuple(sorted(able, key=_number))


def _bind(name: str, topics: Mapping[str, Topic], parameters: CooperativeParameters) -> list[Bound]:
    """One filter for all robots; raises BadInput where an anchor is not among them."""
    prefixes = _robots(topics)
    if len(prefixes) < 2 or "/landmarks" not in topics:
        return []
    numbers = [_number(prefix) for prefix in prefixes]
    for anchor in parameters.anchors:
        if anchor not in numbers:
            raise BadInput(
                f"estimator {name}: anchor {anchor} is none of the robots "
                f"{', '.join(map(str, numbers))}; name those that know the map with --set anchors=[...]"
            )
    density, variance = np.empty((len(prefixes), 2)), np.empty((len(prefixes), 2))

    def number(topic: str, key: str) -> float:
        """A parameter as given, else as its channel states it."""
        given = getattr(parameters, key)
        return stated(LocalizationParameters, [topics[topic]], key) if given is None else given

    for row, prefix in enumerate(prefixes):
        for column, key in enumerate(("forward_noise_density", "turn_noise_density")):
            density[row, column] = number(f"{prefix}/odometry", key)
        for column, key in enumerate(("sigma_range_m", "sigma_bearing_rad")):
            variance[row, column] = number(f"{prefix}/range_bearing", key) ** 2
    settings = Settings(
        density,
        variance,
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
