"""A linear model with everything that can be transposed, held, missing or wrapped, beside plain NumPy.

No matrix of it is symmetric but the covariances, and these have no zeros: the transition, the prior, the
noise of motion, control and both sensors. Headings cross half a turn, some components are missing, some
stamps are equal, and the control is held between its messages. Every filter is the Kalman filter here.
"""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference.replays import outputs

Floats = NDArray[np.float64]
EPOCH_NS = 10**9
STATE = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}
MOTION = np.array([[0.3, 0.1, 0.02], [0.1, 0.2, -0.03], [0.02, -0.03, 0.05]])  # variances a second
DRIVEN = np.array([[1.0, 0.3], [0.2, -0.1], [0.0, 1.0]])  # by the control, a second
RATES = np.array([0.04, 0.09])  # variances of the control, times a second
SEEN = np.array(
    [[0.5, 0.2, 1.0], [1.0, -2.0, 0.3]]
)  # what the second sensor measures: angle, and length
OFFSET = np.array([0.4, 0.0])
NOISE = np.array([[0.02, 0.01], [0.01, 0.3]])
MEAN, PRIOR = np.array([1.0, -2.0, 3.0]), np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.2], [0.1, -0.2, 0.3]])
DRIVE = [(0.0, (1.0, 0.2)), (0.7, (2.0, -0.4)), (1.5, (0.5, 0.3))]
FIXES = [
    (0.5, (1.5, -1.0), [[0.4, 0.1], [0.1, 0.2]]),
    (1.0, (2.0, np.nan), [[0.3, -0.1], [-0.1, 0.5]]),
    (1.5, (2.5, -1.5), [[0.2, 0.05], [0.05, 0.9]]),
    (2.2, (np.nan, -1.0), [[0.6, 0.3], [0.3, 0.4]]),
]
LOOKS = [
    (0.25, (-2.9, 5.0)),
    (0.5, (3.0, 4.0)),
    (1.25, (np.nan, 5.5)),
    (1.5, (-3.1, np.nan)),
    (2.0, (3.1, 6.0)),
]


class Parameters(ModelParameters):
    """None but the methods' own."""


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading = state
    forward, turn = control
    return (
        x + duration_s * (0.4 * y + forward + 0.3 * turn),
        y + duration_s * (-0.2 * x + 0.2 * forward - 0.1 * turn),
        heading + duration_s * (0.1 * x + turn),
    )


def move_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return (
        0.3 * duration_s,
        0.1 * duration_s,
        0.2 * duration_s,
        0.02 * duration_s,
        -0.03 * duration_s,
        0.05 * duration_s,
    )


def control_noise(duration_s: Any, parameters: Any) -> Any:
    return 0.04 / duration_s, 0.09 / duration_s


def position(state: Any, reference: Any, parameters: Any) -> Any:
    return state[0], state[1]


def look(state: Any, reference: Any, parameters: Any) -> Any:
    x, y, heading = state
    return 0.5 * x + 0.2 * y + heading + 0.4, x - 2.0 * y + 0.3 * heading


def look_noise(parameters: Any) -> Any:
    return 0.02, 0.01, 0.3


CART = Model(
    "a cart whose numbers all depend on one another",
    STATE,
    Parameters,
    (
        Sensor(
            "fix",
            schemas.POSITION_FIX,
            {"x_m": "linear", "y_m": "linear"},
            position,
            vector="position_m",
            covariance="covariance_m2",
            linear=True,
        ),
        Sensor(
            "look",
            schemas.RANGE_BEARING,
            {"bearing_rad": "angle", "range_m": "linear"},
            look,
            look_noise,
        ),
    ),
    Motion(move, move_noise, control_noise=control_noise, linear=True),
    control=Control("odometry", schemas.ODOMETRY, ("forward_mps", "turn_radps")),
)


def log() -> MemorySource:
    def stamps(rows: Any) -> Any:
        return EPOCH_NS + np.rint(1e9 * np.array([row[0] for row in rows])).astype(np.int64)

    forward, turn = np.array([row[1] for row in DRIVE]).T
    names = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    streams = [
        make_stream(
            "/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=names,
            mean=[MEAN],
            covariance=[PRIOR.ravel()],
        ),
        make_stream("/odometry", schemas.ODOMETRY, stamps(DRIVE), forward_mps=forward, turn_radps=turn),
        make_stream(
            "/fix",
            schemas.POSITION_FIX,
            stamps(FIXES),
            position_m=[row[1] for row in FIXES],
            covariance_m2=[np.ravel(row[2]) for row in FIXES],
        ),
        make_stream(
            "/look",
            schemas.RANGE_BEARING,
            stamps(LOOKS),
            target_id=[0] * len(LOOKS),
            bearing_rad=[row[1][0] for row in LOOKS],
            range_m=[row[1][1] for row in LOOKS],
        ),
    ]
    run = RunMetadata(scenario="cart", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run)


def wrapped(angle: Any) -> Any:
    return np.angle(np.exp(1j * angle))


def filtered() -> tuple[dict[float, Any], list[Any]]:
    """By time the last mean and covariance, and the innovations: time, sensor, v, S, NIS, likelihood."""
    events: list[Any] = [(time_s, 0, value, None) for time_s, value in DRIVE]
    events += [(time_s, 1, value, np.array(matrix)) for time_s, value, matrix in FIXES]
    events += [(time_s, 2, value, NOISE) for time_s, value in LOOKS]
    mean, spread, now, control = MEAN, PRIOR, 0.0, np.zeros(2)
    nodes: dict[float, Any] = {}
    innovations = []
    rate = np.array([[0.0, 0.4, 0.0], [-0.2, 0.0, 0.0], [0.1, 0.0, 0.0]])
    for time_s, kind, value, noise in sorted(events, key=lambda event: event[:2]):
        if time_s > now:
            step, now = time_s - now, time_s
            moved, driven = np.eye(3) + step * rate, step * DRIVEN
            mean = moved @ mean + driven @ control
            spread = moved @ spread @ moved.T + step * MOTION + driven @ np.diag(RATES / step) @ driven.T
        if kind == 0:
            control = np.array(value)
            continue
        seen, offset = (np.eye(3)[:2], 0.0) if kind == 1 else (SEEN, OFFSET)
        known = np.isfinite(value)
        off = np.array(value) - seen @ mean - offset
        if kind == 2:
            off[0] = wrapped(off[0])
        whole, part = seen @ spread @ seen.T + noise, seen[known]
        own = whole[np.ix_(known, known)]
        gain = spread @ part.T @ np.linalg.inv(own)
        squared = off[known] @ np.linalg.solve(own, off[known])
        density = -0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * own)[1])
        innovations.append((time_s, kind, off, whole, squared, density))
        mean, spread = mean + gain @ off[known], spread - gain @ own @ gain.T
        nodes[time_s] = mean, spread
    return nodes, innovations


def check_states(found: Any, wanted: dict[float, Any]) -> None:
    """Headings are compared as directions."""
    assert_allclose((found.stream.publish_time_ns - EPOCH_NS) * 1e-9, list(wanted), atol=1e-9)
    means = np.array([mean for mean, _ in wanted.values()])
    off = found["mean"] - means
    off[:, 2] = wrapped(off[:, 2])
    assert_allclose(off, 0.0, atol=1e-9)
    covariances = np.array([covariance for _, covariance in wanted.values()])
    assert_allclose(found["covariance"].reshape(-1, 3, 3), covariances, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("method", ["ekf", "iekf", "ukf", "lrkf:s2kf-6", "sqrt:ekf", "sqrt:ukf"])
def test_a_linear_filter_is_the_kalman_filter_of_dense_matrices(method: str, uncompiled: None) -> None:
    name, _, forward = method.partition(":")
    values = {"sqrt": {"filter": forward}, "lrkf": {"sampling": forward}}.get(name, {})
    found = outputs(CART, name, [log()], gate_probability=1.0, **values)
    nodes, innovations = filtered()
    check_states(found["state"], nodes)
    told = found["innovation"]
    names = [("x_m", "y_m"), ("bearing_rad", "range_m")]
    for row, (time_s, kind, off, whole, squared, density) in enumerate(innovations):
        assert told.stream.publish_time_ns[row] == EPOCH_NS + round(1e9 * time_s)
        own = [told.stream.components.index(name) for name in names[kind - 1]]
        assert_allclose(told["innovation"][row][own], off, rtol=1e-8, atol=1e-10)
        there = np.isfinite(off)[:, None] & np.isfinite(off)
        found_whole = told["covariance"][row].reshape(4, 4)[np.ix_(own, own)]
        assert_allclose(found_whole, np.where(there, whole, np.nan), rtol=1e-8)
        assert_allclose(told["normalised_innovation_squared"][row], squared, rtol=1e-8)
        assert_allclose(told["log_likelihood"][row], density, rtol=1e-8)
