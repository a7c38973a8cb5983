"""Model `sound-source`, which locates a sound from the differences of its arrival times.

All differences refer to one reference microphone and share its error. This error is part of the state;
given the error, the differences are independent. If all microphones are at one height, the source is
assumed to be at that height too, because the data do not determine whether it is above or below.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.inertial import distance
from fuselog.recorders.models.planar import Components
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.measurements import SPACE
from fuselog.replay.inference.model.model import Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.start import Start, Started

# Grid around the microphones on which the search for a source begins, in units of the array's size, and
# number of the best grid points from which it continues.
SOUGHT = np.linspace(-1.5, 1.5, 21)
BEST = 3
ALIKE = 6  # decimals of a cost, in squared standard deviations, that distinguish two positions
NEAR_M = 1e-9  # smallest distance to a microphone, because at zero the direction is undefined
WIDER = 100.0  # factor on the standard deviations of the start, which then has 1e-4 of the information


class SoundSourceParameters(ModelParameters):
    """Speed of sound, and standard deviations of the initial state.

    The initial state is found by least squares. Its standard deviations are a hundred times as large as
    the measured differences imply, so the initial state has little weight.

    Attributes:
        speed_of_sound_mps: speed of sound in the air.
        start_sigma_m: upper limit of the standard deviation of the initial position, per axis.
        height_sigma_m: standard deviation of the difference between the heights of source and
            microphones, if all microphones are at one height.
    """

    speed_of_sound_mps: PositiveFloat | None = None
    start_sigma_m: PositiveFloat = 100.0
    height_sigma_m: PositiveFloat = 0.01


def stay(state: Components, control: Components, duration_s: Any, parameters: Any) -> Components:
    """Return the state unchanged."""
    x, y, z, reference = state
    return x, y, z, reference


def hear(state: Components, reference: Components, parameters: Any) -> Components:
    """Compute the arrival time at the first point minus that at the second, plus the shared error."""
    away = distance(state, reference), distance(state, (reference[3], reference[4], reference[5]))
    return ((away[0] - away[1]) / parameters.speed_of_sound_mps + state[3],)


def read_differences(stream: Stream) -> Floats:
    """Read the measured differences (n, 1)."""
    return stream["difference_s"][:, None]


def read_variances(stream: Stream) -> Floats:
    """Read the covariances (n, 1, 1) of the differences."""
    return stream["variance_s2"][:, None, None]


def find_source(streams: Mapping[str, Stream], parameters: Any) -> Started:
    """Find the position that best fits the first stamp's differences, with searches from all sides.

    Raises BadInput if there are fewer differences than unknown coordinates.
    """
    stream, points = streams["differences"], streams[MICROPHONES.topic]
    first = stream.take(stream.publish_time_ns == stream.publish_time_ns[:1])
    places = dict(zip(points["landmark_id"].tolist(), points["position_m"], strict=True))
    pairs = np.stack([first["microphone_id"], first["reference_id"]], axis=1)
    known = np.array([pair[0] in places and pair[1] in places for pair in pairs.tolist()], bool)
    reference = np.array([[*places[m], *places[r]] for m, r in pairs[known].tolist()]).reshape(-1, 6)
    measured = first["difference_s"][known]
    array = np.unique(reference.reshape(-1, 3), axis=0)
    is_flat = len(array) > 0 and np.ptp(array[:, 2]) == 0.0
    free = 2 if is_flat else 3
    if len(measured) < free:
        raise BadInput(
            f"topic {stream.topic}: {len(measured)} differences of microphones in {MICROPHONES.topic} "
            f"at its first stamp; {free} are needed to locate a source"
        )
    shared_s2 = first["reference_variance_s2"][0]
    sigma = np.sqrt(first["variance_s2"][known] + shared_s2)
    middle, size = array.mean(axis=0), np.linalg.norm(np.ptp(array, axis=0))

    def residuals(place: Floats) -> Floats:
        state = (*place, *middle[free:], 0.0)
        return (hear(state, reference.T, parameters)[0] - measured) / sigma

    def slopes(place: Floats) -> Floats:
        away = np.append(place, middle[free:]) - reference.reshape(-1, 2, 3)
        toward = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), NEAR_M)
        return (toward[:, 0] - toward[:, 1])[:, :free] / (parameters.speed_of_sound_mps * sigma)[:, None]

    grid = np.stack(np.meshgrid(*[SOUGHT] * free), axis=-1).reshape(-1, free, 1)
    starts = middle[:free, None] + size * grid
    costs = np.sum(residuals(np.swapaxes(starts, 0, 1)) ** 2, axis=1)
    from scipy.optimize import least_squares  # slow to import

    scale = np.full(free, size)
    fits = [
        least_squares(residuals, start[:, 0], x_scale=scale, loss="soft_l1")  # see `_settled`
        for start in starts[np.argsort(costs.round(ALIKE), kind="stable")[:BEST]]
    ]
    best = min(fits, key=lambda fit: round(float(fit.cost), ALIKE))
    place, information = _settled(residuals, slopes, best.x, float(size))
    information = information / WIDER**2 + np.eye(free) / parameters.start_sigma_m**2
    covariance = np.diag([0.0] * free + [parameters.height_sigma_m**2] * (3 - free) + [shared_s2])
    covariance[:free, :free] = np.linalg.inv(information)
    time_ns = int(first.publish_time_ns[0])
    return Started(time_ns, np.array([*place, *middle[free:], 0.0]), covariance, HOW)


def _settled(
    residuals: Callable[[Floats], Floats],
    slopes: Callable[[Floats], Floats],
    place: Floats,
    near_m: float,
) -> tuple[Floats, Floats]:
    """Refine a position (n,) to a root of the cost's gradient; return it and the information (n, n).

    A search for the lowest cost ends where rounding errors hide any further decrease, and this point
    differs between CPUs; the root does not have this problem. If the differences do not determine the
    distance, the gradient is zero only at infinity; the position is then not changed.
    """

    def cost(there: Floats) -> float:
        return float(np.sum(np.sqrt(1.0 + residuals(there) ** 2) - 1.0))

    def gradient(there: Floats) -> Floats:
        off = residuals(there)
        return slopes(there).T @ (off / np.sqrt(1.0 + off**2))

    from scipy.optimize import root  # slow to import

    found = root(gradient, place, tol=1e-14).x
    if np.linalg.norm(found - place) < near_m and cost(found) <= cost(place) + 10.0**-ALIKE:
        place = found
    weight = (1.0 + residuals(place) ** 2) ** -1.5
    return place, (slopes(place).T * weight) @ slopes(place)


HOW = "at the best fit to its differences"
MICROPHONES = Map("/microphones", schemas.LANDMARK, "landmark_id", "position_m", SPACE, "microphone_id")
REFERENCES = Map("/microphones", schemas.LANDMARK, "landmark_id", "position_m", SPACE, "reference_id")
SOUND_SOURCE = Model(
    "position of a sound source from arrival-time differences at microphones",
    {"x_m": "linear", "y_m": "linear", "z_m": "linear", "reference_s": "linear"},
    SoundSourceParameters,
    (
        Sensor(
            "differences",
            schemas.ARRIVAL_DIFFERENCE,
            {"difference_s": "linear"},
            hear,
            reference=(MICROPHONES, REFERENCES),
            read=read_differences,
            covariance=read_variances,
        ),
    ),
    Motion(stay, linear=True),
    start=Start({}, find=find_source),
    augmentable={"speed_of_sound_mps": "linear"},
    takes_fixes=False,
)
