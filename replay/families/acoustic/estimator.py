"""Estimator `shooter:MODE`, which locates the shots of a log (Osborne et al. 2014)."""

from collections.abc import Iterator, Mapping

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.models import Medium, Noise
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.channels import numbered
from fuselog.replay.engine.streams.measurements import PLANE, read_vectors
from fuselog.replay.estimators.localization.solutions import (
    Batches,
    batches_of,
    positive,
    solution_streams,
    table_of,
)
from fuselog.replay.families.acoustic.localization import (
    Detections,
    Mode,
    Setting,
    estimate,
    parameter_names,
)


class ShooterParameters(Parameters):
    """Data that the sensors send, and quantities to estimate.

    Attributes:
        mode: data that the sensors send to the fusion centre.
        estimate_sensors: whether the sensors' own positions are estimated too.
        cross_covariances: whether local estimates keep the covariances between range and angles; the
            paper leaves them out.
    """

    mode: Mode = Mode.NATIVE_MEASUREMENTS
    estimate_sensors: bool = True
    cross_covariances: bool = False


HEARD = ("muzzle_blast_azimuth_rad", "shockwave_azimuth_rad", "time_difference_s")


def _find(name: str, topics: Mapping[str, Topic], parameters: ShooterParameters) -> Iterator[Binding]:
    """Find the sensors, their stated noise, and the stated medium."""
    sensors = list(numbered(topics, "sensor", "detections", schemas.SHOT_DETECTION))
    streams = [f"/sensor{s}/detections" for s in sensors]
    static = [f"/sensor{s}/position" for s in sensors]
    if not sensors or not set(static) <= set(topics):
        return
    worlds = {_world(topics[each]) for each in streams}
    if len(worlds) > 1:
        raise BadInput(
            f"estimator {name}: the sensors state different noise or air properties; these must be equal"
        )
    noise, medium = worlds.pop()
    setting = Setting(
        parameters.mode, noise, medium, parameters.estimate_sensors, parameters.cross_covariances
    )
    followed, fixed = ({each: topics[each] for each in names} for names in (streams, static))
    yield Binding(followed, fixed, setup=(sensors, setting))


def _world(topic: Topic) -> tuple[Noise, Medium]:
    return (
        Noise(*(positive(topic, f"sigma_{field}") for field in Noise._fields)),
        Medium(*(positive(topic, field) for field in Medium._fields)),
    )


def _solve(given: Given[ShooterParameters]) -> list[Ragged]:
    sensors, setting = given.setup
    batches, heard = gather_detections(
        [given[f"/sensor{s}/detections"] for s in sensors],
        [given[f"/sensor{s}/position"] for s in sensors],
    )
    components = parameter_names(setting, sensors)
    topic, found = f"/estimates/{given.name}/shooter", estimate(setting, heard)
    return solution_streams(topic, "/shooter/truth", components, batches, found)


def gather_detections(detections: list[Ragged], positions: list[Ragged]) -> tuple[Batches, Detections]:
    """Arrange detections by shot and sensor, with each sensor's latest fix at the last detection."""
    table = table_of(detections, ["shot_id", *HEARD])
    batches, shot = batches_of(table, "shot_id", detections[0].runs)
    heard = np.full((3, len(batches.run), len(detections)), np.nan)
    heard[:, shot, table["sensor"]] = table[list(HEARD)].T
    muzzle_blast, shockwave, time_difference = heard
    places = [_latest(ragged, batches) for ragged in positions]
    return batches, Detections(muzzle_blast, shockwave, time_difference, np.stack(places, axis=1))


def _latest(positions: Ragged, batches: Batches) -> Floats:
    """Return a sensor's latest fix (batches, 2) at the end of each batch, or NaN if it has no fix."""
    times = positions.stream.publish_time_ns
    latest = np.full(len(batches.run), -1)
    for run in np.unique(batches.run):
        first, end = positions.offsets[run : run + 2]
        rows = np.flatnonzero(batches.run == run)
        found = np.searchsorted(times[first:end], batches.time_ns[rows], side="right") - 1
        latest[rows] = np.where(found < 0, -1, first + found)
    known = read_vectors(positions.stream, "position_m", PLANE)
    fixes = np.concatenate([known, np.full((1, 2), np.nan)])
    return fixes[latest]


SHOOTER = batch(
    "origin of single shots; MODE: bearings-only, local-estimates or native-measurements",
    parameters=ShooterParameters,
    find=_find,
    requirements="per sensor N /sensorN/detections and /sensorN/position",
    solve=_solve,
    variant="mode",
)
