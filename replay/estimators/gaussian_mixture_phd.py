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
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Schema, Topic, make_stream, schemas
from recorders.models.states import PLANE_MOTION, state_metadata
from recorders.parameters import Parameters
from replay.engine.blocks import Block, Ragged
from replay.engine.compile import compile_over_runs
from replay.engine.components import Components
from replay.engine.estimator import Bound, Estimator, Recursive
from replay.engine.measurements import PLANE, read_vectors
from replay.engine.priors import gaussians
from replay.engine.results import ALL_WELL, failures_of, state_stream
from replay.inference.gaussian import cholesky
from replay.inference.steps import FAILURES, NOT_POSITIVE_DEFINITE

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STATES = 4
X, Y = 0, 2
PLACE = (X, Y)
# A component is taken for a thing from this weight on.
EXTRACTED = 0.5
Probability = Annotated[float, Field(gt=0, le=1)]


class PhdParameters(Parameters):
    """The scene; None takes what the scans' channel states.

    `sensor` is the one to listen to, such as `network`; where it is empty all are, each on its own.
    Births are per m^2 and scan, clutter per m^2 and scan. Components within `merge_squared` of another
    by their own covariance become one. `gate_probability` is that of a detection of a component.
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
    """The parameters as the kernel has them, (1,) each; the gate is in squared sigmas."""

    variance: Floats
    detection: Floats
    clutter: Floats
    survival: Floats
    births: Floats
    birth_variance: Floats
    acceleration_variance: Floats
    gate: Floats
    prune_weight: Floats
    merge_squared: Floats


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

    is_told: NDArray[np.bool_]
    expected: Floats
    elements: Integers
    room: Integers
    weight: Floats
    mean: Floats
    covariance: Floats


class Work(NamedTuple):
    """Memory of one core: components before they are reduced, and what merging needs of them."""

    weight: Floats
    mean: Floats
    covariance: Floats
    factor: Floats
    is_merged: NDArray[np.bool_]
    heaviest: Integers
    gain: Floats
    solved: Floats


def predict(mean: Floats, covariance: Floats, duration_s: float, settings: Settings) -> None:
    """Constant velocity for a while, in place."""
    mean[0] += duration_s * mean[1]
    mean[2] += duration_s * mean[3]
    for column in range(STATES):
        covariance[0, column] += duration_s * covariance[1, column]
        covariance[2, column] += duration_s * covariance[3, column]
    for row in range(STATES):
        covariance[row, 0] += duration_s * covariance[row, 1]
        covariance[row, 2] += duration_s * covariance[row, 3]
    velocity = settings.acceleration_variance[0] * duration_s**2
    for axis in PLACE:
        covariance[axis, axis] += 0.25 * velocity * duration_s**2
        covariance[axis, axis + 1] += 0.5 * velocity * duration_s
        covariance[axis + 1, axis] += 0.5 * velocity * duration_s
        covariance[axis + 1, axis + 1] += velocity


def add_detected(
    run: int, parents: int, place: Floats, mixture: Mixture, settings: Settings, work: Work, end: int
) -> int:
    """Append what one detection makes of every component, and a birth; returns the new end.

    work.gain of a parent are its gain (4, 2), the posterior covariance (4, 4) and the innovation's
    inverse (3) and normaliser, from `prepare`.
    """
    first = end
    total = settings.clutter[0]
    for parent in range(parents):
        mean = mixture.mean[run, parent]
        dx, dy = place[0] - mean[X], place[1] - mean[Y]
        gain = work.gain[parent]
        squared = gain[24] * dx * dx + 2.0 * gain[25] * dx * dy + gain[26] * dy * dy
        if squared > settings.gate[0]:
            continue
        weight = mixture.weight[run, parent] * gain[27] * np.exp(-0.5 * squared)
        weight *= settings.detection[0] * settings.survival[0]
        total += weight
        work.weight[end] = weight
        for row in range(STATES):
            work.mean[end, row] = mean[row] + gain[2 * row] * dx + gain[2 * row + 1] * dy
            for column in range(STATES):
                work.covariance[end, row, column] = gain[8 + STATES * row + column]
        end += 1
    born = settings.detection[0] * settings.births[0]
    if born > 0.0:
        total += born
        work.weight[end] = born
        for row in range(STATES):
            work.mean[end, row] = 0.0
            for column in range(STATES):
                work.covariance[end, row, column] = 0.0
        for axis in range(2):
            work.mean[end, 2 * axis] = place[axis]
            work.covariance[end, 2 * axis, 2 * axis] = settings.variance[0]
            work.covariance[end, 2 * axis + 1, 2 * axis + 1] = settings.birth_variance[0]
        end += 1
    for component in range(first, end):
        work.weight[component] /= total
    return end


def prepare(mean: Floats, covariance: Floats, variance: float, gain: Floats) -> bool:
    """Fill what the update of a component needs and all detections share; see `add_detected`."""
    a = covariance[X, X] + variance
    b = covariance[X, Y]
    c = covariance[Y, Y] + variance
    determinant = a * c - b * b
    if not determinant > 0.0:
        return False
    gain[24], gain[25], gain[26] = c / determinant, -b / determinant, a / determinant
    gain[27] = 1.0 / (2.0 * np.pi * np.sqrt(determinant))
    for row in range(STATES):
        to_x, to_y = covariance[row, X], covariance[row, Y]
        gain[2 * row] = to_x * gain[24] + to_y * gain[25]
        gain[2 * row + 1] = to_x * gain[25] + to_y * gain[26]
    for row in range(STATES):
        for column in range(row + 1):
            value = (
                covariance[row, column]
                - gain[2 * row] * covariance[X, column]
                - gain[2 * row + 1] * covariance[Y, column]
            )
            gain[8 + STATES * row + column] = value
            gain[8 + STATES * column + row] = value
    return True


def update(run: int, scan: int, scans: Scans, mixture: Mixture, settings: Settings, work: Work) -> int:
    """Fill `work` with the components after a scan, pruned; returns how many, -1 for a failure."""
    parents, end = mixture.used[run], 0
    for parent in range(parents):
        mean, covariance = mixture.mean[run, parent], mixture.covariance[run, parent]
        if not prepare(mean, covariance, settings.variance[0], work.gain[parent]):
            return -1
        weight = mixture.weight[run, parent]
        work.weight[end] = weight * settings.survival[0] * (1.0 - settings.detection[0])
        for row in range(STATES):
            work.mean[end, row] = mean[row]
            for column in range(STATES):
                work.covariance[end, row, column] = covariance[row, column]
        end += 1
    for detection in range(scans.first[scan], scans.end[scan]):
        end = add_detected(run, parents, scans.place[detection], mixture, settings, work, end)
    kept = 0
    for component in range(end):
        if work.weight[component] > settings.prune_weight[0]:
            move(work, component, kept)
            kept += 1
    return kept


def move(work: Work, source: int, target: int) -> None:
    """Copy a component of `work` to another place."""
    work.weight[target] = work.weight[source]
    for row in range(STATES):
        work.mean[target, row] = work.mean[source, row]
        for column in range(STATES):
            work.covariance[target, row, column] = work.covariance[source, row, column]


def squared_distance(work: Work, member: int, other: int) -> float:
    """The Mahalanobis distance, squared, of two means by the member's covariance."""
    squared = 0.0
    for row in range(STATES):
        value = work.mean[member, row] - work.mean[other, row]
        for column in range(row):
            value -= work.factor[member, row, column] * work.solved[column]
        work.solved[row] = value / work.factor[member, row, row]
        squared += work.solved[row] ** 2
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
    shift, second = work.gain[work.gain.shape[0] - 1], work.factor[seed]
    for row in range(STATES):
        shift[row] = 0.0
        for column in range(STATES):
            second[row, column] = total * work.covariance[seed, row, column]
    for member in range(count):
        if work.is_merged[member]:
            continue
        if squared_distance(work, member, seed) > settings.merge_squared[0]:
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
        for row in range(STATES):
            mixture.mean[run, place, row] = work.mean[component, row]
            for column in range(STATES):
                mixture.covariance[run, place, row, column] = work.covariance[component, row, column]
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
            sets.weight[row] = weight
            for i in range(STATES):
                sets.mean[row, i] = mixture.mean[run, component, i]
                for j in range(STATES):
                    sets.covariance[row, i, j] = mixture.covariance[run, component, i, j]
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
            for component in range(mixture.used[run]):
                mean = mixture.mean[run, component]
                predict(mean, mixture.covariance[run, component], duration_s, settings)
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
        raise BadInput(f"{len(whole)} priors for {most} components; give --set most_components=...")
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
        gain=np.empty((most + 1, 28)),
        solved=np.empty(STATES),
    )


def _no_sets(scans: Scans, mixture: Mixture, settings: Settings) -> Sets:
    """Room for the elements: twice the weight that a scan can lead to at most."""
    count = len(scans.time_ns)
    bound = np.empty(count)
    passed = (1.0 - settings.detection[0]) * settings.survival[0]
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
    state: Mixture | None, block: Block, *, settings: Settings, most: int, outputs: "Outputs"
) -> tuple[Mixture, list[Ragged]]:
    """Filter a block; see `replay.engine.estimator.Recursive`."""
    scans = scans_of(*block.streams.values())
    before = no_components(len(scans.offsets) - 1, most) if state is None else state
    after, sets = filter_scans(before, scans, settings)
    return after, outputs.of(scans, sets, before, after)


def scans_of(scan: Ragged, detection: Ragged) -> Scans:
    """Put detections to their scans.

    Raises BadInput where a scan has another number of detections than it says, or positions are not in
    the plane.
    """
    topic = detection.stream.topic
    place = detection["position_m"]
    if len(detection) and place.shape[1] < 2:
        raise BadInput(f"topic {topic}: positions in the plane need two coordinates")
    keys, known = (
        (np.repeat(np.arange(each.runs), np.diff(each.offsets)) << 32) + each["scan_id"].astype(np.int64)
        for each in (detection, scan)
    )
    order = np.argsort(keys, kind="stable")
    first = np.searchsorted(keys[order], known)
    end = np.searchsorted(keys[order], known, side="right")
    stated = scan["detections"].astype(np.int64)
    wrong = np.flatnonzero(end - first != stated)
    if len(wrong) or len(keys) != stated.sum():
        row = wrong[0] if len(wrong) else 0
        said = (
            f"scan {scan['scan_id'][row]} says {stated[row]} detections, there are {(end - first)[row]}"
        )
        raise BadInput(
            f"topic {topic}: {said if len(wrong) else 'detections of scans that are not there'}; "
            "record every scan with its count"
        )
    ordered = read_vectors(detection.stream, "position_m", PLANE)[order]
    return Scans(scan.offsets, scan.stream.publish_time_ns, first, end, ordered)


class Outputs(NamedTuple):
    """The output topics of one bound filter."""

    name: str

    def of(self, scans: Scans, sets: Sets, before: Mixture, after: Mixture) -> list[Ragged]:
        """Per scan the set's size and the expected number, its elements, and the runs that failed."""
        told = np.flatnonzero(sets.is_told)
        offsets = np.searchsorted(told, scans.offsets)
        time_ns, elements = scans.time_ns[told], sets.elements[told]
        counts = np.concatenate([[0], np.cumsum(elements)])
        rows = np.repeat(sets.room[told] - counts[:-1], elements) + np.arange(counts[-1])
        expected = sets.expected[told]
        state, topic = state_metadata(PLANE_MOTION), f"/estimates/{self.name}"
        return [
            self._ragged("set", schemas.ESTIMATE_SIZE, offsets, time_ns, state, elements=elements),
            self._ragged(
                "element",
                schemas.DENSITY_ESTIMATE,
                counts[offsets],
                np.repeat(time_ns, elements),
                state,
                weight=sets.weight[rows],
                mean=sets.mean[rows],
                covariance=sets.covariance[rows].reshape(-1, STATES**2),
            ),
            # a PHD knows the number as a Poisson variable, whose variance is its mean
            Ragged(
                state_stream(
                    f"{topic}/cardinality",
                    time_ns,
                    {"things": "linear"},
                    None,
                    expected[:, None],
                    expected[:, None, None],
                ),
                offsets,
            ),
            failures_of(topic, before.failure, after.failure, after.time_ns, FAILURES),
        ]

    def _ragged(
        self,
        leaf: str,
        schema: Schema,
        offsets: Integers,
        time_ns: Integers,
        metadata: Mapping[str, str],
        **columns: NDArray[Any],
    ) -> Ragged:
        topic = f"/estimates/{self.name}/{leaf}"
        return Ragged(make_stream(topic, schema, time_ns, metadata=metadata, **columns), offsets)


def settings_of(parameters: PhdParameters, stated: Mapping[str, str], topic: str) -> Settings:
    """What the parameters say and, where they do not, the channel's metadata.

    Raises BadInput where neither does, or the channel states what cannot be.
    """

    def known(name: str) -> float:
        value = getattr(parameters, name)
        try:
            return float(stated[name] if value is None else value)
        except (KeyError, ValueError):
            raise BadInput(
                f"topic {topic} does not state {name}; give it with --set {name}=..."
            ) from None

    variance, detection = known("variance_m2"), known("detection_probability")
    clutter = known("clutter_per_m2")
    if not (0.0 < variance < np.inf and 0.0 < detection <= 1.0 and 0.0 <= clutter < np.inf):
        raise BadInput(
            f"topic {topic} states variance_m2 {variance:g}, detection_probability {detection:g} and "
            f"clutter_per_m2 {clutter:g}; the first two are positive, the others not negative"
        )
    single = (
        variance,
        detection,
        clutter,
        parameters.survival_probability,
        parameters.births_per_m2,
        parameters.birth_sigma_mps**2,
        parameters.acceleration_sigma_mps2**2,
        float(chi2.ppf(parameters.gate_probability, 2)),
        parameters.prune_weight,
        parameters.merge_squared,
    )
    return Settings(*(np.array([each], float) for each in single))


def _bind(name: str, topics: Mapping[str, Topic], parameters: PhdParameters) -> list[Bound]:
    """One filter for every sensor with scans and detections; priors of things start all of them."""

    def has(topic: str, schema: Schema) -> bool:
        return topic in topics and topics[topic].schema_name == schema.full_name

    components: Components = dict.fromkeys(PLANE_MOTION, "linear")
    priors = {
        topic: components
        for topic in topics
        if topic.endswith("/prior")
        and has(topic, schemas.GAUSSIAN_ESTIMATE)
        and components.keys() <= set(topics[topic].metadata.get("components", "").split(","))
    }
    bound: list[Bound] = []
    for topic in topics:
        sensor, _, leaf = topic.rpartition("/")
        detection = f"{sensor}/detection"
        if parameters.sensor and sensor.strip("/") != parameters.sensor.strip("/"):
            continue
        if leaf == "scan" and has(topic, schemas.SCAN) and has(detection, schemas.DETECTION):
            settings = settings_of(parameters, topics[topic].metadata, topic)
            outputs = Outputs(f"{name}{sensor}")
            most = parameters.most_components
            begin = partial(start, most=most)
            advance = partial(run, settings=settings, most=most, outputs=outputs)
            read = (topic, detection)
            bound.append(Recursive(outputs.name, read, tuple(priors), begin, advance, priors))
    return bound


GM_PHD = Estimator(
    "how many things there are and where, from unordered scans: Gaussian mixture PHD filter",
    "per sensor .../scan and .../detection",
    PhdParameters,
    _bind,
)
