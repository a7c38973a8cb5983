"""The Gaussian mixture PHD filter: how many things there are, and where, from unordered scans.

Source: Vo, Ma, "The Gaussian mixture probability hypothesis density filter", IEEE TSP 54(11), 2006,
table I (recursion), II (pruning, merging), III (extraction). Things appear anywhere alike, as in Beard,
Vo, Vo, Arulampalam, "A partially uniform target birth model for Gaussian mixture PHD/CPHD filtering",
IEEE TAES 49(4), 2013: a detection that nothing explains begins a component, and what is born undetected
is not kept. The state is (x, vx, y, vy); accelerations are white and constant between scans.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from recorders.errors import BadInput
from recorders.log import Topic, make_stream, schemas
from recorders.models.states import PLANE_MOTION, state_metadata
from recorders.models.vehicles import noise_moments
from recorders.parameters import Parameters
from replay.distributions import chi2
from replay.engine.arrays import Booleans, Floats, Integers, varying
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.replaying.estimator import Bound, Estimator, Recursive
from replay.engine.streams.blocks import Block, Ragged
from replay.engine.streams.channels import bindings, given_or_stated
from replay.engine.streams.measurements import PLANE, read_vectors
from replay.engine.streams.priors import gaussians
from replay.engine.streams.results import ALL_WELL, failures_of, state_stream
from replay.engine.vectors.components import Components
from replay.estimators.tracking.scans import by_scan
from replay.inference.kalman.steps import FAILURES, NOT_POSITIVE_DEFINITE
from replay.inference.linear_algebra.gaussian import (
    Innovation,
    cholesky,
    coast,
    copy_gaussian,
    kalman_step,
    no_innovation,
    reduce_covariance,
    whiten,
)

STATES = 4
PLACE = (0, 2)  # x and y; the velocity of each is next to it
# A component is taken for a thing from this weight on.
EXTRACTED = 0.5
Probability = Annotated[float, Field(gt=0, le=1)]


class PhdParameters(Parameters):
    """Motion, births and detections of targets; what is none is what the scans' channel states.

    Attributes:
        sensor: the sensor to use, such as `network`; without one each sensor has a filter of its own.
        variance_m2: variance of a detection, per axis.
        detection_probability: probability that a scan detects a target.
        clutter_per_m2: mean number of false detections in a scan, per area.
        survival_probability: probability that a target is still there at the next scan.
        births_per_m2: mean number of new targets in a scan, per area.
        birth_sigma_mps: standard deviation of a new target's velocity, per axis.
        acceleration_sigma_mps2: standard deviation of the acceleration between two scans, per axis.
        gate_probability: probability that the detection of a component is inside its gate.
        prune_weight: components of less weight are dropped.
        merge_squared: components whose squared Mahalanobis distance is below this become one.
        most_components: so many components are kept at most.
    """

    sensor: str = ""
    variance_m2: PositiveFloat | None = None
    detection_probability: Probability | None = None
    clutter_per_m2: NonNegativeFloat | None = None
    survival_probability: Probability = 0.99
    births_per_m2: NonNegativeFloat = 1e-7
    birth_sigma_mps: PositiveFloat = 2.0
    acceleration_sigma_mps2: NonNegativeFloat = 0.5
    gate_probability: Probability = 0.99999
    prune_weight: NonNegativeFloat = 1e-5
    merge_squared: PositiveFloat = 4.0
    most_components: PositiveInt = 100


class Settings(NamedTuple):
    """The parameters as the kernel has them; the gate is in squared sigmas."""

    variance_m2: float
    detection_probability: float
    clutter_per_m2: float
    survival_probability: float
    births_per_m2: float
    birth_sigma_mps: float
    acceleration_sigma_mps2: float
    prune_weight: float
    merge_squared: float
    gate: float


@varying(2)
class Mixture(NamedTuple):
    """What is carried: first axis run, second the components, of which `used` are taken.

    used, time_ns, failure: (runs,); time is below zero before the first scan. weight, mean, covariance:
    (runs, most), (runs, most, 4), (runs, most, 4, 4).
    """

    used: Integers
    time_ns: Integers
    failure: Integers
    weight: Floats
    mean: Floats
    covariance: Floats


class Scans(NamedTuple):
    """Scans of all runs in time order; scan s has the detections first[s]:end[s] of `place` (n, 2)."""

    offsets: Integers
    time_ns: Integers
    first: Integers
    end: Integers
    place: Floats


class Sets(NamedTuple):
    """What is said of every scan: the expected number of things, and the elements of the set.

    Scan s has room for elements from `room[s]` on, and has filled `elements[s]` of them.
    """

    is_told: Booleans
    expected: Floats
    elements: Integers
    room: Integers
    weight: Floats
    mean: Floats
    covariance: Floats


@varying(1, step=0, shift=0)
class Work(NamedTuple):
    """Memory of one core.

    Attributes:
        weight, mean, covariance: the components after a scan, before they are reduced.
        factor, is_merged, heaviest, step, shift: what merging needs of them.
        innovation: of any detection with a component.
        seen_factor, seen_gain, seen_covariance: of each component as if it were detected: the factor L
            of the innovation's covariance S (2, 2), W = C L^-T (4, 2), and the covariance afterwards.
    """

    weight: Floats
    mean: Floats
    covariance: Floats
    factor: Floats
    is_merged: Booleans
    heaviest: Integers
    step: Floats
    shift: Floats
    innovation: Innovation
    seen_factor: Floats
    seen_gain: Floats
    seen_covariance: Floats


def put(weight: float, mean: Floats, covariance: Floats, mixture: Any, row: int) -> None:
    """Write a component down in a row of anything that has these columns."""
    mixture.weight[row] = weight
    copy_gaussian(mean, covariance, mixture.mean[row], mixture.covariance[row])


def prepare(mean: Floats, covariance: Floats, variance: float, work: Work, parent: int) -> bool:
    """Fill what all detections share in the update of a component; False where S is singular."""
    factor, gain = work.seen_factor[parent], work.seen_gain[parent]
    for i in range(2):
        for j in range(2):
            factor[i, j] = covariance[PLACE[i], PLACE[j]]
        factor[i, i] += variance
        work.innovation.difference[i] = 0.0
        for row in range(STATES):
            gain[row, i] = covariance[row, PLACE[i]]
    innovation = Innovation(work.innovation.difference, factor, gain)
    if np.isnan(whiten(innovation, 2)[0]):
        return False
    kalman_step(innovation, 2, work.step)
    after = work.seen_covariance[parent]
    copy_gaussian(mean, covariance, work.step, after)
    reduce_covariance(after, gain, 2)
    return True


def add_detected(
    run: int, parents: int, place: Floats, mixture: Mixture, settings: Settings, work: Work, end: int
) -> int:
    """Append what one detection makes of every component, and a birth; returns the new end."""
    first = end
    total = settings.clutter_per_m2
    for parent in range(parents):
        mean, factor, gain = mixture.mean[run, parent], work.seen_factor[parent], work.seen_gain[parent]
        one = (place[0] - mean[PLACE[0]]) / factor[0, 0]
        other = (place[1] - mean[PLACE[1]] - factor[1, 0] * one) / factor[1, 1]
        squared = one * one + other * other
        if squared > settings.gate:
            continue
        density = np.exp(-0.5 * squared) / (2.0 * np.pi * factor[0, 0] * factor[1, 1])
        weight = mixture.weight[run, parent] * density
        weight *= settings.detection_probability * settings.survival_probability
        total += weight
        put(weight, mean, work.seen_covariance[parent], work, end)
        for row in range(STATES):
            work.mean[end, row] += gain[row, 0] * one + gain[row, 1] * other
        end += 1
    born = settings.detection_probability * settings.births_per_m2
    if born > 0.0:
        total += born
        work.weight[end] = born
        for row in range(STATES):
            work.mean[end, row] = 0.0
            for column in range(STATES):
                work.covariance[end, row, column] = 0.0
        for axis in range(2):
            at = PLACE[axis]
            work.mean[end, at] = place[axis]
            work.covariance[end, at, at] = settings.variance_m2
            work.covariance[end, at + 1, at + 1] = settings.birth_sigma_mps**2
        end += 1
    for component in range(first, end):
        work.weight[component] /= total
    return end


def update(run: int, scan: int, scans: Scans, mixture: Mixture, settings: Settings, work: Work) -> int:
    """Fill `work` with the components after a scan, pruned; returns how many, -1 for a failure."""
    parents = mixture.used[run]
    missed = settings.survival_probability * (1.0 - settings.detection_probability)
    for parent in range(parents):
        mean, covariance = mixture.mean[run, parent], mixture.covariance[run, parent]
        if not prepare(mean, covariance, settings.variance_m2, work, parent):
            return -1
        put(mixture.weight[run, parent] * missed, mean, covariance, work, parent)
    end = parents
    for detection in range(scans.first[scan], scans.end[scan]):
        end = add_detected(run, parents, scans.place[detection], mixture, settings, work, end)
    kept = 0
    for component in range(end):
        if work.weight[component] > settings.prune_weight:
            put(work.weight[component], work.mean[component], work.covariance[component], work, kept)
            kept += 1
    return kept


def squared_distance(work: Work, member: int, other: int) -> float:
    """The Mahalanobis distance, squared, of two means by the member's covariance."""
    squared = 0.0
    for row in range(STATES):
        value = work.mean[member, row] - work.mean[other, row]
        for column in range(row):
            value -= work.factor[member, row, column] * work.step[column]
        work.step[row] = value / work.factor[member, row, row]
        squared += work.step[row] ** 2
    return squared


def merge(count: int, settings: Settings, work: Work) -> int:
    """Merge what is close to the heaviest component, and so on with the rest; returns how many are left.

    The merged ones lie in the places of the heaviest of each group, which `heaviest` lists.
    Returns -1 where a covariance is not positive definite.
    """
    for component in range(count):
        work.is_merged[component] = False
        if not cholesky(work.factor[component], work.covariance[component], STATES):
            return -1
    groups = 0
    while True:
        seed = -1
        for component in range(count):
            if not work.is_merged[component] and (
                seed < 0 or work.weight[component] > work.weight[seed]
            ):
                seed = component
        if seed < 0:
            return groups
        merge_group(seed, count, settings, work)
        work.heaviest[groups] = seed
        groups += 1


def merge_group(seed: int, count: int, settings: Settings, work: Work) -> None:
    """Replace a component by the one Gaussian with the moments of all that are close to it.

    Moments are taken about the seed's mean, which stays where it is until all are found.
    """
    work.is_merged[seed] = True
    total = work.weight[seed]
    shift, second = work.shift, work.factor[seed]
    for row in range(STATES):
        shift[row] = 0.0
        for column in range(STATES):
            second[row, column] = total * work.covariance[seed, row, column]
    for member in range(count):
        if work.is_merged[member]:
            continue
        if squared_distance(work, member, seed) > settings.merge_squared:
            continue
        work.is_merged[member] = True
        weight = work.weight[member]
        total += weight
        for row in range(STATES):
            difference = work.mean[member, row] - work.mean[seed, row]
            shift[row] += weight * difference
            for column in range(STATES):
                other = work.mean[member, column] - work.mean[seed, column]
                second[row, column] += weight * (
                    work.covariance[member, row, column] + difference * other
                )
    work.weight[seed] = total
    for row in range(STATES):
        work.mean[seed, row] += shift[row] / total
        for column in range(STATES):
            moved = shift[row] / total * shift[column] / total
            work.covariance[seed, row, column] = second[row, column] / total - moved


def keep(run: int, groups: int, mixture: Mixture, work: Work) -> None:
    """Carry on the heaviest of the merged components, in order of their weights."""
    kept = min(groups, mixture.weight.shape[1])
    for place in range(kept):
        best = place
        for other in range(place + 1, groups):
            if work.weight[work.heaviest[other]] > work.weight[work.heaviest[best]]:
                best = other
        component = work.heaviest[best]
        work.heaviest[best] = work.heaviest[place]
        work.heaviest[place] = component
        mixture.weight[run, place] = work.weight[component]
        mean, covariance = mixture.mean[run, place], mixture.covariance[run, place]
        copy_gaussian(work.mean[component], work.covariance[component], mean, covariance)
    mixture.used[run] = kept


def extract(run: int, scan: int, mixture: Mixture, sets: Sets) -> None:
    """Tell a scan's set: a component stands for as many things as its weight rounds to."""
    row = sets.room[scan]
    for component in range(mixture.used[run]):
        weight = mixture.weight[run, component]
        sets.expected[scan] += weight
        if weight <= EXTRACTED:
            continue
        for _ in range(max(1, int(np.floor(weight + 0.5)))):
            if row == sets.room[scan + 1]:
                break
            mean, covariance = mixture.mean[run, component], mixture.covariance[run, component]
            put(weight, mean, covariance, sets, row)
            row += 1
    sets.elements[scan] = row - sets.room[scan]
    sets.is_told[scan] = True


def follow(run: int, scans: Scans, mixture: Mixture, settings: Settings, sets: Sets, work: Work) -> None:
    """Take one run through its scans, until they end or it fails."""
    for scan in range(scans.offsets[run], scans.offsets[run + 1]):
        if mixture.failure[run] != ALL_WELL:
            break
        if mixture.time_ns[run] >= 0:
            duration_s = (scans.time_ns[scan] - mixture.time_ns[run]) * 1e-9
            if duration_s < 0.0:
                continue
            noise = noise_moments(settings.acceleration_sigma_mps2, duration_s)
            for component in range(mixture.used[run]):
                mean, covariance = mixture.mean[run, component], mixture.covariance[run, component]
                coast(mean, covariance, duration_s, (2, 1), noise)
        mixture.time_ns[run] = scans.time_ns[scan]
        count = update(run, scan, scans, mixture, settings, work)
        groups = merge(count, settings, work) if count >= 0 else -1
        if groups < 0:
            mixture.failure[run] = NOT_POSITIVE_DEFINITE
            break
        keep(run, groups, mixture, work)
        extract(run, scan, mixture, sets)


@lru_cache(maxsize=1)
def _compiled() -> Callable[..., None]:
    return compile_over_runs(follow, allocates=False)


def start(whole: Mapping[str, Ragged], *, most: int) -> Mixture | None:
    """A component of weight 1 at each prior; None where there is none: then nothing is known yet.

    Raises BadInput where there is no room for all.
    """
    if not whole:
        return None
    runs = next(iter(whole.values())).runs
    if len(whole) > most:
        raise BadInput(
            f"{len(whole)} priors are more than {most} components; give --set most_components=..."
        )
    mixture = no_components(runs, most)
    for component, prior in enumerate(whole.values()):
        time_ns, mean, covariance = gaussians(prior)
        mixture.weight[:, component] = 1.0
        mixture.mean[:, component] = mean
        mixture.covariance[:, component] = covariance
        mixture.time_ns[:] = time_ns
    mixture.used[:] = len(whole)
    return mixture


def no_components(runs: int, most: int) -> Mixture:
    """Mixtures without components."""
    return Mixture(
        used=np.zeros(runs, np.int64),
        time_ns=np.full(runs, -1),
        failure=np.full(runs, ALL_WELL),
        weight=np.zeros((runs, most)),
        mean=np.zeros((runs, most, STATES)),
        covariance=np.zeros((runs, most, STATES, STATES)),
    )


def filter_scans(before: Mixture, scans: Scans, settings: Settings) -> tuple[Mixture, Sets]:
    """The mixtures after the scans, and the sets that each scan leads to."""
    columns: Any = before
    mixture = Mixture(*(column.copy() for column in columns))
    runs, most = mixture.weight.shape
    sets = _no_sets(scans, mixture, settings)
    largest = int((scans.end - scans.first).max(initial=0))
    _compiled()(runs, scans, mixture, settings, sets, scratch=partial(_work, most, largest))
    return mixture, sets


def _work(most: int, detections: int) -> Work:
    rows = most * (1 + detections) + detections
    return Work(
        weight=np.empty(rows),
        mean=np.empty((rows, STATES)),
        covariance=np.empty((rows, STATES, STATES)),
        factor=np.empty((rows, STATES, STATES)),
        is_merged=np.empty(rows, bool),
        heaviest=np.empty(rows, np.int64),
        step=np.empty(STATES),
        shift=np.empty(STATES),
        innovation=no_innovation(STATES, 2),
        seen_factor=np.empty((most, 2, 2)),
        seen_gain=np.empty((most, STATES, 2)),
        seen_covariance=np.empty((most, STATES, STATES)),
    )


def _no_sets(scans: Scans, mixture: Mixture, settings: Settings) -> Sets:
    """Room for the elements: twice the weight that a scan can lead to at most."""
    count = len(scans.time_ns)
    bound = np.empty(count)
    passed = (1.0 - settings.detection_probability) * settings.survival_probability
    for run in range(len(mixture.used)):
        weight = float(mixture.weight[run, : mixture.used[run]].sum())
        for scan in range(scans.offsets[run], scans.offsets[run + 1]):
            weight = passed * weight + float(scans.end[scan] - scans.first[scan])
            bound[scan] = 2.0 * weight
    room = np.concatenate([[0], np.cumsum(np.ceil(bound).astype(np.int64))])
    return Sets(
        np.zeros(count, bool),
        np.zeros(count),
        np.zeros(count, np.int64),
        room,
        np.empty(room[-1]),
        np.empty((room[-1], STATES)),
        np.empty((room[-1], STATES, STATES)),
    )


def run(
    state: Mixture | None, block: Block, *, name: str, settings: Settings, most: int
) -> tuple[Mixture, list[Ragged]]:
    """Filter a block; see `replay.engine.replaying.estimator.Recursive`."""
    scans = scans_of(*block.streams.values())
    before = no_components(len(scans.offsets) - 1, most) if state is None else state
    after, sets = filter_scans(before, scans, settings)
    return after, _outputs(f"/estimates/{name}", scans, sets, before, after)


def scans_of(scan: Ragged, detection: Ragged) -> Scans:
    """Put detections to their scans.

    Raises BadInput as `by_scan` does, and where positions are not in the plane.
    """
    if len(detection) and detection["position_m"].shape[1] < 2:
        raise BadInput(f"topic {detection.stream.topic}: positions in the plane need two coordinates")
    order, (first, end) = by_scan(scan, detection)
    ordered = read_vectors(detection.stream, "position_m", PLANE)[order]
    return Scans(scan.offsets, scan.stream.publish_time_ns, first, end, ordered)


def _outputs(topic: str, scans: Scans, sets: Sets, before: Mixture, after: Mixture) -> list[Ragged]:
    """Per scan the set's size and the expected number, its elements, and the runs that failed."""
    told = np.flatnonzero(sets.is_told)
    offsets = np.searchsorted(told, scans.offsets)
    time_ns, elements, expected = scans.time_ns[told], sets.elements[told], sets.expected[told]
    ends = np.concatenate([[0], np.cumsum(elements)])
    rows = np.repeat(sets.room[told] - ends[:-1], elements) + np.arange(ends[-1])
    state = state_metadata(PLANE_MOTION)
    size = make_stream(f"{topic}/set", schemas.ESTIMATE_SIZE, time_ns, metadata=state, elements=elements)
    element = make_stream(
        f"{topic}/element",
        schemas.DENSITY_ESTIMATE,
        np.repeat(time_ns, elements),
        metadata=state,
        weight=sets.weight[rows],
        mean=sets.mean[rows],
        covariance=sets.covariance[rows].reshape(-1, STATES**2),
    )
    # a PHD knows the number as a Poisson variable, whose variance is its mean
    number, spread = expected[:, None], expected[:, None, None]
    things: Components = {"things": "linear"}
    cardinality = state_stream(f"{topic}/cardinality", time_ns, things, None, number, spread)
    return [
        Ragged(size, offsets),
        Ragged(element, ends[offsets]),
        Ragged(cardinality, offsets),
        failures_of(topic, before.failure, after.failure, after.time_ns, FAILURES),
    ]


def settings_of(parameters: PhdParameters, scan: Topic) -> Settings:
    """What the parameters say and, where they do not, the scan's channel: see `given_or_stated`."""
    names = Settings._fields[:-1]
    numbers = [given_or_stated(parameters, [scan], name) for name in names]
    return Settings._make([*numbers, float(chi2.ppf(parameters.gate_probability, 2))])


def _bind(name: str, topics: Mapping[str, Topic], parameters: PhdParameters) -> list[Bound]:
    """One filter for every sensor with scans and detections; priors of things start all of them."""
    components: Components = dict.fromkeys(PLANE_MOTION, "linear")
    priors = {
        found["prior"].name: components
        for _, found in bindings(topics, {"prior": schemas.GAUSSIAN_ESTIMATE})
        if components.keys() <= set(found["prior"].metadata.get("components", "").split(","))
    }
    bound: list[Bound] = []
    for sensor, found in bindings(topics, {"scan": schemas.SCAN, "detection": schemas.DETECTION}):
        if parameters.sensor and sensor.strip("/") != parameters.sensor.strip("/"):
            continue
        own, most = f"{name}{sensor}", parameters.most_components
        settings = settings_of(parameters, found["scan"])
        advance = partial(run, name=own, settings=settings, most=most)
        read = (found["scan"].name, found["detection"].name)
        bound.append(Recursive(own, read, tuple(priors), partial(start, most=most), advance, priors))
    return bound


GM_PHD = Estimator(
    "number and positions of targets from unordered scans: Gaussian mixture PHD filter",
    "per sensor .../scan and .../detection",
    PhdParameters,
    _bind,
)
