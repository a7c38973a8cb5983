"""The reference sheet's "model A": a vehicle among three beacons, with a speedometer."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Field, Schema, make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.planar import range_bearing
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters

Floats = NDArray[np.float64]
MEAN = np.array([0.0, 0.0, 0.0, 1.0, 0.2])
VARIANCES = np.array([1.0, 1.0, 0.09, 0.25, 0.04])
COVARIANCE = np.diag(VARIANCES)
NOISE = np.array([0.01, 0.01, 0.0025, 0.04, 0.0225])
BEACONS = np.array([[12.0, 2.0], [-3.0, 14.0], [-9.0, -4.0]])
STATE = {
    "x_m": "linear",
    "y_m": "linear",
    "heading_rad": "angle",
    "speed_mps": "linear",
    "turn_radps": "linear",
}
EPOCH_NS = 10**9


class VehicleParameters(ModelParameters):
    """Noise of the sensors, and a factor on that of the turn rate."""

    sigma_range_m: float = 0.3
    sigma_bearing_rad: float = 0.05
    sigma_speed_mps: float = 0.1


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading, speed, turn = state
    half = 0.5 * turn * duration_s
    chord = speed * duration_s * np.sinc(half / np.pi)
    return (
        x + chord * np.cos(heading + half),
        y + chord * np.sin(heading + half),
        heading + turn * duration_s,
        speed,
        turn,
    )


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return (
        0.01 * duration_s,
        0.01 * duration_s,
        0.0025 * duration_s,
        0.04 * duration_s,
        0.0225 * duration_s,
    )


def see(state: Any, reference: Any, parameters: Any) -> Any:
    return range_bearing((state[0], state[1], state[2]), reference)


def see_noise(parameters: Any) -> Any:
    return parameters.sigma_range_m**2, parameters.sigma_bearing_rad**2


def read_speed(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[3],)


def speed_noise(parameters: Any) -> Any:
    return (parameters.sigma_speed_mps**2,)


SIGHTING = Schema(
    "Sighting",
    "Range and bearing of a beacon, either of which may be missing.",
    (
        Field("sensor_time_ns", "time_ns"),
        Field("target_id", "identifier"),
        Field("range_m", "real", may_be_nan=True),
        Field("bearing_rad", "real", may_be_nan=True),
    ),
    package="test",
)
RANGE_BEARING = Sensor(
    "sighting",
    SIGHTING,
    {"range_m": "linear", "bearing_rad": "angle"},
    see,
    see_noise,
    reference=Map("/landmarks", schemas.LANDMARK, "landmark_id", "position_m", PLANE),
)
SPEED = Sensor(
    "speed",
    schemas.VECTOR_MEASUREMENT,
    {"speed_mps": "linear"},
    read_speed,
    speed_noise,
    read=lambda stream: stream["value"],
    linear=True,
)
VEHICLE_A = Model(
    "a vehicle among beacons", STATE, VehicleParameters, (RANGE_BEARING, SPEED), Motion(move, noise)
)


def wrap(angle: Any) -> Any:
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def messages() -> Iterator[tuple[float, str, int]]:
    """Stamp, sensor and beacon of every message, in file order."""
    found = [
        (round(0.25 * k, 2), 0, "rb", b)
        for k in range(1, 81)
        for b in ([0, 1, 2] if k % 4 == 0 else [k % 3])
    ]
    found += [(round(0.2 * k, 2), 1, "speed", 0) for k in range(1, 101)]
    for time_s, _, sensor, beacon in sorted(found, key=lambda each: (each[0], each[1])):
        yield time_s, sensor, beacon


Told = list[tuple[float, str, int, Floats]]
Truths = list[tuple[float, Floats]]


def simulate(seed: int, *, missing: bool = True, outlier: bool = False) -> tuple[Told, Truths]:
    """Messages with their values, and the truth at the distinct stamps."""
    [found] = simulate_all([seed], missing=missing, outlier=outlier)
    return found


def simulate_all(
    seeds: Sequence[int], *, missing: bool = True, outlier: bool = False
) -> list[tuple[Told, Truths]]:
    """What `simulate` gives of each seed."""
    in_order = [*messages()]
    stamps = len({time_s for time_s, *_ in in_order})
    numbers = 5 * (1 + stamps) + sum(1 if sensor == "speed" else 2 for _, sensor, _ in in_order)
    drawn = np.array([np.random.default_rng(seed).standard_normal(numbers) for seed in seeds])
    at = 0

    def draw(count: int) -> Floats:
        nonlocal at
        at += count
        return drawn[:, at - count : at]

    x = MEAN + np.sqrt(VARIANCES) * draw(5)
    now, told, truth, seen = 0.0, [], [(0.0, x)], 0
    for time_s, sensor, beacon in in_order:
        if time_s > now:
            duration_s = time_s - now
            moved = np.stack(move(tuple(x.T), (), duration_s, None), axis=1)
            x = moved + np.sqrt(NOISE * duration_s) * draw(5)
            now = time_s
            truth.append((now, x))
        if sensor == "speed":
            told.append((time_s, sensor, 0, x[:, 3:4] + 0.1 * draw(1)))
            continue
        z = np.array([0.3, 0.05]) * draw(2)
        distance, bearing = range_bearing(tuple(x.T[:3]), BEACONS[beacon])
        value = np.stack([distance + z[:, 0], wrap(bearing + z[:, 1])], axis=1)
        if outlier and seen == 40:
            value[:, 0] += 5.0
        if missing and seen % 7 == 6:
            value[:, 1] = np.nan
        if missing and seen % 11 == 10:
            value[:, 0] = np.nan
        seen += 1
        told.append((time_s, sensor, beacon, value))
    return [
        (
            [(*of, values[run]) for *of, values in told],
            [(time_s, states[run]) for time_s, states in truth],
        )
        for run in range(len(seeds))
    ]


def source(
    told: list[tuple[float, str, int, Floats]],
    mean: Floats = MEAN,
    covariance: Floats = COVARIANCE,
    truth: list[tuple[float, Floats]] | None = None,
) -> MemorySource:
    """The messages as a log in memory, and the prior; equal stamps keep the order of the streams."""

    def stamps(chosen: Sequence[tuple[Any, ...]]) -> Any:
        return EPOCH_NS + np.rint(np.array([each[0] for each in chosen]) * 1e9).astype(np.int64)

    sights = [each for each in told if each[1] == "rb"]
    speeds = [each for each in told if each[1] == "speed"]
    values = np.array([each[3] for each in sights]).reshape(-1, 2)
    metadata = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    streams = [
        make_stream("/landmarks", schemas.LANDMARK, [0] * 3, landmark_id=[0, 1, 2], position_m=BEACONS),
        make_stream(
            "/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=metadata,
            mean=mean[None],
            covariance=covariance.reshape(1, 25),
        ),
        make_stream(
            "/sighting",
            SIGHTING,
            stamps(sights),
            target_id=[each[2] for each in sights],
            range_m=values[:, 0],
            bearing_rad=values[:, 1],
        ),
        make_stream(
            "/speed",
            schemas.VECTOR_MEASUREMENT,
            stamps(speeds),
            value=np.array([each[3] for each in speeds]).reshape(-1, 1),
        ),
    ]
    if truth is not None:
        states = np.array([state for _, state in truth])
        streams.append(
            make_stream("/truth", schemas.TRUTH_STATE, stamps(truth), metadata=metadata, state=states)
        )
    run = RunMetadata(scenario="vehicle-a", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run)
