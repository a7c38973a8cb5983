"""Streams taken from the plane of one origin into that of another, 60 km away."""

import numpy as np
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.models.geodesy import (
    earth_centred,
    into_tangent_plane,
    out_of_tangent_plane,
    tangent_axes,
)
from fuselog.replay.engine.streams.planes import into_plane_of

HERE, THERE = Origin(60.0, 10.0, 50.0), Origin(60.3, 10.9, 250.0)
STAMPS = np.arange(3)
PLACES = np.array([[0.0, 0.0, 0.0], [900.0, -400.0, 30.0], [-2e3, 5e3, -10.0]])
Floats = NDArray[np.float64]


def over_the_earth(places: Floats) -> Floats:
    """By way of earth-centred axes, of which the code under test knows nothing."""
    centred = np.array(earth_centred(*HERE)) + places @ tangent_axes(*HERE[:2])
    return (centred - np.array(earth_centred(*THERE))) @ tangent_axes(*THERE[:2]).T


def test_states_positions_and_poses_are_taken_into_another_plane() -> None:
    """Places over the earth; directions as those of small steps; covariances as those of steps."""
    names = "x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,heading_rad"
    kinds = {"components": names, "kinds": ",".join(["linear"] * 6 + ["angle"])}
    velocity, heading = np.array([3.0, 4.0, 0.5]), 2.0
    state = np.hstack([PLACES, np.tile([*velocity, heading], (3, 1))])
    spread = np.diag([1.0, 9.0, 4.0, 1.0, 1.0, 1.0, 0.01])
    estimate = make_stream(
        "/estimate",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS,
        metadata={**kinds, **HERE.metadata},
        mean=state,
        covariance=np.tile(spread.ravel(), (3, 1)),
    )
    moved = into_plane_of(estimate, THERE)
    turn = tangent_axes(*THERE[:2]) @ tangent_axes(*HERE[:2]).T
    assert_allclose(moved["mean"][:, :3], over_the_earth(PLACES), atol=1e-6)
    steps = over_the_earth(PLACES + velocity) - over_the_earth(PLACES)
    assert_allclose(moved["mean"][:, 3:6], steps, atol=1e-6)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    course = (over_the_earth(PLACES + ahead) - over_the_earth(PLACES))[0]
    assert_allclose(moved["mean"][:, 6], np.arctan2(course[1], course[0]), atol=1e-4)
    assert abs(moved["mean"][0, 6] - heading) > 0.01  # meridians converge
    assert_allclose(
        moved["covariance"][0].reshape(7, 7)[:3, :3], turn @ spread[:3, :3] @ turn.T, rtol=1e-9
    )
    assert {name: moved.metadata[name] for name in THERE.metadata} == THERE.metadata
    assert_allclose(into_plane_of(moved, HERE)["mean"][:, :6], state[:, :6], atol=1e-6)

    unknown = np.full((3, 9), np.nan)
    unknown[:, 0] = 1.0
    fix = make_stream(
        "/fix",
        schemas.POSITION_FIX,
        STAMPS,
        metadata=HERE.metadata,
        position_m=PLACES,
        covariance_m2=unknown,
    )
    moved = into_plane_of(fix, THERE)
    assert_allclose(moved["position_m"], over_the_earth(PLACES), atol=1e-6)
    assert np.isnan(moved["covariance_m2"][:, 1:]).all()
    assert_allclose(moved["covariance_m2"][:, 0], turn[0, 0] ** 2)


def test_what_is_flat_lies_in_its_own_plane() -> None:
    """East and north alone are taken over at the height of their origin, as latitudes are."""
    flat = make_stream(
        "/truth",
        schemas.TRUTH_STATE,
        STAMPS,
        metadata={"components": "x_m,y_m", "kinds": "linear,linear", **HERE.metadata},
        state=PLACES[:, :2],
    )
    latitude, longitude, _ = out_of_tangent_plane(PLACES[:, :2].T, HERE)
    level = np.column_stack([latitude, longitude, np.full(3, HERE.altitude_m)])
    found = into_plane_of(flat, THERE)["state"]
    assert_allclose(found, np.transpose(into_tangent_plane(level.T, THERE))[:, :2], atol=5e-3)
    assert_allclose(found[0], into_tangent_plane(HERE, THERE)[:2], atol=1e-6)


def test_what_has_a_direction_turns_with_the_axes() -> None:
    """Courses are clockwise from north; both blocks of a pose's covariance turn as vectors."""
    turn = tangent_axes(*THERE[:2]) @ tangent_axes(*HERE[:2]).T
    course = np.array([0.3, 3.0, 0.001])
    metadata = HERE.metadata
    report = make_stream(
        "/ais",
        schemas.COURSE_FIX,
        STAMPS,
        metadata=metadata,
        position_m=PLACES[:, :2],
        course_rad=course,
        speed_mps=course,
    )
    found = into_plane_of(report, THERE)["course_rad"]
    ahead = np.column_stack([np.sin(course), np.cos(course), np.zeros(3)]) @ turn.T
    assert_allclose(found, np.arctan2(ahead[:, 0], ahead[:, 1]) % (2.0 * np.pi), atol=1e-4)
    assert abs(found - course).min() > 0.01

    speed = make_stream(
        "/speed",
        schemas.VELOCITY_FIX,
        STAMPS,
        metadata=metadata,
        velocity_mps=PLACES,
        covariance_m2ps2=np.tile([1.0, 9.0, 4.0], (3, 1)),
    )
    moved = into_plane_of(speed, THERE)
    assert_allclose(moved["velocity_mps"], PLACES @ turn.T)
    assert_allclose(moved["covariance_m2ps2"][1].reshape(3, 3), turn @ np.diag([1.0, 9.0, 4.0]) @ turn.T)

    spread = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    spread[0, 4] = spread[4, 0] = 0.25  # east with the turn about north
    body = Rotation.from_euler("zyx", [0.4, 0.2, -0.1])
    pose = make_stream(
        "/pose",
        schemas.POSE,
        STAMPS,
        metadata=metadata,
        position_m=PLACES,
        quaternion=np.tile(body.as_quat(scalar_first=True), (3, 1)),
        covariance=np.tile(spread.ravel(), (3, 1)),
    )
    moved = into_plane_of(pose, THERE)
    both = np.kron(np.eye(2), turn)
    assert_allclose(moved["position_m"], over_the_earth(PLACES), atol=1e-6)
    assert_allclose(moved["covariance"][2].reshape(6, 6), both @ spread @ both.T, atol=1e-12)
    turned = Rotation.from_quat(moved["quaternion"][0], scalar_first=True).as_matrix()
    assert_allclose(turned, turn @ body.as_matrix(), atol=1e-12)
