"""Tracks vessels and other targets from the unordered scans of several sensors at once.

    tracker:nearest     the surest pair of track and detection first
    tracker:hungarian   the best map of tracks to detections (global nearest neighbour)
    tracker:jpda        all maps, weighted
    tracker:jipda       all maps, weighted, and how probable it is that each track exists
    tracker:pmbm        the same, where any detection may be the first one of a target: the Poisson
                        multi-Bernoulli mixture, of which after each scan the marginals are kept, the
                        tracks' existence and states (TOMB/P of Williams, IEEE TAES 51(3), 2015). Targets
                        that were never detected are a uniform Poisson process of steady density

Targets keep their velocity but for white acceleration, or move as any registered model with a position
says; where it has several modes, each track is an interacting multiple model. Sensors are those that
state what they are like on the channels of their scans, see
`fuselog.replay.families.tracking.scan_sensors`. Places begin tracks, bearings only sharpen those that
are confirmed. `fuselog.replay.families.tracking.association.tracking` does the work.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.log.planes import frame_in_words, frame_of
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine import chi2
from fuselog.replay.engine.api.functions import Advance, recursive
from fuselog.replay.engine.api.inputs import Binding
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.channels import stated
from fuselog.replay.engine.streams.detections import ORIGIN
from fuselog.replay.families.tracking.association.scanning import measuring
from fuselog.replay.families.tracking.association.tracker import Tracker
from fuselog.replay.families.tracking.scan_sensors import FOREIGN, KINDS, SEEN, UNSTATED
from fuselog.replay.families.tracking.scans import SensorTopics
from fuselog.replay.families.tracking.sensor_errors import Errors, errors_of, with_errors
from fuselog.replay.families.tracking.targets import Targets, targets_of
from fuselog.replay.families.tracking.track_smoother import check_smoothing
from fuselog.replay.families.tracking.tracker_run import (
    TrackerSetup,
    advance,
    advance_out_of_sequence,
    finish,
    start,
)
from fuselog.replay.inference.model.parameters import number_fields
from fuselog.replay.inference.model.stage import stage_of

# What sets apart the two that go by existence and have the associations of jpda.
EXISTING: dict[str, dict[str, float]] = {
    "jipda": {},
    "pmbm": {
        "undetected_per_m2": 1e-6,
        "confirming_existence": 0.5,
        "keeping_existence": 0.5,
        "ending_existence": 0.001,
    },
}
Probability = Annotated[float, Field(gt=0, lt=1)]


class TrackerParameters(Parameters):
    """States how targets move, how tracks begin and end, and what sensors are like.

    What is none is what the channel of a sensor's scans states; a value given here holds for all
    sensors.

    A track begins with a detection outside all gates that is far enough from all confirmed tracks; with
    `undetected_per_m2`, with any detection that may be a target that was never detected, by how
    probable that is. `management` decides which tracks are confirmed: "existence" by the probability
    that the target exists, "hits" by counting detections, "score" by the log-likelihood ratio of target
    and clutter.

    A registration error is constant in all that a sensor measures, and all tracks estimate it together;
    a correlated error is another one for every track, and lasts for a while. Both are components of the
    tracks' states.

    Attributes:
        association: which detection is which target's: the nearest, the best of all maps (hungarian), or
            all maps by their probabilities (jpda, jipda, pmbm).
        management: how tracks are confirmed and ended; without one jipda and pmbm use existence, the
            others hits.
        sensors: the sensors to use, such as ["radar", "lidar"]; without any, all.
        model: a registered model with a position, by which targets move; without one they keep their
            velocity.
        mode: the mode of such a model to use; without one all of them.
        motion: parameters of such a model, by name.
        acceleration_density: power spectral density of the acceleration of targets without a model, in
            m^2/s^3.
        birth_sigma_mps: standard deviation of a new track's velocity, per axis.
        birth_distance_m: a track begins so far from all confirmed tracks.
        birth_existence: existence of a new track; with hits or score, of a track until it is confirmed.
        undetected_per_m2: density of targets that were never detected.
        confirming_existence: with management by existence, a track is confirmed from this existence on.
        keeping_existence: a track is no longer confirmed below this existence.
        ending_existence: a track ends below this existence.
        survival_s: mean time for which a target is there.
        hits_needed: with management by hits, so many detections in its first `chances` scans confirm a
            track.
        chances: with management by hits, a track without `hits_needed` detections in its first so many
            scans ends.
        false_confirmation: with management by score, probability that clutter is confirmed as a track.
        missed_confirmation: with management by score, probability that a target's track is not
            confirmed.
        silence_s: a confirmed track ends after so long without a detection.
        tentative_silence_s: a track that is not confirmed ends after so long without a detection.
        same_within_m: tracks whose positions are nearer than this are one, if their velocities are near
            too.
        same_within_mps: tracks whose velocities are nearer than this are one, if their positions are
            near too.
        most_tracks: room for so many tracks at a time.
        smoothed: whether tracks are estimated again at the end of the run from all their detections.
        gate_probability: probability that a target's detection is inside its gate.
        sigma_m: standard deviation of a position along the line of sight, or of a range.
        sigma_across_rad: standard deviation of a position across the line of sight, per m of range, that
            is added there.
        lag_s: detections are where a target was so long ago.
        bias_x_m: places are too far along x by so much.
        bias_y_m: places are too far along y by so much.
        bias_range_m: ranges are too long by so much.
        near_range_m: up to this range a target is near; beyond it detection and clutter change linearly.
        far_range_m: from this range on detection and clutter change no further.
        far_detection_probability: probability that a target is detected from `far_range_m` on.
        clutter_per_m2: mean number of false detections in a scan, per area, near the sensor.
        far_clutter_factor: what clutter is multiplied by far from the sensor.
        sector_from_rad: where a sector begins in which a sensor detects more or less, anticlockwise from
            the x axis.
        sector_to_rad: where this sector ends, anticlockwise from the x axis.
        sector_detection_factor: what the probability of a detection is multiplied by in the sector.
        sector_clutter_factor: what clutter is multiplied by in the sector.
        joined_within_m: detections within this of each other count as one target.
        sigma_rad: standard deviation of a bearing.
        sigma_across_m: standard deviation of a bearing across the line of sight, in m, that is added
            there.
        bias_rad: bearings are too large by so much.
        clutter_per_rad: mean number of false detections in a scan, per angle.
        detection_probability: probability that a near target is detected.
        blind_from_rad: where the sector begins in which a sensor detects nothing, anticlockwise from the
            x axis.
        blind_to_rad: where that sector ends, anticlockwise from the x axis.
        interval_s: a track uses one detection of a sensor in this time.
        registration_sigma_m: standard deviation of a registration error of places or ranges; 0 is none.
        registration_sigma_rad: standard deviation of a registration error of bearings; 0 is none.
        correlated_sigma_m: standard deviation of a correlated error of places or ranges; 0 is none.
        correlated_sigma_rad: standard deviation of a correlated error of bearings; 0 is none.
        correlation_s: for about how long a correlated error lasts.
    """

    association: Literal["nearest", "hungarian", "jpda", "jipda", "pmbm"] = "jipda"
    management: Literal["existence", "hits", "score"] | None = None
    sensors: tuple[str, ...] = ()
    model: str | None = None
    mode: str | None = None
    motion: dict[str, float] = {}
    acceleration_density: PositiveFloat = 0.1
    birth_sigma_mps: PositiveFloat = 3.0
    birth_distance_m: NonNegativeFloat = 30.0
    birth_existence: Probability | None = None
    undetected_per_m2: NonNegativeFloat = 0.0
    confirming_existence: Probability = 0.97
    keeping_existence: Annotated[float, Field(ge=0, lt=1)] = 0.0
    ending_existence: Probability = 0.02
    survival_s: PositiveFloat = 60.0
    hits_needed: PositiveInt = 4
    chances: PositiveInt = 6
    false_confirmation: Probability = 1e-5
    missed_confirmation: Probability = 1e-4
    silence_s: PositiveFloat = 10.0
    tentative_silence_s: PositiveFloat = 6.0
    same_within_m: NonNegativeFloat = 10.0
    same_within_mps: NonNegativeFloat = 2.0
    most_tracks: PositiveInt = 100
    smoothed: bool = False

    gate_probability: Probability | None = None
    sigma_m: PositiveFloat | None = None
    sigma_across_rad: NonNegativeFloat | None = None
    lag_s: float | None = None
    bias_x_m: float | None = None
    bias_y_m: float | None = None
    bias_range_m: float | None = None
    near_range_m: NonNegativeFloat | None = None
    far_range_m: NonNegativeFloat | None = None
    far_detection_probability: Probability | None = None
    clutter_per_m2: PositiveFloat | None = None
    far_clutter_factor: PositiveFloat | None = None
    sector_from_rad: float | None = None
    sector_to_rad: float | None = None
    sector_detection_factor: Probability | None = None
    sector_clutter_factor: PositiveFloat | None = None
    joined_within_m: NonNegativeFloat | None = None
    sigma_rad: PositiveFloat | None = None
    sigma_across_m: NonNegativeFloat | None = None
    bias_rad: float | None = None
    clutter_per_rad: PositiveFloat | None = None
    detection_probability: Probability | None = None
    blind_from_rad: float | None = None
    blind_to_rad: float | None = None
    interval_s: NonNegativeFloat | None = None
    registration_sigma_m: NonNegativeFloat | None = None
    registration_sigma_rad: NonNegativeFloat | None = None
    correlated_sigma_m: NonNegativeFloat | None = None
    correlated_sigma_rad: NonNegativeFloat | None = None
    correlation_s: PositiveFloat | None = None

    @model_validator(mode="before")
    @classmethod
    def _managed(cls, values: Any) -> Any:
        """Fill in what an association says of existence: jipda and pmbm are about it, others count."""
        association = values.get("association", "jipda")
        goes_by_existence = association in EXISTING
        given = values.get("management")
        if goes_by_existence and given not in (None, "existence"):
            raise ValueError(
                f"{association} needs management = existence; management = {given} is for jpda"
            )
        management = given or ("existence" if goes_by_existence else "hits")
        if values.get("undetected_per_m2") and management != "existence":
            raise ValueError("undetected_per_m2 needs management = existence")
        likely = {"birth_existence": 0.05 if management == "existence" else 0.135}
        return {**likely, **EXISTING.get(association, {}), **values, "management": management}


# Sensors


def find_sensors(topics: Mapping[str, Topic], wanted: Sequence[str]) -> SensorTopics:
    """Return the sensors with scans and places, bearings, or both range and bearing.

    Raises BadInput where one that is wanted is not there, its own position is not, none sees places, or
    they are in several frames.
    """
    rows = []
    _check_scans(topics, wanted)
    for scan in topics.values():
        prefix, _, leaf = scan.name.rpartition("/")
        if leaf != "scan" or scan.schema_name != schemas.SCAN.full_name:
            continue
        if wanted and prefix.strip("/") not in wanted:
            continue
        for number, kind in enumerate(KINDS):
            seen = topics.get(f"{prefix}/{kind.leaf}")
            if seen is not None and seen.schema_name == kind.schema.full_name:
                origin = scan.metadata.get(ORIGIN, "")
                # a sensor whose own position is known measures along the axes that this is given in
                frame = frame_of(topics.get(origin, seen).metadata)
                rows.append((number, scan.name, seen.name, origin, frame))
    missing = set(wanted) - {row[1].rpartition("/")[0].strip("/") for row in rows}
    if missing:
        raise BadInput(f"no scans of sensor {min(missing)}; leave it out of sensors")
    found = SensorTopics(*zip(*rows, strict=True)) if rows else SensorTopics((), (), (), (), ())
    for scan_name, origin in zip(found.scans, found.origins, strict=True):
        if origin and (
            origin not in topics or topics[origin].schema_name != schemas.POSITION_FIX.full_name
        ):
            raise BadInput(
                f"topic {scan_name}: its sensor's position is that of {origin} (fuselog.PositionFix), "
                "which is "
                "missing; record the position of the sensor"
            )
    for seen_name, frame in zip(found.detections, found.frames, strict=True):
        if frame != found.frames[0]:
            raise BadInput(
                f"topic {seen_name} is in {frame_in_words(frame)}, {found.detections[0]} in "
                f"{frame_in_words(found.frames[0])}, and tracks are in one frame; name the sensors "
                "of one frame with --set sensors=..."
            )
    if rows and all(KINDS[kind].birth is None for kind in found.kinds):
        raise BadInput(
            "bearings alone begin no tracks, since they do not measure how far a target is; add a "
            "sensor of positions, or of ranges with bearings"
        )
    return found


def _check_scans(topics: Mapping[str, Topic], wanted: Sequence[str]) -> None:
    """Raise BadInput where detections are of scans that nobody recorded."""
    for seen in topics.values():
        prefix, _, leaf = seen.name.rpartition("/")
        is_wanted = not wanted or prefix.strip("/") in wanted
        if is_wanted and (leaf, seen.schema_name) in SEEN and f"{prefix}/scan" not in topics:
            raise BadInput(
                f"topic {seen.name}: detections without scans; record {prefix}/scan "
                f"({schemas.SCAN.full_name}), which states how many each scan has, even if none"
            )


class TrackerSettings(NamedTuple):
    """Holds what the loop reads, a row for every sensor, and sensors' errors beside noise."""

    names: tuple[str, ...]
    numbers: Floats
    errors: Errors


def settings_of(
    topics: Mapping[str, Topic], found: SensorTopics, parameters: TrackerParameters, targets: Targets
) -> TrackerSettings:
    """Read what parameters and channels say of the sensors and targets."""
    names, own = number_fields(TrackerParameters), targets.parameters._asdict()
    kinds, by_sensor = [KINDS[kind] for kind in found.kinds], []
    for kind, scan in zip(kinds, found.scans, strict=True):
        values = {name: number for name, number in own.items() if name not in names}
        for name in names:
            given = getattr(parameters, name)
            if name in FOREIGN[kind.leaf]:
                given = np.nan
            if given is None:
                needed = name not in UNSTATED
                given = stated([topics[scan]], name, TrackerParameters, needed=needed)
            values[name] = UNSTATED.get(name, np.nan) if np.isnan(given) else float(given)
        values["gate"] = float(chi2.ppf(values["gate_probability"], len(kind.measured)))
        by_sensor.append(values)
    errors = errors_of(found.sensors, kinds, by_sensor)
    of_errors = {f"{name}_sigma": sigma for name, sigma in zip(errors.names, errors.sigma, strict=True)}
    of_errors |= {
        f"{name}_s": each for name, each in zip(errors.names, errors.correlation_s, strict=True)
    }
    size = targets.stage.model.size
    for values, places in zip(by_sensor, errors.places, strict=True):
        values |= {name: place if place < 0 else size + place for name, place in places.items()}
        values |= of_errors
    return TrackerSettings(
        tuple(by_sensor[0]), np.array([list(each.values()) for each in by_sensor]), errors
    )


# The estimator


def tracker_of(parameters: TrackerParameters, targets: Targets, settings: TrackerSettings) -> Tracker:
    """Return the parts that the parameters ask for."""
    stage, shared = targets.stage, settings.errors.shared
    stage = stage_of(*stage, names=settings.names)
    sensors = tuple(measuring(stage.model, kind, settings.names) for kind in KINDS)
    association = "jpda" if parameters.association in EXISTING else parameters.association
    assert parameters.management is not None
    return Tracker(
        stage._replace(sensors=sensors),
        KINDS,
        association,
        parameters.management,
        settings.names,
        (stage.model.size - len(settings.errors.names), shared),
    )


def _find(name: str, topics: Mapping[str, Topic], parameters: TrackerParameters) -> Iterator[Binding]:
    """Find all sensors, for one tracker."""
    found = find_sensors(topics, parameters.sensors)
    if not found.scans:
        return
    scans = [topics[scan] for scan in found.scans]
    targets = targets_of(f"estimator {name}", parameters, scans)
    settings = settings_of(topics, found, parameters, targets)
    targets = with_errors(f"estimator {name}", targets, settings.errors)
    tracker = tracker_of(parameters, targets, settings)
    if parameters.smoothed:
        check_smoothing(name, targets, settings.errors.names)
    setup = TrackerSetup(
        name, found, tracker, settings.numbers, targets, parameters.most_tracks, parameters.smoothed
    )
    seen = (topic for pair in zip(found.scans, found.detections, strict=True) for topic in pair)
    read = [*seen, *filter(None, found.origins)]
    yield Binding({topic: topics[topic] for topic in read}, setup=setup)


def _out_of_sequence(parameters: TrackerParameters, back_ns: int) -> Advance:
    if parameters.smoothed:
        raise BadInput(
            "smoothed tracks use later detections in any case; replay them in the order of the stamps, "
            "or with --late wait:SECONDS"
        )
    return partial(advance_out_of_sequence, back_ns=back_ns)


TRACKER = recursive(
    "tracks of many targets from the unordered scans of several sensors",
    parameters=TrackerParameters,
    find=_find,
    requirements="per sensor .../scan and .../detection (positions) or .../range_bearing, or "
    ".../bearing beside those",
    variant="association",
    start=start,
    advance=advance,
    out_of_sequence=_out_of_sequence,
    finish=finish,
)
