"""A bank of filters: its cut of a prior, and a heading that nobody knows."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import difference
from fuselog.replay.inference.all_methods import modelled
from fuselog.replay.inference.kalman.steps import InnovationRecord, Measurement, Steps, workspace
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.modes.gaussian_sum import (
    AGREED,
    GaussianSumBelief,
    gaussian_sum_steps,
    split,
    widest,
)
from tests.replay.inference.replays import outputs

pytestmark = pytest.mark.usefixtures("uncompiled")

EPOCH_NS, STEP_S, STEPS = 10**9, 0.5, 40
KINDS = ("linear", "linear", "angle")


class RollerParameters(ModelParameters):
    """How much the forward speed errs, per square root of a second."""

    speed_density: float = 0.05


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading = state
    forward, turn = control
    middle = heading + 0.5 * duration_s * turn
    far = duration_s * forward
    return x + far * np.cos(middle), y + far * np.sin(middle), heading + duration_s * turn


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    spread = parameters.speed_density**2 * duration_s
    return spread, spread, 0.0


ROLLER = Model(
    "something that rolls",
    {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"},
    RollerParameters,
    (),
    Motion(move, noise),
    control=Control("odometry", schemas.ODOMETRY, ("forward_mps", "turn_radps")),
)


def rolling(seed: int, sigma_rad: float) -> tuple[MemorySource, np.ndarray]:
    """A log with fixes of .1 m, and the true states; the prior's heading errs by what it says."""
    rng = np.random.default_rng(seed)
    control = 1.0, 0.1
    states = [np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])]
    for _ in range(STEPS):
        spread = np.sqrt(noise(None, STEP_S, RollerParameters()))
        states.append(np.array(move(states[-1], control, STEP_S, None)) + spread * rng.normal(size=3))
    truth, time_ns = np.array(states), EPOCH_NS + np.arange(STEPS + 1) * round(STEP_S * 1e9)
    sigma = np.array([0.1, 0.1, sigma_rad])
    streams = [
        make_stream(
            "/a/prior",
            schemas.GAUSSIAN_ESTIMATE,
            time_ns[:1],
            metadata={"components": "x_m,y_m,heading_rad", "kinds": ",".join(KINDS)},
            mean=(truth[0] + sigma * rng.normal(size=3))[None],
            covariance=np.diag(sigma**2).reshape(1, -1),
        ),
        make_stream(
            "/a/odometry",
            schemas.ODOMETRY,
            time_ns,
            forward_mps=np.full(STEPS + 1, control[0]),
            turn_radps=np.full(STEPS + 1, control[1]),
        ),
        make_stream(
            "/a/fix",
            schemas.POSITION_FIX,
            time_ns[1:],
            position_m=truth[1:, :2] + 0.1 * rng.normal(size=(STEPS, 2)),
            covariance_m2=np.tile(0.01 * np.eye(2).reshape(4), (STEPS, 1)),
        ),
    ]
    run = RunMetadata(scenario="rolling", parameters={}, seed=seed, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run), truth


def mean_nees(found: Any, truths: list[np.ndarray], first: int) -> float:
    """The mean NEES of all runs from a step on."""
    nees = []
    for run, truth in enumerate(truths):
        own = found["state"].of_run(run)
        error = difference(own["mean"], truth[-len(own) :], KINDS)
        spread = own["covariance"].reshape(-1, 3, 3)
        nees += np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error)[first:].tolist()
    return float(np.mean(nees))


def test_a_cut_prior_is_the_prior_in_parts():
    """Weights, means and covariances of the members give the moments of the whole."""
    root = np.array([[1.0, 0.0, 0.0], [0.3, 0.8, 0.0], [0.2, -0.1, 0.4]])
    mean, covariance = np.array([1.0, -2.0, 0.5]), root @ root.T
    weights, means, narrow = split(KINDS, mean, covariance, 45)
    away = means - mean
    assert weights.sum() == pytest.approx(1.0)
    assert narrow[2, 2] == pytest.approx((np.pi / 45) ** 2)
    assert_allclose(weights @ away, 0.0, atol=1e-12)
    assert_allclose(narrow + (away.T * weights) @ away, covariance, rtol=1e-3)


def test_no_two_members_are_opposite_so_that_their_mean_does_not_hang_on_rounding():
    logs = [rolling(seed, np.pi)[0] for seed in range(3)]
    found = outputs(ROLLER, "bank", logs)["state"]["mean"]
    for log in logs:
        log.streams["/a/prior"]["covariance"][:] *= 1.0 + 1e-14
    again = outputs(ROLLER, "bank", logs)["state"]["mean"]
    assert_allclose(again, found, atol=1e-9)
    with pytest.raises(BadInput, match="members must be odd, so that no two are opposite; give 37"):
        outputs(ROLLER, "bank", logs, members=36)


def test_of_directions_as_wide_the_first_is_cut():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    reference = np.diag([4.0, 4.0, 1.0])
    for covariance, expected in (
        (4.0 * turn @ turn.T, [1.0, 0.0, 0.0]),
        (reference[::-1, ::-1], [0.0, 1.0, 0.0]),
        (turn @ np.diag([1.0, 2.0, 3.0]) @ turn.T, turn[:, 2] * np.sign(turn[:, 2][0])),
    ):
        direction, _ = widest(["quaternion"] * 4, covariance)
        assert_allclose(np.abs(direction), np.abs(expected), atol=1e-9)
    direction, _ = widest(["angle", "angle"], np.diag([1.0, 1.0 + 1e-12]))
    assert_allclose(direction, [1.0, 0.0])


def test_a_narrow_prior_leaves_one_filter_and_what_it_estimates():
    log, _ = rolling(1, 0.01)
    alone, bank = outputs(ROLLER, "ekf", [log]), outputs(ROLLER, "bank", [log])
    assert_allclose(bank["state"]["mean"], alone["state"]["mean"], rtol=1e-12)
    assert_array_equal(bank["innovation"]["log_likelihood"], alone["innovation"]["log_likelihood"])


def test_a_bank_finds_an_unknown_heading_and_knows_how_well():
    logs, truths = zip(*(rolling(seed, np.pi) for seed in range(12)), strict=True)
    found = outputs(ROLLER, "bank", list(logs))
    weights = found["modes"]["probability"]
    assert weights.shape == (12 * STEPS, 45)
    assert_allclose(weights.sum(axis=1), 1.0)
    left = (weights > 0.0).sum(axis=1).reshape(12, STEPS)
    assert (left[:, 0] > 10).all()
    assert np.median(left[:, -1]) == 1.0
    assert mean_nees(found, list(truths), 8) == pytest.approx(3.0, abs=0.8)
    assert mean_nees(outputs(ROLLER, "ekf", list(logs)), list(truths), 8) > 10.0


def said_nothing(run: int, belief: Any, measurement: Any, memory: Any, record: Any) -> int:
    record.difference[:], record.covariance[:], record.numbers[:] = 0.0, 1.0, (0.0, 0.0, 1.0)
    return ALL_WELL


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_members_agree_by_the_squared_distance_of_their_means(share: float):
    """By the likeliest one's covariance; mean and spread of what is left are the mixture's."""
    root = np.array([[1.0, 0.0, 0.0], [0.7, 0.5, 0.0], [-0.4, 0.3, 0.2]])
    weights, apart = np.array([0.3, 0.5, 0.2]), np.array([[-0.2, 0.4, 0.5], [0.0] * 3, [0.3, 0.1, -0.6]])
    apart *= np.sqrt(share * AGREED / (weights @ (apart**2).sum(axis=1)))
    centre, covariance = np.array([5.0, -2.0, 3.1]), root @ root.T
    away = apart @ root.T
    belief = GaussianSumBelief(
        (centre + away)[None],
        np.stack([2.0 * covariance, covariance, 3.0 * covariance])[None],
        weights[None].copy(),
        np.log(weights)[None],
        np.array([[4, 6, 8]]),
        np.array([3]),
    )
    sensor = Sensor("sensor", schemas.VECTOR_MEASUREMENT, {"z": "linear"}, move)
    bound_model = BoundModel(ROLLER, ROLLER.motion, (sensor,))
    inner = Steps(lambda _: workspace(bound_model), move, (said_nothing,), move)
    steps = gaussian_sum_steps(bound_model, inner, 9)
    record = InnovationRecord(np.empty(1), np.empty((1, 1)), np.empty(3))
    nothing = Measurement(np.empty(1), None, np.empty(2), 0)
    assert steps.updates[0](0, belief, nothing, steps.memory(()), record) == ALL_WELL
    assert belief.left[0] == (1 if share < 1.0 else 3)
    if share < 1.0:
        mean = weights @ away
        spread = (weights @ [2.0, 1.0, 3.0]) * covariance + (away.T * weights) @ away
        assert_allclose(belief.mean[0, 0], centre + mean)
        assert_allclose(belief.covariance[0, 0], spread - np.outer(mean, mean))
        assert (belief.member[0, 0], belief.probability[0, 0]) == (6, 1.0)


def test_what_has_no_angle_is_refused():
    from fuselog.replay.families.ranging.model import RANGING_POSITION

    with pytest.raises(BadInput, match="lacks an angle or an orientation in its state, along which"):
        modelled(RANGING_POSITION, "bank:ekf")
    with pytest.raises(BadInput, match="'pf' is not a filter for the members of a Gaussian sum"):
        modelled(ROLLER, "bank:pf")
