"""Square-root forms: the plain filters' estimates, and exact ones where covariances lose all digits."""

from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.linear_algebra.factors import fill_root, orthogonalise
from fuselog.replay.inference.model.model import Model, Motion, Sensor, Switching
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference import attitude, vehicle_a
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.replays import outputs
from tests.replay.inference.test_imm import SWITCHING_A
from tests.replay.inference.vehicle_a import VEHICLE_A

EQUAL = 1e-9
Floats = Any


def assert_equal(found: Any, wanted: Any) -> None:
    """The same outputs, up to rounding: covariances beside the standard deviations of their places."""
    assert found.keys() == wanted.keys()
    for topic, ragged in wanted.items():
        assert len(found[topic]) == len(ragged)
        for name in set(ragged.stream.columns) - {"sensor_time_ns"}:
            columns, scale = [np.asarray(each[topic][name], float) for each in (found, wanted)], 1.0
            if name == "covariance":
                size = int(np.sqrt(columns[1].shape[1]))
                sigma = np.sqrt(columns[1][:, :: size + 1])
                scale = (sigma[:, :, None] * sigma[:, None, :]).reshape(columns[1].shape)
            elif len(ragged):
                scale = np.maximum(np.nanmax(np.abs(np.nan_to_num(columns[1])), axis=0), 1e-300)
            assert_allclose(*(each / scale for each in columns), rtol=0, atol=EQUAL, err_msg=name)


@pytest.mark.paper
@pytest.mark.parametrize(
    ("scenario", "values", "label"),
    [
        ("landmarks", {"duration_s": 20.0}, "{}ekf"),
        ("landmarks", {"duration_s": 20.0}, "smoother:{}ukf:lag=500ms"),
        ("manoeuvres", {}, "imm:{}ekf"),
        ("batch-reactor", {}, "{}ukf"),
        ("ranging", {}, "smoother:{}ekf"),
        ("navigation", {"duration_s": 20.0}, "bank:{}ekf"),
    ],
)
def test_registered_models_have_the_plain_estimates(
    scenario: str, values: dict[str, float], label: str
) -> None:
    """Noise of controls, states that bend, ranges, orientations, several modes; by their labels."""
    source = memory_source(*record_run(scenario, values, 3))
    plain, rooted = (
        {topic.rpartition("/")[2]: stream for topic, stream in collect(replay([source], bound)).items()}
        for bound in (bind(label.format(form), [source], {}) for form in ("", "sqrt:"))
    )
    assert_equal(rooted, plain)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    ("model", "method", "name", "values"),
    [
        (VEHICLE_A, "ekf", "", {"gate_probability": 0.9}),
        (VEHICLE_A, "ekf", "", {"student_freedom": 3.0}),
        (VEHICLE_A, "ukf", "", {"kappa": -2.0, "inflate_nis": 2.0}),
        (SWITCHING_A, "imm", "ukf", {}),
        (ATTITUDE, "ukf", "", {}),
        (ATTITUDE, "smoother", "ekf", {}),
    ],
)
def test_options_and_manifolds_are_as_of_the_plain_filters(
    model: Model, method: str, name: str, values: dict[str, Any]
) -> None:
    """Gates, outliers, components that are missing, a negative weight, rotations that are reset."""
    source = (
        attitude.simulate(5, steps=50)[0]
        if model is ATTITUDE
        else vehicle_a.source(vehicle_a.simulate(7, outlier=True)[0][:80])
    )
    option = {"imm": "filter", "smoother": "forward"}.get(method, "")
    rooted = {option: f"sqrt:{name}"} if option else {"filter": method}
    plain = outputs(model, method, [source], **values, **({option: name} if option else {}))
    found = outputs(model, method if option else "sqrt", [source], **values, **rooted)
    assert_equal(found, plain)


# A prior variance of 1e8 beside measurement variances of 1e-8


FAR = {"x_m": "linear", "speed_mps": "linear", "acceleration_mps2": "linear"}
WIDE, NARROW, DRIFT = 1e8, 1e-8, 1e-12
EPOCH_NS = 10**9


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, speed, acceleration = state
    moved = x + duration_s * speed + 0.5 * duration_s**2 * acceleration
    return moved, speed + duration_s * acceleration, acceleration


def drift(state: Any, duration_s: Any, parameters: Any) -> Any:
    return DRIFT * duration_s, DRIFT * duration_s, DRIFT * duration_s


def place_twice(state: Any, about: Any, parameters: Any) -> Any:
    return state[0], state[0]


def narrow(parameters: Any) -> Any:
    return NARROW, NARROW


def always(parameters: Any) -> Any:
    return 0.1, 0.1


def either(parameters: Any) -> Any:
    return 0.5, 0.5


def model_of(*, linear: bool) -> Model:
    """A point seen twice at once; where it is not `linear`, unscented filters take samples."""
    seen = Sensor(
        "place",
        schemas.VECTOR_MEASUREMENT,
        {"x_m": "linear", "again_m": "linear"},
        place_twice,
        narrow,
        read=lambda stream: stream["value"],
        linear=linear,
    )
    motion = Motion(move, drift, linear=linear)
    return Model("a point far away", FAR, ModelParameters, (seen,), motion)


@cache
def measured() -> Floats:
    """Ten measurements (10, 2), a second apart."""
    noise = np.sqrt(NARROW) * np.random.default_rng(1).standard_normal((10, 2))
    seconds = np.arange(1.0, 11.0)
    return (1e4 - 5e3 * seconds + 1.5e3 * seconds**2)[:, None] + noise


def far_source() -> MemorySource:
    metadata = {"components": ",".join(FAR), "kinds": ",".join(FAR.values())}
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata=metadata,
        mean=np.zeros((1, 3)),
        covariance=WIDE * np.eye(3).reshape(1, 9),
    )
    stamps_ns = EPOCH_NS * np.arange(2, 12)
    place = make_stream("/place", schemas.VECTOR_MEASUREMENT, stamps_ns, value=measured())
    run = RunMetadata("far", epoch_ns=EPOCH_NS)
    return MemorySource({each.topic: each for each in (prior, place)}, run, "far")


@cache
def exact() -> tuple[Floats, Floats, Floats, Floats]:
    """Kalman's means and covariances at all stamps, and those of the first stamp given all data.

    In fractions. The state has a copy of itself, which stands still from the first stamp on.
    """
    rational = np.vectorize(Fraction, otypes=[object])
    step = np.eye(6)
    step[:3, :3] = [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    step, noise = rational(step), rational(np.diag([DRIFT] * 3 + [0.0] * 3))
    mean, covariance = rational(np.zeros(6)), rational(np.diag([WIDE] * 3 + [0.0] * 3))
    means, covariances = [], []
    for row, values in enumerate(measured()):
        mean, covariance = step @ mean, step @ covariance @ step.T + noise
        for value in values:  # one after the other, as their noises are independent
            gain = covariance[:, 0] / (covariance[0, 0] + Fraction(NARROW))
            mean = mean + gain * (Fraction(float(value)) - mean[0])
            covariance = covariance - np.outer(gain, covariance[0])
        if row == 0:
            mean, covariance = np.tile(mean[:3], 2), np.tile(covariance[:3, :3], (2, 2))
        means.append(mean)
        covariances.append(covariance)
    m, p = np.array(means).astype(float), np.array(covariances).astype(float)
    return m[:, :3], p[:, :3, :3], m[-1, 3:], p[-1, 3:, 3:]


def apart(state: Any, means: Floats, covariances: Floats) -> tuple[float, float]:
    """How far estimates are off, means and covariances, in units of the standard deviations."""
    sigma = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    found = state["covariance"].reshape(-1, 3, 3)[: len(means)]
    off = np.abs(found - covariances) / (sigma[:, :, None] * sigma[:, None, :])
    return float((np.abs(state["mean"][: len(means)] - means) / sigma).max()), float(off.max())


@pytest.mark.paper
@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize("method", ["", "imm", "smoother"])
def test_they_hold_where_covariances_break(method: str, name: str) -> None:
    """Exact to rounding, where the plain filters end.

    Samples lie 1e8 times as far from the mean as measurements are exact, so that the function's values
    there are rounded by about 1e-7 of what they tell.
    """
    model, source = model_of(linear=name == "ekf"), far_source()
    if method == "imm":  # of two motions that are the same, so that its estimates are either's
        modes = {"one": model.motion, "other": model.motion}
        model = replace(model, modes=modes, switching=Switching(always, either))
    option = {"imm": "filter", "smoother": "forward", "": "filter"}[method]
    means, covariances, first, spread = exact()
    if method == "smoother":
        means, covariances = first[None], spread[None]
    rooted = outputs(model, method or "sqrt", [source], **{option: f"sqrt:{name}" if method else name})
    assert "failure" not in rooted or not len(rooted["failure"])
    assert len(rooted["state"]) >= 10
    state = {column: rooted["state"][column][-10:] for column in ("mean", "covariance")}
    mean, covariance = apart(state, means, covariances)
    assert mean < 1e-5
    assert covariance < (1e-9 if name == "ekf" else 1e-6)
    plain = outputs(model, method or name, [source], **({option: name} if method else {}))
    assert len(plain["failure"]) == 1


# The factors


def test_a_factor_by_weights_one_of_them_negative() -> None:
    """The lower factor of the weighted product, zero where a row depends on those before it."""
    rng = np.random.default_rng(3)
    rows, weights, factor = rng.standard_normal((4, 9)), rng.uniform(0.5, 2.0, 9), np.full((4, 4), 9.0)
    weights[0], rows[2] = -0.05, rows[0] - 2.0 * rows[1]
    wanted = rows @ np.diag(weights) @ rows.T
    assert orthogonalise(rows.copy(), weights, factor)
    assert_allclose(factor @ factor.T, wanted, atol=1e-13)
    assert (np.diagonal(factor)[[0, 1, 3]] > 0.0).all()
    assert (factor[:, 2] == 0.0).all() or factor[2, 2] == 0.0
    assert (np.triu(factor, 1) == 0.0).all()
    assert not orthogonalise(rows, -weights, factor)
    assert not orthogonalise(np.full((2, 2), np.nan), np.ones(2), np.empty((2, 2)))


def test_a_root_of_noise_that_is_singular() -> None:
    """Of rank two whatever comes first, as noise that enters by two controls is; none if indefinite."""
    for tiny in (1.0, 1e-4, 1e-8, 0.0):
        gain = np.array([[tiny, 1e-6], [1.0, 2e-6], [0.0, 1.0]])
        noise, root = gain @ gain.T, np.zeros((3, 3))
        assert fill_root(root, noise.copy())
        sigma = np.sqrt(np.diagonal(noise))
        off = np.abs(root @ root.T - noise)
        assert (off <= 1e-15 * np.outer(sigma, sigma)).all()
    assert not fill_root(np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert not fill_root(np.zeros((2, 2)), np.full((2, 2), np.nan))


@pytest.mark.parametrize("label", ["sqrt:iekf", "imm:sqrt:iekf", "smoother:sqrt:lrkf"])
def test_forms_of_other_filters_are_refused(label: str) -> None:
    source = memory_source(*record_run("manoeuvres", {}, 3))
    with pytest.raises(BadInput, match="ekf") as caught:
        bind(label, [source], {})
    assert "\n" not in str(caught.value)
