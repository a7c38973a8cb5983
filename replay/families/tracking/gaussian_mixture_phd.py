"""Gaussian mixture PHD filter: estimates the number and positions of targets from unordered scans.

Source: Vo, Ma, "The Gaussian mixture probability hypothesis density filter", IEEE TSP 54(11), 2006,
table I (recursion), II (pruning, merging), III (extraction). Targets are equally likely to appear
anywhere, as in Beard, Vo, Vo, Arulampalam, "A partially uniform target birth model for Gaussian
mixture PHD/CPHD filtering", IEEE TAES 49(4), 2013: every detection also begins a component, and births
that are not detected are dropped. The state is (x, vx, y, vy); accelerations are white and constant
between scans.
"""

import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, make_stream, schemas
from fuselog.recorders.log.planes import frame_of, in_frame
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine import chi2
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.streams.blocks import Block, Ragged
from fuselog.replay.engine.streams.channels import bindings, given_or_stated
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.engine.streams.results import ALL_WELL, failures_of, state_stream
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.tracking.phd_recursion import (
    STATES,
    Mixture,
    PhdInputs,
    PhdMemory,
    PhdSettings,
    Scans,
    Sets,
    extract,
    process,
)
from fuselog.replay.families.tracking.scans import by_scan
from fuselog.replay.inference.kalman.steps import FAILURES
from fuselog.replay.inference.linear_algebra.gaussian import no_innovation
from fuselog.replay.inference.run.loops import over_events

Probability = Annotated[float, Field(gt=0, le=1)]


class PhdParameters(Parameters):
    """Motion, births and detections of targets; missing values are read from the scans' channel.

    Attributes:
        sensor: the sensor to use, such as `network`; by default each sensor has its own filter.
        sigma_m: standard deviation of a detection, per axis.
        variance_m2: variance of a detection; an older alternative to `sigma_m`, to be removed in the
            next release.
        detection_probability: probability that a scan detects a target.
        clutter_per_m2: mean number of false detections in a scan, per area.
        survival_probability: probability that a target is still present at the next scan.
        births_per_m2: mean number of new targets in a scan, per area.
        birth_sigma_mps: standard deviation of a new target's velocity, per axis.
        acceleration_sigma_mps2: standard deviation of the acceleration between two scans, per axis.
        gate_probability: probability that the detection of a component is inside its gate.
        prune_weight: components with at most this weight are dropped.
        merge_squared: components are merged if their squared Mahalanobis distance is at most this value.
        most_components: greatest number of components that are kept.
    """

    sensor: str = ""
    sigma_m: PositiveFloat | None = None
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


_filter = compile_over_runs(over_events(process, extract), title="a PHD filter")


Filtering = Given[PhdParameters]


def start(given: Filtering) -> tuple[Filtering, Mixture]:
    """Return the initial mixtures, with a component of weight 1 at each prior.

    Raises BadInput if there are more priors than components.
    """
    most = given.parameters.most_components
    if len(given) > most:
        raise BadInput(
            f"{len(given)} priors exceed the limit of {most} components; raise --set most_components=..."
        )
    mixture = no_components(given.runs, most)
    for component, prior in enumerate(given):
        time_ns, mean, covariance = given.prior(prior)
        mixture.weight[:, component] = 1.0
        mixture.mean[:, component] = mean
        mixture.covariance[:, component] = covariance
        mixture.time_ns[:] = time_ns
    mixture.used[:] = len(given)
    return given, mixture


def no_components(runs: int, most: int) -> Mixture:
    """Make empty mixtures for a number of runs."""
    return Mixture(
        used=np.zeros(runs, np.int64),
        time_ns=np.full(runs, -1),
        failure=np.full(runs, ALL_WELL),
        weight=np.zeros((runs, most)),
        mean=np.zeros((runs, most, STATES)),
        covariance=np.zeros((runs, most, STATES, STATES)),
    )


def filter_scans(before: Mixture, scans: Scans, settings: PhdSettings) -> tuple[Mixture, Sets]:
    """Filter the scans; return the mixtures after them, and a set for each scan."""
    columns: Any = before
    mixture = Mixture(*(column.copy() for column in columns))
    runs, most = mixture.weight.shape
    sets = _no_sets(scans, mixture, settings)
    largest = int((scans.end - scans.first).max(initial=0))
    inputs = PhdInputs(scans, settings)
    _filter(runs, inputs, mixture, sets, scratch=partial(_work, most, largest))
    return mixture, sets


def _work(most: int, detections: int) -> PhdMemory:
    rows = most * (1 + detections) + detections
    return PhdMemory(
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


def _no_sets(scans: Scans, mixture: Mixture, settings: PhdSettings) -> Sets:
    """Make empty sets, with room after each scan for twice the greatest possible total weight."""
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


def advance(given: Filtering, before: Mixture, block: Block) -> tuple[Mixture, list[Ragged]]:
    """Filter a block; see `fuselog.replay.engine.api.functions.recursive`."""
    scans = scans_of(*block.streams.values())
    after, sets = filter_scans(before, scans, given.setup)
    frame = frame_of(given.topics["detection"].metadata)
    return after, _outputs(f"/estimates/{given.name}", frame, scans, sets, before, after)


def scans_of(scan: Ragged, detection: Ragged) -> Scans:
    """Combine scans with their detections.

    Raises BadInput as `by_scan` does, and if positions have fewer than two coordinates.
    """
    if len(detection) and detection["position_m"].shape[1] < 2:
        raise BadInput(f"topic {detection.stream.topic}: positions must have at least two coordinates")
    order, (first, end) = by_scan(scan, detection)
    ordered = read_vectors(detection.stream, "position_m", PLANE)[order]
    return Scans(scan.offsets, scan.stream.publish_time_ns, first, end, ordered)


def _outputs(
    topic: str, frame: str, scans: Scans, sets: Sets, before: Mixture, after: Mixture
) -> list[Ragged]:
    """Make the streams of set sizes, elements, expected numbers of targets, and failed runs."""
    reported = np.flatnonzero(sets.is_reported)
    offsets = np.searchsorted(reported, scans.offsets)
    time_ns, elements, expected = (
        scans.time_ns[reported],
        sets.elements[reported],
        sets.expected[reported],
    )
    ends = np.concatenate([[0], np.cumsum(elements)])
    rows = np.repeat(sets.room[reported] - ends[:-1], elements) + np.arange(ends[-1])
    state = {**state_metadata(PLANE_MOTION), **in_frame(frame)}
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
    # in a PHD filter, the number of targets is Poisson, so its variance equals its mean
    number, spread = expected[:, None], expected[:, None, None]
    things: Components = {"things": "linear"}
    cardinality = state_stream(f"{topic}/cardinality", time_ns, things, None, number, spread)
    return [
        Ragged(size, offsets),
        Ragged(element, ends[offsets]),
        Ragged(cardinality, offsets),
        failures_of(topic, before.failure, after.failure, after.time_ns, FAILURES),
    ]


def settings_of(parameters: PhdParameters, scan: Topic) -> PhdSettings:
    """Read the settings from the parameters, or from the scans' channel: see `given_or_stated`."""
    if parameters.variance_m2 is not None:
        notice = "'variance_m2' will be removed in the next release; use 'sigma_m', its square root"
        warnings.warn(f"gm-phd: {notice}", FutureWarning, stacklevel=2)
    elif parameters.sigma_m is not None:
        parameters = parameters.model_copy(update={"variance_m2": parameters.sigma_m**2})
    names = PhdSettings._fields[:-1]
    numbers = [given_or_stated(parameters, [scan], name) for name in names]
    return PhdSettings._make([*numbers, float(chi2.ppf(parameters.gate_probability, 2))])


def _find(_: str, topics: Mapping[str, Topic], parameters: PhdParameters) -> Iterator[Binding]:
    """Bind a filter to every sensor with scans and detections; use the priors in the sensor's frame."""
    components: Components = dict.fromkeys(PLANE_MOTION, "linear")
    priors = {
        found["prior"].name: found["prior"]
        for _, found in bindings(topics, {"prior": schemas.GAUSSIAN_ESTIMATE})
        if components.keys() <= set(found["prior"].metadata.get("components", "").split(","))
    }
    for sensor, found in bindings(topics, {"scan": schemas.SCAN, "detection": schemas.DETECTION}):
        if not parameters.sensor or sensor.strip("/") == parameters.sensor.strip("/"):
            frame = frame_of(found["detection"].metadata)
            own = {name: each for name, each in priors.items() if frame_of(each.metadata) == frame}
            settings = settings_of(parameters, found["scan"])
            yield Binding(found, own, sensor, dict.fromkeys(own, components), settings)


GM_PHD = recursive(
    "number and positions of targets from unordered scans: Gaussian mixture PHD filter",
    parameters=PhdParameters,
    find=_find,
    requirements="per sensor .../scan and .../detection",
    start=start,
    advance=advance,
)
