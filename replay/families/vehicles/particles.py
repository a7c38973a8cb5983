"""Particle filters of cooperative vehicles with unordered fixes.

Sources: Zhang et al., "Cooperative vehicle-infrastructure localization based on the symmetric
measurement equation filter", 2016 (a bootstrap filter with sums of powers, whose exact likelihood is a
permanent for each axis); Doucet, de Freitas, Murphy, Russell, "Rao-Blackwellised particle filtering for
dynamic Bayesian networks", UAI 2000 (here, associations are sampled and vehicles filtered). The name of
a method is `KIND-PARTICLES` or `KIND-PARTICLES-topology`, as in `vehicle-particles:axes-1000-topology`.
"""

import copy
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeInt

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.families.vehicles.models import turn
from fuselog.recorders.log import Topic
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Block, Ragged
from fuselog.replay.families.vehicles.association import (
    all_maps,
    log_likelihoods,
    log_permanents,
)
from fuselog.replay.families.vehicles.streams import (
    Frames,
    VehiclesState,
    find_vehicles,
    frames_of,
    no_results,
    outputs_of,
    start,
)
from fuselog.replay.families.vehicles.updates import Setup, blocks_of, innovations_of
from fuselog.replay.families.vehicles.vehicles import (
    STATES,
    Joint,
    normalised,
    position_rows,
    positions,
    predict,
    topology,
    topology_measurement,
    topology_moments,
    update_by_scalar,
    weigh,
)
from fuselog.replay.inference.sampling.resampling import choose_systematically

KINDS = {
    "set": "states weighted by the exact likelihood of unordered pairs (x, y)",
    "axes": "states weighted by the exact likelihoods of unordered x and of unordered y",
    "associations": "associations, each with its own Kalman filter (Rao-Blackwellized)",
}
LEAST_EFFECTIVE_SHARE = 0.5
_choose = compiled(choose_systematically)


class ParticlesParameters(Parameters):
    """Method, and seed of the random numbers, which also depend on the first fixes of the run.

    Attributes:
        method: kind of the particles (set, axes or associations) and their number, as in
            associations-60; -topology adds the roadside sensor.
        seed: seed of the random numbers.
    """

    method: str = "associations-60"
    seed: NonNegativeInt = 0


class Cloud(NamedTuple):
    """The particles of all runs.

    Each particle is a Gaussian of all vehicles (runs * particles, n). In a bootstrap filter, a particle
    has only a mean, and the covariances are empty. Log weights are (runs, particles). The random number
    generator of a run is made when its first fixes arrive.
    """

    carried: VehiclesState
    joint: Joint
    log_weight: Floats
    generators: list[np.random.Generator | None]


class Method(NamedTuple):
    """Particle method: its kind, see `KINDS`, and its settings."""

    kind: str
    particles: int
    uses_topology: bool
    seed: int


def parse_method(method: str, seed: int) -> Method:
    """Parse the name of a method; raise BadInput if it is unknown."""
    found = re.fullmatch(r"([a-z]+)-([1-9]\d*)(-topology)?", method)
    if found is None or found[1] not in KINDS:
        known = ", ".join(f"{kind}-1000" for kind in KINDS)
        raise BadInput(f"no particle method '{method}'; {choices(method, [known])}")
    return Method(found[1], int(found[2]), found[3] is not None, seed)


def _find(name: str, topics: Mapping[str, Topic], parameters: ParticlesParameters) -> Iterator[Binding]:
    method = parse_method(parameters.method, parameters.seed)
    sensor = "topology" if method.uses_topology else ""
    for each in find_vehicles(name, topics, "set", sensor):
        yield each._replace(setup=(each.setup, method))


def _start(given: Given[ParticlesParameters]) -> tuple[tuple[Setup, Method], Cloud]:
    setup, method = given.setup
    carried = start(setup, given)
    covariance = carried.covariance if method.kind == "associations" else np.empty((given.runs, 0, 0))
    joint = Joint(
        np.repeat(carried.mean, method.particles, axis=0),
        np.repeat(covariance, method.particles, axis=0),
    )
    weights, generators = np.zeros((given.runs, method.particles)), [None] * given.runs
    return (setup, method), Cloud(carried, joint, weights, [*generators])


def _run(settings: tuple[Setup, Method], before: Cloud, block: Block) -> tuple[Cloud, list[Ragged]]:
    """Filter a block; see `fuselog.replay.engine.api.functions.recursive`."""
    (setup, method), cloud = settings, copy.deepcopy(before)
    frames = frames_of(setup, block)
    runs, count = frames.time_ns.shape
    results = no_results(setup, runs, count)
    for number in range(count):
        for run in np.flatnonzero(number < frames.counts).tolist():
            _advance(setup, method, cloud, frames, run, number)
            mean, covariance = _estimate(method, cloud, run)
            results.mean[run, number], results.covariance[run, number] = mean, covariance
    return cloud, list(outputs_of(setup, frames, results, np.zeros(runs, bool)))


def _advance(setup: Setup, method: Method, cloud: Cloud, frames: Frames, run: int, number: int) -> None:
    """Process one frame of one run with its particles, in place."""
    own = slice(run * method.particles, (run + 1) * method.particles)
    rng = _generator(method, cloud, frames, run, number)
    duration_s = (frames.time_ns[run, number] - cloud.carried.time_ns[run]) * 1e-9
    cloud.carried.time_ns[run] = frames.time_ns[run, number]
    joint = Joint(cloud.joint.mean[own], cloud.joint.covariance[own])
    weight = cloud.log_weight[run]
    if method.kind == "associations":
        joint = predict(setup.motion, joint, duration_s)
    else:
        joint = Joint(_moved(setup, joint, duration_s, rng), joint.covariance)
    if frames.has_network[run, number]:
        seen = frames.network[run, number]
        seen = seen[np.isfinite(seen[:, 0])]
        if method.kind == "associations":
            joint, likelihood = _drawn(setup, joint, seen, rng)
            weight = weight + likelihood
        elif len(seen) == setup.motion.vehicles:
            weight = weight + _set_likelihood(setup, method, joint.mean, seen)
    if method.uses_topology and frames.has_sensor[run, number]:
        seen = frames.sensor[run, number]
        seen = seen[np.isfinite(seen[:, 0])]
        if len(seen) == setup.motion.vehicles:
            joint, likelihood = _by_topology(setup, method, joint, seen)
            weight = weight + likelihood
    weight -= weight.max()
    share = np.exp(weight) / np.exp(weight).sum()
    if 1.0 / np.sum(share**2) < LEAST_EFFECTIVE_SHARE * method.particles:
        chosen = np.empty(method.particles, np.int64)
        _choose(share, rng.uniform(), chosen)
        joint, weight = joint.of(chosen), np.zeros(method.particles)
    cloud.joint.mean[own], cloud.joint.covariance[own] = joint
    cloud.log_weight[run] = weight


def _generator(
    method: Method, cloud: Cloud, frames: Frames, run: int, number: int
) -> np.random.Generator:
    """Return a run's generator; if there is none, make it from the first fixes and sample the states."""
    found = cloud.generators[run]
    if found is None:
        seen = frames.network[run, number]
        words = np.ascontiguousarray(seen[np.isfinite(seen)]).view(np.uint32)
        found = np.random.default_rng([method.seed, *words.ravel().tolist()])
        cloud.generators[run] = found
        if method.kind != "associations":
            own = slice(run * method.particles, (run + 1) * method.particles)
            root = np.linalg.cholesky(cloud.carried.covariance[run])
            drawn = found.normal(size=(method.particles, len(root)))
            cloud.joint.mean[own] = cloud.carried.mean[run] + drawn @ root.T
    return found


def _moved(setup: Setup, joint: Joint, duration_s: float, rng: np.random.Generator) -> Floats:
    """Predict states by coordinated turns, each with its own random acceleration."""
    motion = setup.motion
    states = joint.mean.reshape(-1, motion.vehicles, STATES)
    moved = np.stack(turn(np.moveaxis(states, -1, 0), motion.turn_rate_radps, duration_s), axis=-1)
    drawn = rng.normal(size=(*states.shape[:2], 2)) * motion.acceleration_sigma_mps2[:, None]
    moved[..., 0::2] += 0.5 * duration_s**2 * drawn
    moved[..., 1::2] += duration_s * drawn
    return moved.reshape(joint.mean.shape)


def _set_likelihood(setup: Setup, method: Method, mean: Floats, seen: Floats) -> Floats:
    """Compute the log likelihood (particles,) of unordered fixes by one permanent, or one per axis."""
    places = positions(setup.motion, mean)
    squared = (seen - places[:, :, None]) ** 2 / setup.network.variance_m2
    if method.kind == "set":
        return log_permanents(-0.5 * squared.sum(axis=-1))
    return log_permanents(-0.5 * squared[..., 0]) + log_permanents(-0.5 * squared[..., 1])


def _drawn(setup: Setup, joint: Joint, seen: Floats, rng: np.random.Generator) -> tuple[Joint, Floats]:
    """Sample an association for each particle; return the particles and the scan's log likelihood."""
    particles, vehicles = len(joint.mean), setup.motion.vehicles
    rows = position_rows(vehicles, setup.states)
    noise = setup.network.variance_m2 * np.ones(2 * vehicles)
    predicted = (joint.mean @ rows.T).reshape(-1, vehicles, 2)
    spread = blocks_of(rows @ joint.covariance @ rows.T + np.diag(noise), vehicles)
    places = np.broadcast_to(seen, (particles, *seen.shape))
    maps = all_maps(log_likelihoods(predicted, spread, places), setup.network)
    found = weigh(joint, rows, innovations_of(maps, predicted, places), noise, maps)
    first = np.searchsorted(maps.run, np.arange(particles))
    greatest = np.maximum.reduceat(found.score, first)
    total = np.add.reduceat(np.exp(found.score - greatest[maps.run]), first)
    reached = np.cumsum(normalised(found.score, maps.run))
    chosen = np.searchsorted(reached, np.arange(particles) + rng.uniform(size=particles))
    last = np.append(first[1:], len(maps.run)) - 1
    chosen = np.clip(chosen, first, last)
    group = found.group[chosen]
    moved = (found.gains.gain[group] @ found.innovations[chosen][..., None])[..., 0]
    return Joint(joint.mean + moved, found.gains.covariance[group]), greatest + np.log(total)


def _by_topology(setup: Setup, method: Method, joint: Joint, seen: Floats) -> tuple[Joint, Floats]:
    """Update particles with the topology of a full scan; also return its log likelihood (particles,)."""
    variance_m2 = setup.infrastructure.variance_m2
    if method.kind == "associations":
        measured = topology_measurement(setup.motion, joint, seen[None], variance_m2)
        squared = np.nan_to_num(measured.innovation**2 / measured.variance, nan=0.0)
        return update_by_scalar(joint, measured), -0.5 * (squared + np.log(measured.variance))
    places = positions(setup.motion, joint.mean)
    added, variance = topology_moments(places, variance_m2)
    squared = (topology(seen) - added - topology(places)) ** 2 / variance
    return joint, -0.5 * (squared + np.log(variance))


def _estimate(method: Method, cloud: Cloud, run: int) -> tuple[Floats, Floats]:
    """Return the Gaussian of the best association, or the moments of the sampled states."""
    own = slice(run * method.particles, (run + 1) * method.particles)
    mean = cloud.joint.mean[own]
    weight = np.exp(cloud.log_weight[run])
    if method.kind == "associations":
        best = int(weight.argmax())
        return mean[best], cloud.joint.covariance[own][best]
    weight /= weight.sum()
    middle = weight @ mean
    apart = mean - middle
    return middle, (weight[:, None] * apart).T @ apart


VEHICLE_PARTICLES = recursive(
    "particle filters for unordered fixes; the method follows the name: vehicle-particles:set-1000",
    parameters=ParticlesParameters,
    find=_find,
    requirements="/vehicleN/prior, /network and, with topology, /infrastructure",
    start=_start,
    advance=_run,
    variant="method",
)
