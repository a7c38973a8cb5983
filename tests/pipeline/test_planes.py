"""Positions of several planes: taken into one, or refused; never compared as they are."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fuselog as fl
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.replay.engine.streams.planes import into_plane_of

Floats = NDArray[np.float64]
# The truth's plane, and one 20 km away whose axes are turned by a quarter of a degree.
HERE, THERE = Origin(60.0, 10.0), Origin(60.1, 10.3)
STEP_S, STEPS, SIGMA_M = 0.05, 1200, 0.5
STAMPS_NS = fl.simulation_stamps_ns(STEP_S * np.arange(STEPS))
POSE = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}


def driven() -> tuple[Floats, Floats]:
    """True poses (n, 3) in the plane HERE, and what drives them (n, 2)."""
    speed = np.full(STEPS, 2.0)
    turn = 0.3 * np.sin(0.2 * STEP_S * np.arange(STEPS))
    heading = 0.7 + np.append(0.0, np.cumsum(turn * STEP_S)[:-1])
    steps = speed * STEP_S * np.array([np.cos(heading), np.sin(heading)])
    places = np.array([[40.0], [-25.0]]) + np.cumsum(np.hstack([np.zeros((2, 1)), steps[:, :-1]]), 1)
    return np.column_stack([places.T, heading]), np.stack([speed, turn], axis=1)


def car(truth_states: dict[str, str], fix_states: dict[str, str], seed: int = 3) -> list[fl.Stream]:
    """Odometry, latitudes and longitudes once a second, and the truth in the plane HERE."""
    rng = np.random.default_rng(seed)
    poses, velocity = driven()
    density = {"forward_noise_density": "0.01", "turn_noise_density": "0.005"}
    noise = rng.normal(size=(STEPS, 2)) * [0.01, 0.005] / np.sqrt(STEP_S)
    rows = slice(0, None, 20)
    seen = poses[rows, :2] + SIGMA_M * rng.normal(size=(STEPS // 20, 2))
    latitude, longitude, altitude = out_of_tangent_plane(seen.T, HERE)
    spread = np.tile(SIGMA_M**2 * np.eye(2).ravel(), (len(seen), 1))
    return [
        fl.make_stream(
            "/car/odometry",
            fl.schemas.ODOMETRY,
            STAMPS_NS,
            metadata=density,
            forward_mps=(velocity + noise)[:, 0],
            turn_radps=(velocity + noise)[:, 1],
        ),
        fl.make_stream(
            "/car/fix",
            fl.schemas.GEODETIC_FIX,
            STAMPS_NS[rows],
            metadata=fix_states,
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_m=altitude,
            covariance_m2=spread,
        ),
        fl.make_stream(
            "/car/truth",
            fl.schemas.TRUTH_STATE,
            STAMPS_NS,
            metadata={**POSE, **truth_states},
            state=poses,
        ),
    ]


def rmse_of(said: Any) -> float:
    """The position's RMSE that a command printed as JSON."""
    assert said.code == 0, said.err
    return float(said.json["metrics"]["ekf.position_rmse_m.car"])


@pytest.mark.paper
def test_truth_and_fixes_of_two_planes_are_judged_in_one(
    fuselog: Callable[..., Any], tmp_path: Path
) -> None:
    """Whatever states which plane, the errors are those of the log where all state one."""
    one, two, far = (tmp_path / f"{name}.mcap" for name in ("one", "two", "far"))
    fl.write(one, car(HERE.metadata, HERE.metadata))
    fl.write(two, car(HERE.metadata, THERE.metadata))
    *sensed, truth = car(HERE.metadata, THERE.metadata)
    fl.write(far, [*sensed, into_plane_of(truth, THERE)])
    wanted = rmse_of(fuselog("replay", one, "-e", "ekf", "--json"))
    assert wanted < SIGMA_M
    for path in (two, far):
        said = fuselog("replay", path, "-e", "ekf", "--json")
        assert rmse_of(said) == pytest.approx(wanted, rel=1e-3)
        estimates = path.with_suffix(".estimates.mcap")
        assert rmse_of(fuselog("evaluate", estimates, "--json")) == pytest.approx(rmse_of(said))
    pose = fl.open(two.with_suffix(".estimates.mcap"))["/estimates/ekf/car/pose"]
    assert pose.metadata["origin_latitude_deg"] == "60.0"
    # the truth of another log is in another plane than the estimates: it is taken into theirs
    elsewhere = fuselog("evaluate", two.with_suffix(".estimates.mcap"), "--log", far, "--json")
    assert rmse_of(elsewhere) == pytest.approx(wanted, rel=1e-3)


@pytest.mark.paper
def test_a_truth_in_an_unknown_plane_is_not_judged_until_it_is_stated(
    fuselog: Callable[..., Any], tmp_path: Path
) -> None:
    """The plane of the fixes is the first of them, which is not where the truth's zero is."""
    log = tmp_path / "log.mcap"
    fl.write(log, car({}, {}))
    said = fuselog("replay", log, "-e", "ekf", "--json")
    assert said.code == 0
    assert not any("position_rmse_m" in key for key in said.json["metrics"])
    assert said.err.count("\n") == 1
    assert "ekf car: not judged: /car/truth does not state the origin of its tangent plane" in said.err
    assert "--set /car/truth.plane=" in said.err
    estimates = log.with_suffix(".estimates.mcap")
    aligned = fuselog("evaluate", estimates, "--align", "se2", "--json")
    assert rmse_of(aligned) < SIGMA_M
    bare = fuselog("evaluate", estimates, "--delta", "5")
    assert bare.code == 2
    assert "cannot be compared without alignment: /car/truth does not state the origin" in bare.err
    for remedy in (("--origin", "60,10"), ("--set", "/car/truth.plane=60,10,0")):
        assert rmse_of(fuselog("replay", log, "-e", "ekf", *remedy, "--json")) < SIGMA_M
        # which evaluate does as the replay did
        assert rmse_of(fuselog("evaluate", estimates, "--json")) < SIGMA_M


def test_planes_that_cannot_be_told_apart_are_refused(
    fuselog: Callable[..., Any], tmp_path: Path
) -> None:
    """Two origins, and a prior that may be in either plane."""
    log = tmp_path / "log.mcap"
    prior = fl.make_stream(
        "/car/prior",
        fl.schemas.GAUSSIAN_ESTIMATE,
        STAMPS_NS[:1],
        metadata=POSE,
        mean=driven()[0][:1],
        covariance=[np.diag([1.0, 1.0, 0.01]).ravel()],
    )
    fl.write(log, [*car(HERE.metadata, THERE.metadata), prior])
    said = fuselog("replay", log, "-e", "ekf")
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert "/car/prior does not state the origin of its tangent plane" in said.err
    assert "--set /car/prior.plane=60,10,0" in said.err
    mended = fuselog("replay", log, "-e", "ekf", "--set", "/car/prior.plane=60,10,0", "--json")
    assert rmse_of(mended) < SIGMA_M
    nonsense = fuselog("replay", log, "-e", "ekf", "--origin", "100,10")
    assert nonsense.code == 2
    assert "latitude and longitude in deg" in nonsense.err
