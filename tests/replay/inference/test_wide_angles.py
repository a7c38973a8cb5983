"""Angles that are hardly known, by methods with samples: unmeasured, they keep their variance."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import fuselog as fl
from fuselog.replay.estimators.landmarks import ROBOT
from fuselog.replay.estimators.navigation.attitude import ATTITUDE
from fuselog.replay.estimators.navigation.navigation import INERTIAL
from fuselog.replay.inference.kalman.regression import (
    kept_components,
    moved_with_noise,
    regression,
    sample_memory,
)
from fuselog.replay.inference.linear_algebra.manifold import (
    conjugate,
    from_vector,
    manifold_blocks,
    product,
    slightly_turned_back,
    to_vector,
)
from fuselog.replay.inference.model.bound_model import bound_model_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.sampling import parse_sampling
from fuselog.replay.inference.sampling.sets import SampleSets

UNIFORM_RAD, UNIFORM_AXIS_RAD = np.pi / 3**0.5, 1.33
TURNED = (0.3, -0.2, 9.7, 0.4, -0.3, 0.8)  # force and turn rate
MODELS: dict[str, tuple[Model, tuple[float, ...]]] = {
    "robot": (ROBOT, (1.0, 0.4)),
    "inertial": (INERTIAL, TURNED),
    "attitude": (ATTITUDE, TURNED),
}
SIGMAS_RAD = (0.01, 0.95, 1.0, 1.5, 3.0, 100.0)
STEP_S, STEPS = 0.1, 3


def wide(model: Model, sigma_rad: float) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """A state with an angle or rotation of this standard deviation, and that one's tangent rows."""
    mean, rows = np.linspace(0.1, 0.5, model.size), []
    for kind, component, tangent, width in manifold_blocks(model.kinds):
        if kind == "quaternion":
            mean[component : component + 4] = Rotation.from_euler("zx", [0.7, 0.2]).as_quat(
                scalar_first=True
            )
        if kind != "linear":
            rows += range(tangent, tangent + width)
    sigma = np.full(model.tangent, 0.05)
    sigma[rows] = sigma_rad
    return mean, np.diag(sigma**2), rows


def given_to(name: str) -> tuple[Any, ...]:
    """What the motion of a model is given besides its state."""
    model, control = MODELS[name]
    known = {"origin_latitude_deg": 50.0, "origin_altitude_m": 0.0} if model is INERTIAL else {}
    return control, STEP_S, model.parameters(**known)


@cache
def of_particles(name: str, sigma_rad: float) -> np.ndarray:
    """The angle's standard deviation after predictions of 20,000 particles: of wrapped errors."""
    (model, _), given = MODELS[name], given_to(name)
    mean, covariance, _ = wide(model, sigma_rad)
    rng = np.random.default_rng(1)
    away = rng.standard_normal((20_000, model.tangent)) * np.sqrt(np.diag(covariance))
    states, centre, errors = np.empty((model.size, len(away))), tuple(mean), []
    for kind, component, tangent, _ in manifold_blocks(model.kinds):
        if kind == "quaternion":
            own = slice(component, component + 4)
            turns = Rotation.from_quat(mean[own], scalar_first=True)
            turns = turns * Rotation.from_rotvec(away[:, tangent : tangent + 3])
            states[own] = turns.as_quat(scalar_first=True).T
        else:
            states[component] = mean[component] + away[:, tangent]
    moved = tuple(states)
    for _ in range(STEPS):
        moved, centre = model.motion.move(moved, *given), model.motion.move(centre, *given)
    for kind, component, _, _ in manifold_blocks(model.kinds):
        if kind == "angle":
            error = np.asarray(moved[component]) - centre[component]
            errors.append((error + np.pi) % (2 * np.pi) - np.pi)
        elif kind == "quaternion":
            own = slice(component, component + 4)
            about = Rotation.from_quat(np.array(centre[own]), scalar_first=True)
            turns = Rotation.from_quat(np.stack(moved[own], axis=1), scalar_first=True)
            errors += [*(about.inv() * turns).as_rotvec().T]
    return np.sqrt(np.mean(np.square(errors), axis=1))


@pytest.mark.paper
@pytest.mark.parametrize(
    ("of", "name"),
    [
        *(("robot", name) for name in ("ukf", "gf-5", "s2kf-25", "rukf-4")),
        *((of, name) for of in ("inertial", "attitude") for name in ("ukf", "rukf-1")),
    ],
)
def test_predictions_lose_nothing_of_an_angle(of: str, name: str) -> None:
    """At least 0.95 of the particles' standard deviation, which is at most that of a uniform angle."""
    (model, _), given = MODELS[of], given_to(of)
    sampler = parse_sampling(name).at(model.tangent)
    sets = SampleSets(*sampler.draw(np.random.default_rng(0), (1,)), 0, 0)
    regress = regression(moved_with_noise(model.motion), model.kinds, 0, model.kinds, is_motion=True)
    for sigma_rad in SIGMAS_RAD:
        mean, covariance, rows = wide(model, sigma_rad)
        wanted = of_particles(of, sigma_rad)
        memory = sample_memory(sets, model.kinds, 0, model.kinds)
        cross = np.empty_like(covariance)
        for _ in range(STEPS):
            assert regress(mean, covariance, given, (), covariance, cross, 0, memory)
            mean[:] = memory.centre
        found = np.sqrt(np.diagonal(covariance)[rows])
        assert np.all(found >= 0.95 * wanted), (sigma_rad, found, wanted)
        assert np.all(found <= 1.01 * np.hypot(sigma_rad, 0.05 * STEPS * STEP_S)), sigma_rad
        most = UNIFORM_RAD if len(rows) == 1 else UNIFORM_AXIS_RAD
        assert np.all(wanted < 1.02 * most)


@pytest.mark.parametrize("sigma_rad", [0.05, 1.5])
@pytest.mark.parametrize("model", [INERTIAL, ATTITUDE])
def test_points_on_axes_have_the_moments_of_other_points(model: Model, sigma_rad: float) -> None:
    """A point without weight that is on no axis changes no moments, only how they are computed."""
    motion = bound_model_of(model, model.motion).motion
    points, weights = parse_sampling("ukf").at(model.tangent).draw(np.random.default_rng(0), (1,))
    others = np.full((1, 1, model.tangent), 0.1)
    known = {"origin_latitude_deg": 50.0, "origin_altitude_m": 0.0} if model is INERTIAL else {}
    given = TURNED, STEP_S, model.parameters(**known)
    mean, covariance, _ = wide(model, sigma_rad)
    mixed = np.eye(model.tangent) + 0.3 * np.random.default_rng(1).standard_normal(covariance.shape)
    covariance = mixed @ covariance @ mixed.T
    found = []
    for kept, sets in (
        (kept_components(motion, model.kinds), SampleSets(points, weights, 0, 0)),
        ((), SampleSets(np.hstack([points, others]), np.hstack([weights, [[0.0]]]), 0, 0)),
    ):
        made = regression(
            moved_with_noise(motion), model.kinds, 0, model.kinds, is_motion=True, kept=kept
        )
        memory = sample_memory(sets, model.kinds, 0, model.kinds)
        spread, cross = np.empty_like(covariance), np.empty_like(covariance)
        assert made(mean, covariance, given, (), spread, cross, 0, memory)
        assert len(memory.axes) == (0 if found else points.shape[1])
        found.append((memory.centre, spread, cross))
    for on_axes, elsewhere in zip(*found, strict=True):
        assert_allclose(on_axes, elsewhere, rtol=1e-11, atol=1e-14)


def test_a_slight_turn_back_is_that_of_quaternions() -> None:
    for v in np.array([[0.0, 0.0, 0.0], [0.3, -0.5, 0.2], [-0.6, 0.5, 0.6]]):
        d = 9e-8 * np.array([0.6, -0.8, 1.0])
        turned = product(conjugate(from_vector(*d)), from_vector(*v))
        assert_allclose(slightly_turned_back(v, v @ v, d), to_vector(*turned), rtol=1e-14, atol=1e-15)


def poses(log: fl.MemorySource, method: str) -> fl.Stream:
    """The estimates of a replay without a gate."""
    replay = fl.replay(log, {"it": {"kind": method, "gate_probability": 1.0}})
    return replay.estimates[0]["/estimates/it/robot1/pose"]


def robot(heading_rad: float, **measured: Any) -> fl.MemorySource:
    """A robot that drives a circle with a heading that is known this well, and perhaps a compass."""
    log = fl.record("landmarks", seed=3, duration_s=4.0, **measured)
    prior = log.streams["/robot1/prior"]
    covariance = np.diag([0.01, 0.01, heading_rad**2]).reshape(1, 9)
    wider = replace(prior, columns={**prior.columns, "covariance": covariance})
    return replace(log, streams={**log.streams, prior.topic: wider})


@pytest.mark.parametrize(
    "method", ["ukf", "lrkf:s2kf-25", "sqrt:ukf", "smoother:ukf", "smoother:sqrt:ukf"]
)
def test_a_heading_that_nothing_measures_stays_unknown(method: str) -> None:
    """Fixes of a kilometre measure nothing; every estimate of the heading stays about uniform."""
    log = robot(3.0, fix={"rate_hz": 2.0, "sigma_m": 1e3}, range_bearing={"rate_hz": 0.0})
    replay = fl.replay(log, {"it": method})
    found = replay.estimates[0]["/estimates/it/robot1/pose"]
    heading_rad = np.sqrt(found["covariance"][:, 8])
    assert np.all(heading_rad > 0.95 * UNIFORM_RAD)
    [said] = [each for each in replay.losses if "heading_rad" in each]
    assert f"above 1 rad in {len(found)} of {len(found)} estimates" in said


@pytest.mark.parametrize("method", ["ukf", "sqrt:ukf", "lrkf:s2kf-25"])
def test_landmarks_find_a_heading_of_which_nothing_was_known(method: str) -> None:
    """Bearings that are up to half a turn off lead the right way."""
    for turned_rad in (0.0, 1.0, -2.0, 2.8):
        log = robot(3.0, range_bearing={"rate_hz": 5.0})
        prior = log.streams["/robot1/prior"]
        mean = prior["mean"] + [0.0, 0.0, turned_rad]
        off = replace(prior, columns={**prior.columns, "mean": mean})
        log = replace(log, streams={**log.streams, prior.topic: off})
        states = poses(log, method)
        truth = log.streams["/robot1/truth"]["state"][-1]
        error = states["mean"][-1] - truth
        error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        sigma = np.sqrt(np.diagonal(states["covariance"][-1].reshape(3, 3)))
        assert np.all(np.abs(error) < 5.0 * sigma + 0.05), (turned_rad, error, sigma)


@pytest.mark.parametrize("method", ["ukf", "lrkf:s2kf-25", "sqrt:ukf"])
def test_what_is_known_within_a_radian_is_sampled_as_it_always_was(
    method: str, monkeypatch: pytest.MonkeyPatch, uncompiled: None
) -> None:
    """Up to the last bit: the narrowing is not even asked for a share."""
    log = robot(0.99, fix={"rate_hz": 5.0}, range_bearing={"rate_hz": 0.0})
    found = poses(log, method)

    def never(*_: Any, **__: Any) -> Callable[..., float]:
        return lambda *_: 1.0

    monkeypatch.setattr("fuselog.replay.inference.kalman.regression.narrowing", never)
    without = poses(log, method)
    for column in ("mean", "covariance"):
        assert_array_equal(found[column], without[column])
