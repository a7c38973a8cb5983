"""Tracker of vessels and other targets from the unordered scans of one or more sensors.

    tracker:nearest     the most likely pair of track and detection first (greedy nearest neighbour)
    tracker:hungarian   the best assignment of detections to tracks (global nearest neighbour)
    tracker:jpda        all joint associations, weighted by their probabilities
    tracker:jipda       as jpda, with a probability of existence for each track
    tracker:pmbm        as jipda, and any detection may be the first of a target: the Poisson
                        multi-Bernoulli mixture. After each scan, only the marginals are kept, that is,
                        the existence and states of the tracks (TOMB/P of Williams, IEEE TAES 51(3),
                        2015). Undetected targets form a uniform Poisson process of constant density

Targets move at constant velocity with white acceleration noise, or by any registered model with a
position. If that model has several modes, each track is an interacting multiple model. The channels of
the scans state the properties of their sensors, see `fuselog.replay.families.tracking.scan_sensors`.
Detections with a position begin tracks; bearings only update confirmed tracks. The algorithm is in
`fuselog.replay.families.tracking.association.tracking`.
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
from fuselog.replay.inference.model.bound_model import bound_model_of
from fuselog.replay.inference.model.parameters import number_fields

# Defaults for the two associations that estimate existence and otherwise work like jpda.
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
    """Parameters of target motion, track management and sensors.

    A sensor parameter without a value is read from the channel of the sensor's scans. A value given here
    applies to all sensors.

    A detection begins a track if it is outside all gates and far enough from all confirmed tracks. With
    `undetected_per_m2`, any detection that may be the first of a target begins a track. The existence of
    this track is the probability that the detection is the first of a target. `management` selects the
    method of confirmation: "existence" uses the probability that the target exists, "hits" counts
    detections, and "score" uses the log-likelihood ratio of target and clutter.

    A registration error is a constant error of all measurements of a sensor; it is estimated jointly
    from all tracks. A correlated error differs between tracks and changes over time. Both are components
    of the states of tracks.

    Attributes:
        association: method of associating detections with tracks: the most likely pairs first (nearest),
            the best assignment (hungarian), or all joint associations, weighted by their probabilities
            (jpda, jipda, pmbm).
        management: method of confirming and ending tracks; by default, existence for jipda and pmbm, and
            hits for the other associations.
        sensors: the sensors to use, such as ["radar", "lidar"]; all by default.
        model: a registered model with a position, which describes the motion of targets; constant
            velocity by default.
        mode: the mode of `model` to use; all modes by default.
        motion: parameters of `model`, by name.
        acceleration_density: power spectral density of the acceleration of targets without a model, in
            m^2/s^3.
        birth_sigma_mps: standard deviation of a new track's velocity, per axis.
        birth_distance_m: minimum distance of a new track from all confirmed tracks.
        birth_existence: existence of a new track; with hits or score, existence of a track until it is
            confirmed.
        undetected_per_m2: density of targets that were never detected.
        confirming_existence: with management by existence, existence at or above which a track is
            confirmed.
        keeping_existence: existence below which a track is no longer confirmed.
        ending_existence: existence below which a track ends.
        survival_s: mean time that a target is present.
        hits_needed: with management by hits, the number of detections in the first `chances` scans that
            is needed to confirm a track.
        chances: with management by hits, the number of scans after which a track ends unless it has
            `hits_needed` detections.
        false_confirmation: with management by score, probability that clutter is confirmed as a track.
        missed_confirmation: with management by score, probability that a target's track is not
            confirmed.
        silence_s: time without a detection after which a confirmed track ends.
        tentative_silence_s: time without a detection after which an unconfirmed track ends.
        same_within_m: distance below which two tracks are treated as one target if their velocities also
            agree.
        same_within_mps: difference in velocity below which two tracks are treated as one target if their
            positions also agree.
        most_tracks: greatest number of tracks at a time.
        smoothed: whether the tracks are smoothed at the end of the run.
        gate_probability: probability that a target's detection is inside its gate.
        sigma_m: standard deviation of a position along the line of sight, or of a range.
        sigma_across_rad: additional standard deviation of a position across the line of sight, per m of
            range.
        lag_s: delay of detections: time from the measurement to the stamp.
        bias_x_m: bias of measured positions along x, measured minus true.
        bias_y_m: bias of measured positions along y, measured minus true.
        bias_range_m: bias of measured ranges, measured minus true.
        near_range_m: range up to which detection and clutter are constant; beyond this range, they
            change linearly.
        far_range_m: range beyond which detection and clutter are constant again.
        far_detection_probability: probability that a target at `far_range_m` or beyond is detected.
        clutter_per_m2: mean number of false detections in a scan, per area, near the sensor.
        far_clutter_factor: factor on clutter far from the sensor.
        sector_from_rad: start of a sector in which detection and clutter differ, anticlockwise from the
            x axis.
        sector_to_rad: end of the sector, anticlockwise from the x axis.
        sector_detection_factor: factor on the probability of detection in the sector.
        sector_clutter_factor: factor on clutter in the sector.
        joined_within_m: distance within which detections are joined and treated as one target.
        sigma_rad: standard deviation of a bearing.
        sigma_across_m: additional standard deviation of a bearing across the line of sight, in m.
        bias_rad: bias of measured bearings, measured minus true.
        clutter_per_rad: mean number of false detections in a scan, per angle.
        detection_probability: probability that a near target is detected.
        blind_from_rad: start of the sector in which a sensor cannot detect targets, anticlockwise from
            the x axis.
        blind_to_rad: end of the sector, anticlockwise from the x axis.
        interval_s: minimum time between two detections of a sensor that update the same track.
        registration_sigma_m: standard deviation of the registration error of positions or ranges; 0 for
            no such error.
        registration_sigma_rad: standard deviation of the registration error of bearings; 0 for no such
            error.
        correlated_sigma_m: standard deviation of a correlated error of positions or ranges; 0 for no
            such error.
        correlated_sigma_rad: standard deviation of a correlated error of bearings; 0 for no such error.
        correlation_s: correlation time of a correlated error.
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
        """Set defaults of management and existence that suit the association; check the given values."""
        association = values.get("association", "jipda")
        goes_by_existence = association in EXISTING
        given = values.get("management")
        if goes_by_existence and given not in (None, "existence"):
            raise ValueError(
                f"{association} requires management = existence; use management = {given} with jpda"
            )
        management = given or ("existence" if goes_by_existence else "hits")
        if values.get("undetected_per_m2") and management != "existence":
            raise ValueError("undetected_per_m2 requires management = existence")
        likely = {"birth_existence": 0.05 if management == "existence" else 0.135}
        return {**likely, **EXISTING.get(association, {}), **values, "management": management}


# Sensors


def find_sensors(topics: Mapping[str, Topic], wanted: Sequence[str]) -> SensorTopics:
    """Find the sensors that scan positions, bearings, or ranges with bearings.

    Raises BadInput if a wanted sensor is missing, the position of a sensor is missing, no sensor
    measures positions, or the sensors measure in different frames.
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
                # a sensor with a known position measures in the axes of the frame of that position
                frame = frame_of(topics.get(origin, seen).metadata)
                rows.append((number, scan.name, seen.name, origin, frame))
    missing = set(wanted) - {row[1].rpartition("/")[0].strip("/") for row in rows}
    if missing:
        raise BadInput(f"no scans of sensor {min(missing)}; remove it from sensors")
    found = SensorTopics(*zip(*rows, strict=True)) if rows else SensorTopics((), (), (), (), ())
    for scan_name, origin in zip(found.scans, found.origins, strict=True):
        if origin and (
            origin not in topics or topics[origin].schema_name != schemas.POSITION_FIX.full_name
        ):
            raise BadInput(
                f"topic {scan_name}: the position of its sensor, topic {origin} (fuselog.PositionFix), "
                "is missing; record it"
            )
    for seen_name, frame in zip(found.detections, found.frames, strict=True):
        if frame != found.frames[0]:
            raise BadInput(
                f"topic {seen_name} is in {frame_in_words(frame)}, but {found.detections[0]} is in "
                f"{frame_in_words(found.frames[0])}, and all tracks must be in one frame; select "
                "sensors of one frame with --set sensors=..."
            )
    if rows and all(KINDS[kind].birth is None for kind in found.kinds):
        raise BadInput(
            "tracks cannot begin from bearings only, which do not measure the distance of a target; "
            "add a sensor of positions, or of ranges with bearings"
        )
    return found


def _check_scans(topics: Mapping[str, Topic], wanted: Sequence[str]) -> None:
    """Raise BadInput if the log has detections but not their scans."""
    for seen in topics.values():
        prefix, _, leaf = seen.name.rpartition("/")
        is_wanted = not wanted or prefix.strip("/") in wanted
        if is_wanted and (leaf, seen.schema_name) in SEEN and f"{prefix}/scan" not in topics:
            raise BadInput(
                f"topic {seen.name}: detections without scans; record {prefix}/scan "
                f"({schemas.SCAN.full_name}), which states the number of detections, even if it is 0"
            )


class TrackerSettings(NamedTuple):
    """Parameters that the tracking loop reads, one row per sensor, and the errors of the sensors."""

    names: tuple[str, ...]
    numbers: Floats
    errors: Errors


def settings_of(
    topics: Mapping[str, Topic], found: SensorTopics, parameters: TrackerParameters, targets: Targets
) -> TrackerSettings:
    """Read the settings of sensors and targets from the parameters; read missing ones from channels."""
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
    size = targets.bound_model.model.size
    for values, places in zip(by_sensor, errors.places, strict=True):
        values |= {name: place if place < 0 else size + place for name, place in places.items()}
        values |= of_errors
    return TrackerSettings(
        tuple(by_sensor[0]), np.array([list(each.values()) for each in by_sensor]), errors
    )


# The estimator


def tracker_of(parameters: TrackerParameters, targets: Targets, settings: TrackerSettings) -> Tracker:
    """Build the tracker that the parameters describe."""
    bound_model, shared = targets.bound_model, settings.errors.shared
    bound_model = bound_model_of(*bound_model, names=settings.names)
    sensors = tuple(measuring(bound_model.model, kind, settings.names) for kind in KINDS)
    association = "jpda" if parameters.association in EXISTING else parameters.association
    assert parameters.management is not None
    return Tracker(
        bound_model._replace(sensors=sensors),
        KINDS,
        association,
        parameters.management,
        settings.names,
        (bound_model.model.size - len(settings.errors.names), shared),
    )


def _find(name: str, topics: Mapping[str, Topic], parameters: TrackerParameters) -> Iterator[Binding]:
    """Bind one tracker to all sensors."""
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
            "smoothed tracks cannot be combined with --late rewind; replay in the order of the stamps, "
            "or use --late wait:SECONDS"
        )
    return partial(advance_out_of_sequence, back_ns=back_ns)


TRACKER = recursive(
    "tracks of many targets from the unordered scans of one or more sensors",
    parameters=TrackerParameters,
    find=_find,
    requirements="per sensor .../scan and .../detection (positions) or .../range_bearing, or "
    ".../bearing in addition to those",
    variant="association",
    start=start,
    advance=advance,
    out_of_sequence=_out_of_sequence,
    finish=finish,
)
