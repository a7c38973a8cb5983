"""Cooperative localization of robots that share position estimates when they see each other.

Every robot integrates its odometry; the anchors also use the mapped landmarks. When a robot sees
another, each of the two updates its own pose with the sighting and the other's estimate, either as if
the estimates were independent (naive) or by covariance intersection (Jin, Lee, Hashimoto, DIND networks,
4.2 and 5.2; the noise of the sensor is independent). The joint filter keeps all correlations, as a
central node could.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine import chi2
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Booleans, Floats
from fuselog.replay.engine.streams.blocks import Block, Ragged, run_of_rows
from fuselog.replay.engine.streams.channels import given_or_stated, numbered
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.priors import Priors, no_priors, priors_of
from fuselog.replay.engine.streams.results import ALL_WELL, failures_by_run, failures_of, states_in
from fuselog.replay.estimators.landmarks import LANDMARKS, POSE
from fuselog.replay.families.networks.covariance_intersection import Criterion
from fuselog.replay.families.networks.encounters import (
    RobotEvents,
    RobotInputs,
    RobotMemory,
    RobotResults,
    RobotSettings,
    RobotStates,
    SightingFusion,
    cooperate,
    write_pose,
)
from fuselog.replay.inference.kalman.steps import FAILURES
from fuselog.replay.inference.linear_algebra.small_matrices import update_memory
from fuselog.replay.inference.run.events import Points, points_of
from fuselog.replay.inference.run.loops import over_events

Mode = Literal["alone", "naive", "ci", "joint"]


class CooperativeParameters(Parameters):
    """Settings of the fusion of sightings, and the robots that use landmarks.

    Noise that is not set is read from the channels.

    Attributes:
        mode: how sightings are fused: not at all (alone), as if estimates were independent (naive), by
            covariance intersection (ci), or in one filter for all robots (joint).
        criterion: quantity that covariance intersection minimizes: the trace of a pose's covariance, in
            m^2 + rad^2, or its determinant.
        anchors: numbers of the robots that know the map.
        forward_noise_density: noise of the forward speed, in m/s/sqrt(Hz): its standard deviation
            times the square root of the time step.
        turn_noise_density: noise of the turn rate, in rad/s/sqrt(Hz): its standard deviation times the
            square root of the time step.
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        gate_probability: a measurement is rejected if its NIS exceeds this quantile of chi-square; 1
            accepts all.
    """

    mode: Mode = "ci"
    criterion: Criterion = "trace"
    anchors: tuple[int, ...] = (3,)
    forward_noise_density: NonNegativeFloat | None = None
    turn_noise_density: NonNegativeFloat | None = None
    sigma_range_m: PositiveFloat | None = None
    sigma_bearing_rad: PositiveFloat | None = None
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 0.999


class CooperativeState(NamedTuple):
    """States of the robots, and the reasons (runs, robots) why robots do not take part ("" if they do).

    `announced` marks the robots whose reason has been reported or need not be reported.
    """

    robots: RobotStates
    landmarks: Points
    reasons: NDArray[np.str_]
    announced: Booleans


def memory(states: int) -> RobotMemory:
    """Allocate scratch memory for one run with `states` states."""
    return RobotMemory(
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


_cooperate = compile_over_runs(over_events(cooperate, write_pose), title="robots that see each other")


Cooperating = Given[CooperativeParameters]


def start(given: Cooperating) -> tuple[Cooperating, CooperativeState]:
    """Return the settings and the initial state: the priors of all robots, and the maps.

    A robot whose prior cannot be used does not take part, and other robots do not use its estimates.
    Raises BadInput if no robot has a usable prior, or if the map is not planar.
    """
    prefixes, _ = given.setup
    priors = [_prior(given[f"{prefix}/prior"]) for prefix in prefixes]
    reasons = np.stack([each.reasons for each in priors], axis=1)
    if (reasons != "").all():
        raise BadInput(f"{reasons[0, 0]}; the filter cannot start")
    runs, size = len(reasons), 3 * len(prefixes)
    covariance = np.zeros((runs, size, size))
    for index, each in enumerate(priors):
        covariance[:, 3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = each.covariance
    robots = RobotStates(
        np.nan_to_num(np.concatenate([each.mean for each in priors], axis=1)),
        np.nan_to_num(covariance),
        np.zeros((runs, len(prefixes), 2)),
        np.stack([each.time_ns for each in priors], axis=1),
        np.full(runs, ALL_WELL),
    )
    points = points_of(given["/landmarks"], LANDMARKS)
    return given, CooperativeState(robots, points, reasons, reasons == "")


def _prior(prior: Ragged) -> Priors:
    try:
        return priors_of(prior, POSE)
    except BadInput as error:
        return no_priors(prior.runs, POSE, str(error))


def advance(
    given: Cooperating, state: CooperativeState, block: Block
) -> tuple[CooperativeState, list[Ragged]]:
    """Filter a block; see `fuselog.replay.engine.api.functions.recursive`."""
    (prefixes, settings), mode = given.setup, given.parameters.mode
    robots = copy.deepcopy(state.robots)
    events = _events(block, state, prefixes, mode, settings)
    count, topic = len(events.time_ns), f"/estimates/{given.name}"
    results = RobotResults(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan))
    fusion = SightingFusion(mode == "joint", mode == "ci", given.parameters.criterion == "trace")
    scratch = partial(memory, robots.mean.shape[1])
    inputs = RobotInputs(events, settings, fusion)
    _cooperate(given.runs, inputs, robots, results, scratch=scratch)
    is_estimated = np.isfinite(results.mean[:, 0])
    made = [
        states_in(
            np.flatnonzero(is_estimated & (events.robots[:, 0] == robot)),
            f"{topic}{prefix}/pose",
            events.time_ns,
            events.offsets,
            POSE,
            f"{prefix}/truth",
            *results,
        )
        for robot, prefix in enumerate(prefixes)
    ]
    before, failed_ns = state.robots.failure, robots.time_ns.max(axis=1)
    made.append(failures_of(topic, before, robots.failure, failed_ns, FAILURES))
    announced = state.announced.copy()
    for robot, prefix in enumerate(prefixes):  # report unusable robots at their first odometry
        odometry = block.streams[f"{prefix}/odometry"]
        new = np.flatnonzero(~announced[:, robot] & (np.diff(odometry.offsets) > 0))
        announced[new, robot] = True
        times_ns = odometry.stream.publish_time_ns[odometry.offsets[new]]
        failures = {
            run: Failure(time_ns, str(state.reasons[run, robot]))
            for run, time_ns in zip(new.tolist(), times_ns.tolist(), strict=True)
        }
        made.append(failures_by_run(f"{topic}{prefix}", failures, len(announced)))
    return state._replace(robots=robots, announced=announced), made


def _events(
    block: Block, state: CooperativeState, prefixes: Sequence[str], mode: Mode, settings: RobotSettings
) -> RobotEvents:
    """Return the events of a block as columns; a robot's estimate is due at its odometry messages."""
    order, is_able = block.events, state.reasons == ""
    value = np.stack(
        [block.column("forward_mps", "range_m"), block.column("turn_radps", "bearing_rad")], axis=1
    )
    target_id = block.column("target_id", missing=0).astype(np.int64)
    run_of = run_of_rows(order.offsets)
    robot, sees = np.divmod(order.topic, 2)
    numbers = np.array([_number(prefix) for prefix in prefixes])
    fellow = np.minimum(np.searchsorted(numbers, target_id), len(numbers) - 1)
    acts = is_able[run_of, robot]
    is_fellow = (sees == 1) & (numbers[fellow] == target_id) & (fellow != robot) & acts
    is_fellow &= is_able[run_of, fellow]
    mapped = state.landmarks.rows(run_of, target_id)
    is_mapped = (sees == 1) & (mapped >= 0) & settings.anchor[robot] & acts
    due = (sees == 0) & (order.time_ns >= state.robots.time_ns[run_of, robot]) & acts
    kept = np.flatnonzero(((sees == 0) & acts) | is_mapped | (is_fellow & (mode != "alone")))
    return RobotEvents(
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
    """Return the prefixes of the robots that have all required topics, sorted by number."""
    leaves = {
        "odometry": schemas.ODOMETRY,
        "range_bearing": schemas.RANGE_BEARING,
        "prior": schemas.GAUSSIAN_ESTIMATE,
    }
    found = [numbered(topics, "robot", leaf, schema) for leaf, schema in leaves.items()]
    return tuple(f"/robot{number}" for number in found[0] if all(number in each for each in found))


def _find(
    name: str, topics: Mapping[str, Topic], parameters: CooperativeParameters
) -> Iterator[Binding]:
    """Yield one filter for all robots; raise BadInput if an anchor is not one of the robots."""
    prefixes = _robots(topics)
    if len(prefixes) < 2 or "/landmarks" not in topics:
        return
    numbers = [_number(prefix) for prefix in prefixes]
    for anchor in parameters.anchors:
        if anchor not in numbers:
            raise BadInput(
                f"estimator {name}: anchor {anchor} is not one of the robots "
                f"{', '.join(map(str, numbers))}; list the robots that know the map with "
                "--set anchors=[...]"
            )

    def stated(leaf: str, *names: str) -> Floats:
        found = [
            [given_or_stated(parameters, [topics[f"{prefix}/{leaf}"]], each) for each in names]
            for prefix in prefixes
        ]
        return np.array(found)

    settings = RobotSettings(
        stated("odometry", "forward_noise_density", "turn_noise_density"),
        stated("range_bearing", "sigma_range_m", "sigma_bearing_rad") ** 2,
        np.isin(numbers, parameters.anchors),
        np.array([np.inf, *chi2.ppf(parameters.gate_probability, [1, 2])]),
    )
    leaves = [(prefix, leaf) for prefix in prefixes for leaf in ("odometry", "range_bearing")]
    streams = [f"{prefix}/{leaf}" for prefix, leaf in leaves]
    static = [*(f"{prefix}/prior" for prefix in prefixes), "/landmarks"]
    followed, fixed = ({each: topics[each] for each in names} for names in (streams, static))
    yield Binding(followed, fixed, setup=(prefixes, settings))


COOPERATIVE = recursive(
    "robots that share position estimates when they see each other: alone, naive, ci, joint",
    parameters=CooperativeParameters,
    find=_find,
    requirements="/landmarks and, for two or more robots, .../odometry, .../range_bearing, .../prior",
    start=start,
    advance=advance,
    variant="mode",
)
