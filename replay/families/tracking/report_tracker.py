"""Tracker of vessels from reports that do not identify their sender.

Every report is assigned to the track that most likely sent it, or begins a new track. Tracks are
modelled as independent point processes. For each track, the product of its current rate of reports and
its predictive density of the report is compared with the same product for new vessels. New vessels may
appear anywhere; some are at rest, close to each other in harbours, and the others have any velocity.
Reports with equal stamps are from different vessels; the most likely pairs are assigned first.

A track has one of several levels of noise: the lowest is for a moored vessel, the highest for a vessel
that turns sharply or was silent for a long time. The weights of the levels are updated by Bayes' rule
and move slightly back towards equal weights with every report. The state is the Gaussian with the
moments of the mixture, as in the first-order generalised pseudo-Bayesian filter (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 11.6.2). Both axes have the same
noise, so three numbers are enough for a track's covariance.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, make_stream, schemas
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import recursive
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Block, Ragged
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.families.tracking.association.clusters import Weights, memory_for
from fuselog.replay.families.tracking.report_association import (
    LEVELS,
    ReportInputs,
    ReportMemory,
    ReportResults,
    Reports,
    ReportSettings,
    Tracks,
    track,
)
from fuselog.replay.inference.run.loops import over_stamps

FOUR = Annotated[tuple[PositiveFloat, ...], Field(min_length=LEVELS, max_length=LEVELS)]


class ReportTrackerParameters(Parameters):
    """Assumptions about vessels and receivers, the same for all of them.

    Each track has weights for several levels of noise, in increasing order of the noise.

    Attributes:
        acceleration_density: power spectral density of the acceleration by level, in m^2/s^3.
        sigma_position_m: standard deviation of a position by level, per axis, in m.
        sigma_velocity_mps: standard deviation of a velocity by level, per axis, in m/s.
        forgetting: share by which each report moves the weights of the levels towards equal weights.
        births_per_km2_h: number of new vessels per area and time.
        resting_share: share of new vessels that are at rest.
        top_speed_mps: greatest speed of a vessel.
        usual_interval_s: time between reports that is assumed for a new track.
        slow_mps: speed below which a vessel may be at rest; a vessel at rest often repeats its last
            course.
        course_width_deg: greatest difference between two courses that are considered equal; repeated
            courses indicate a vessel at rest.
        forget_s: time without a report after which a track ends.
    """

    acceleration_density: FOUR = (1e-6, 1e-4, 1e-2, 1.0)
    sigma_position_m: FOUR = (1.5, 3.0, 5.0, 10.0)
    sigma_velocity_mps: FOUR = (0.1, 0.2, 0.3, 1.0)
    forgetting: Annotated[float, Field(gt=0, le=1)] = 0.02
    births_per_km2_h: PositiveFloat = 1.0
    resting_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    top_speed_mps: PositiveFloat = 20.0
    usual_interval_s: PositiveFloat = 30.0
    slow_mps: PositiveFloat = 0.3
    course_width_deg: Annotated[float, Field(gt=0, le=180)] = 1.0
    forget_s: PositiveFloat = 7200.0


_track = compile_over_runs(over_stamps(track), title="tracks of reports")


Reporting = Given[ReportTrackerParameters]


def start(given: Reporting) -> tuple[Reporting, Tracks]:
    """Return the settings, and a state without tracks."""
    return given, _no_tracks(given.runs)


def advance(given: Reporting, before: Tracks, block: Block) -> tuple[Tracks, list[Ragged]]:
    """Track vessels over a block; see `fuselog.replay.engine.api.functions.recursive`."""
    settings, topic = given.setup, given.topics["reports"].name
    reports = _reports(block, topic, settings)
    tracks = _with_room(before, int(np.diff(reports.offsets).max(initial=0)))
    rows = len(reports.time_ns)
    results = ReportResults(np.empty(rows, np.int64), np.empty((rows, 4)), np.empty((rows, 3)))
    ends = np.flatnonzero(block.events.is_last)
    together = int(np.diff(ends, prepend=-1).max(initial=1))
    memory = partial(_memory, together, tracks.number.shape[1])
    _track(given.runs, ReportInputs(reports, settings), tracks, results, scratch=memory)
    stream = make_stream(
        f"/estimates/{given.name}/track",
        schemas.TRACK_ESTIMATE,
        reports.time_ns,
        metadata={**state_metadata(PLANE_MOTION), "reports": topic},
        track_id=results.number,
        mean=results.mean,
        covariance=covariances(results.spread).reshape(rows, 16),
    )
    return _trimmed(tracks), [Ragged(stream, reports.offsets)]


def covariances(spread: Floats) -> Floats:
    """Expand spreads (n, 3) to covariances (n, 4, 4)."""
    found = np.zeros((len(spread), 4, 4))
    for axis in (0, 2):
        found[:, axis, axis] = spread[:, 0]
        found[:, axis, axis + 1] = found[:, axis + 1, axis] = spread[:, 1]
        found[:, axis + 1, axis + 1] = spread[:, 2]
    return found


def _reports(block: Block, topic: str, settings: ReportSettings) -> Reports:
    offsets, time_ns, _, source, _ = block.events
    given = block.streams[topic]
    course_rad, speed_mps = given["course_rad"][source], given["speed_mps"][source]
    # if the direction, or also the speed, is unknown, the velocity has a large variance about zero
    fastest = settings.top_speed_mps
    unknown = np.isnan(course_rad) | np.isnan(speed_mps)
    variance = np.where(unknown, np.where(np.isnan(speed_mps), fastest, speed_mps) ** 2, 0.0)
    velocity = np.stack([speed_mps * np.sin(course_rad), speed_mps * np.cos(course_rad)], axis=1)
    velocity[unknown] = 0.0
    position = read_vectors(given.stream, "position_m", PLANE)[source]
    return Reports(offsets, time_ns, position, velocity, variance, course_rad, speed_mps)


def _no_tracks(runs: int) -> Tracks:
    none = (runs, 0)
    return Tracks(
        used=np.zeros(runs, np.int64),
        met=np.zeros(runs, np.int64),
        number=np.empty(none, np.int64),
        time_ns=np.empty(none, np.int64),
        mean=np.empty((*none, 4)),
        spread=np.empty((*none, 3)),
        weight=np.empty((*none, LEVELS)),
        interval_s=np.empty(none),
        course_rad=np.empty(none),
        speed_mps=np.empty(none),
        held=np.empty((*none, 2)),
    )


def _with_room(tracks: Tracks, more: int) -> Tracks:
    """Copy the tracks, with room for `more` additional tracks in each run."""

    def with_room(each: NDArray) -> NDArray:
        room = np.zeros((len(each), more, *each.shape[2:]), each.dtype)
        return each.copy() if each.ndim == 1 else np.concatenate([each, room], axis=1)

    columns: Any = tracks
    return Tracks(*map(with_room, columns))


def _trimmed(tracks: Tracks) -> Tracks:
    """Remove the columns that no run uses."""
    most = int(tracks.used.max(initial=0))
    columns: Any = tracks
    return Tracks(*(each if each.ndim == 1 else each[:, :most].copy() for each in columns))


def _memory(reports: int, places: int) -> ReportMemory:
    return ReportMemory(
        Weights(np.empty((reports, places)), np.empty(reports)),
        np.empty((reports, 1 + places)),
        memory_for(reports, places),
    )


def settings_of(parameters: ReportTrackerParameters) -> ReportSettings:
    """Convert the parameters to settings of the kernel, with births per m^2 and s.

    Raises BadInput if the last level does not have the largest noise, because gates are computed with
    it.
    """
    for name in ("acceleration_density", "sigma_position_m", "sigma_velocity_mps"):
        levels = getattr(parameters, name)
        if max(levels) > levels[-1]:
            raise BadInput(f"{name} = {levels}: the levels must increase; give the smallest first")
    return ReportSettings(
        np.array(parameters.acceleration_density),
        np.square(parameters.sigma_position_m),
        np.square(parameters.sigma_velocity_mps),
        parameters.forgetting,
        parameters.births_per_km2_h / (1e6 * 3600.0),
        parameters.resting_share,
        parameters.usual_interval_s,
        parameters.slow_mps,
        float(np.radians(parameters.course_width_deg)),
        parameters.top_speed_mps,
        parameters.forget_s,
    )


def _find(_: str, topics: Mapping[str, Topic], parameters: ReportTrackerParameters) -> Iterator[Binding]:
    settings = settings_of(parameters)
    for topic in topics.values():
        if topic.schema_name == schemas.COURSE_FIX.full_name:
            yield Binding({"reports": topic}, {}, topic.name.rpartition("/")[0], setup=settings)


REPORT_TRACKER = recursive(
    "tracks of vessels from reports of position, course and speed without identities",
    parameters=ReportTrackerParameters,
    find=_find,
    requirements=".../reports (fuselog.CourseFix)",
    start=start,
    advance=advance,
)
