"""Estimators `los-positions` and `los-biases`: the schemes of Belfadel et al. on a log's streams.

A batch, which is solved as a whole, contains each line of sight once: when a sensor sees a target again,
the next batch begins. Scheme 1 is `los-positions` on a log without biases, scheme 2 is `los-positions`
on a log with biases, and scheme 3 is `los-biases`.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import ANGLES
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.channels import numbered
from fuselog.replay.engine.streams.measurements import check_width
from fuselog.replay.estimators.localization.solutions import (
    Batches,
    batches_of,
    positive,
    solution_streams,
    table_of,
)
from fuselog.replay.families.los.localization import Scene, estimate, parameter_names

NEEDS = "per sensor N /sensorN/line_of_sight, /sensorN/position and /sensorN/attitude"


class PositionsParameters(Parameters):
    """Empty set of parameters; all biases are assumed to be zero."""


class BiasesParameters(Parameters):
    """Known biases of the sensors.

    Attributes:
        known_bias_deg: known biases, in deg, such as `sensor_2_roll = 0`; all others are estimated.
    """

    known_bias_deg: dict[str, float] = {}


class Sightings(NamedTuple):
    """Batches and their lines of sight (batches, targets, sensors, 2), NaN if a target is not seen."""

    batches: Batches
    targets: list[int]
    measured: Floats


def gather_sightings(streams: list[Ragged]) -> Sightings:
    """Arrange the lines of sight of all sensors by batch."""
    table = table_of(streams, ["target_id", "azimuth_rad", "elevation_rad"])
    table["look"] = table.groupby(["run", "sensor", "target_id"]).cumcount()
    batches, batch = batches_of(table, "look", streams[0].runs)
    targets, target = np.unique(table["target_id"], return_inverse=True)
    measured = np.full((len(batches.run), len(targets), len(streams), 2), np.nan)
    measured[batch, target, table["sensor"]] = table[["azimuth_rad", "elevation_rad"]]
    return Sightings(batches, targets.tolist(), measured)


def _find(
    _: str, topics: Mapping[str, Topic], parameters: PositionsParameters | BiasesParameters
) -> Iterator[Binding]:
    """Find the sensors, the noise of their angles and the known biases."""
    sensors = list(numbered(topics, "sensor", "line_of_sight", schemas.LINE_OF_SIGHT))
    streams = [f"/sensor{s}/line_of_sight" for s in sensors]
    static = [f"/sensor{s}/{leaf}" for s in sensors for leaf in ("position", "attitude")]
    if not sensors or not set(static) <= set(topics):
        return
    angles = [f"sigma_{angle}_rad" for angle in ("azimuth", "elevation")]
    sigma_rad = np.array([[positive(topics[each], angle) for angle in angles] for each in streams])
    followed, fixed = ({each: topics[each] for each in names} for names in (streams, static))
    yield Binding(followed, fixed, setup=(sensors, sigma_rad, known_biases(sensors, parameters)))


def known_biases(sensors: Sequence[int], parameters: Parameters) -> Floats:
    """Return the known biases (sensors, 3) in rad, with NaN for the biases to estimate."""
    if not isinstance(parameters, BiasesParameters):
        return np.zeros((len(sensors), 3))
    names = [f"sensor_{s}_{angle}" for s in sensors for angle in ANGLES]
    unknown = set(parameters.known_bias_deg) - set(names)
    if unknown:
        raise BadInput(f"known_bias_deg: no bias '{min(unknown)}'; choose from: {', '.join(names)}")
    known = [parameters.known_bias_deg.get(name, np.nan) for name in names]
    return np.radians(known).reshape(-1, 3)


def _solve(given: Given[Any]) -> list[Ragged]:
    sensors, sigma_rad, known_rad = given.setup
    position = [_constant(given[f"/sensor{s}/position"], "position_m", 3) for s in sensors]
    turned = [_constant(given[f"/sensor{s}/attitude"], "quaternion", 4) for s in sensors]
    from scipy.spatial.transform import Rotation  # slow to import

    nominal = Rotation.from_quat(turned, scalar_first=True).inv().as_euler("ZYX")
    scene = Scene(np.array(position), nominal, sigma_rad, known_rad)
    seen = gather_sightings([given[f"/sensor{s}/line_of_sight"] for s in sensors])
    components = parameter_names(scene, seen.targets, sensors)
    topic, found = f"/estimates/{given.name}", estimate(scene, seen.measured)
    return solution_streams(topic, "/truth", components, seen.batches, found)


def _constant(ragged: Ragged, field: str, width: int) -> Floats:
    """Return the constant value (width,) of a stream, which is the same in all runs."""
    check_width(ragged.stream, field, width)
    values: Floats = ragged[field]
    if len(values) == 0 or (values != values[:1]).any():
        raise BadInput(
            f"topic {ragged.stream.topic}: {field} must be the same in all messages and runs; replay "
            "logs of other sensors separately"
        )
    return values[0]


_solving = partial(batch, find=_find, requirements=NEEDS, solve=_solve)
LOS_POSITIONS = _solving(
    "target positions from lines of sight, with biases assumed to be zero: schemes 1 and 2",
    parameters=PositionsParameters,
)
LOS_BIASES = _solving(
    "target positions and attitude biases from lines of sight: scheme 3", parameters=BiasesParameters
)
