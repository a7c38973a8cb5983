"""The recorder of cooperative vehicles: motion, frames, unordered scans, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import kstest, norm

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.vehicles.models import noise_moments, turn
from fuselog.recorders.log import Stream
from fuselog.recorders.models.geodesy import into_tangent_plane
from fuselog.recorders.models.planar import into_frame, out_of_frame
from fuselog.recorders.recording import record_run

TURNING = {"turn_rate_radps": [-0.05, 0.05, 0.0, -0.05, 0.05]}


def recorded(**values: object) -> dict[str, Stream]:
    recording, _ = record_run("vehicles", {"duration_s": 20.0, **values}, seed=3)
    return {stream.topic: stream for stream in recording.streams}


def test_a_turn_is_the_paper_s_matrix_and_goes_over_into_a_straight_line() -> None:
    """(14) entry by entry; the limit of small turn rates is (12), without a jump."""
    rate, span = 0.3, 2.0
    s, c = np.sin(rate * span), np.cos(rate * span)
    expected = [
        [1, s / rate, 0, -(1 - c) / rate],
        [0, c, 0, -s],
        [0, (1 - c) / rate, 1, s / rate],
        [0, s, 0, c],
    ]
    assert_allclose(np.stack(turn(np.eye(4), rate, span)), expected, atol=1e-14)
    state = np.array([1.0, 2.0, 3.0, 4.0])
    assert_allclose(turn(state, 0.0, span), [5.0, 2.0, 11.0, 4.0])
    assert_allclose(turn(state, 1e-9, span), turn(state, 0.0, span), atol=1e-7)
    assert_allclose(noise_moments(0.5, 2.0), [0.25 * 16 / 4, 0.25 * 8 / 2, 0.25 * 4])


def test_frames_are_inverse_and_the_nominal_vehicles_meet() -> None:
    """A point into the sensor's frame and back; vehicles 1 and 2 are one point at t = 50, as 4 and 5."""
    pose, point = (60.0, -40.0, 2.0), np.array([3.0, 7.0])
    assert_allclose(out_of_frame(pose, into_frame(pose, point)), point, atol=1e-12)
    streams = recorded(stochastic=False, duration_s=60.0)
    truth = [streams[f"/vehicle{number}/truth"]["state"] for number in range(1, 6)]
    assert_allclose(truth[0][50, 0::2], truth[1][50, 0::2], atol=1e-9)
    assert_allclose(truth[3][50, 0::2], truth[4][50, 0::2], atol=1e-9)


def test_truth_between_steps_lies_on_the_same_path() -> None:
    """Sensors of other rates see the same drive: shared stamps have equal states, stochastic or not."""
    coarse, fine = (
        recorded(stochastic=True, **TURNING, fix={"rate_hz": rate})["/vehicle1/truth"] for rate in (1, 4)
    )
    shared = np.isin(fine.publish_time_ns, coarse.publish_time_ns)
    assert shared.sum() == len(coarse) == 21
    assert_allclose(fine["state"][shared], coarse["state"], atol=1e-9)


def test_starts_are_drawn_from_the_prior_that_is_stated() -> None:
    """Variances far from 1, another for every component; each run draws its own."""
    variance = (25.0, 0.04, 9.0, 0.01)
    errors = []
    for run in range(40):
        values = {"stochastic": True, "prior_variance": variance, "duration_s": 1.0}
        streams = {each.topic: each for each in record_run("vehicles", values, 3, run)[0].streams}
        for number in range(1, 6):
            prior, truth = (streams[f"/vehicle{number}/{what}"] for what in ("prior", "truth"))
            assert_allclose(prior["covariance"].reshape(4, 4), np.diag(variance))
            errors.append(truth["state"][0] - prior["mean"][0])
    for error in np.transpose(errors / np.sqrt(variance)):
        assert kstest(error, norm.cdf).pvalue > 1e-4


def test_accelerations_hold_for_a_step() -> None:
    """On a straight path the mean of both velocities leads from one place to the next."""
    state = recorded(stochastic=True, step_s=2.0, fix={"rate_hz": 0.5}, infrastructure={"rate_hz": 0.5})[
        "/vehicle1/truth"
    ]["state"]
    place, velocity = state[:, ::2], state[:, 1::2]
    assert np.abs(np.diff(velocity, axis=0)).min() > 1e-6
    assert_allclose(np.diff(place, axis=0), velocity[1:] + velocity[:-1], atol=1e-9)


def test_another_sensor_changes_no_other_stream() -> None:
    """Each draws from a random stream of its own; the vehicles drive as they did."""
    alone = recorded(stochastic=True)
    crowded = recorded(stochastic=True, fix={"rate_hz": 3.0, "variance_m2": 9.0, "latency_s": 1.0})
    for topic in ("/infrastructure/scan", "/infrastructure/detection", "/vehicle2/prior"):
        for name, column in alone[topic].columns.items():
            np.testing.assert_array_equal(column, crowded[topic][name])
    assert_allclose(alone["/vehicle2/truth"]["state"][0], crowded["/vehicle2/truth"]["state"][0])
    other = recorded(stochastic=True, infrastructure={"rate_hz": 2.0, "clutter_per_scan": 4.0})
    np.testing.assert_array_equal(
        alone["/vehicle2/fix"]["position_m"], other["/vehicle2/fix"]["position_m"]
    )


def test_noise_has_the_variance_that_is_stated() -> None:
    """Of fixes and detections, neither of them near 1."""
    streams = recorded(
        duration_s=400.0, fix={"variance_m2": 16.0}, infrastructure={"variance_m2": 0.0025}
    )
    truth, fix = streams["/vehicle1/truth"], streams["/vehicle1/fix"]
    at = np.searchsorted(truth.publish_time_ns, fix.publish_time_ns)
    assert kstest(((fix["position_m"] - truth["state"][at, ::2]) / 4.0).ravel(), norm.cdf).pvalue > 1e-4
    assert_allclose(fix["covariance_m2"][0], [16.0, 0.0, 0.0, 16.0])
    states = np.stack(
        [streams[f"/vehicle{number}/truth"]["state"][1:, ::2] for number in range(1, 6)], 1
    )
    places = out_of_frame((60.0, -40.0, 2.0), streams["/infrastructure/detection"]["position_m"].T)
    apart = np.stack(places, axis=1).reshape(-1, 5, 1, 2) - states[:, None]
    nearest = np.take_along_axis(apart, np.sum(apart**2, -1, keepdims=True).argmin(2, keepdims=True), 2)
    assert kstest((nearest / 0.05).ravel(), norm.cdf).pvalue > 1e-4


def test_scans_are_the_fixes_without_order_or_identity() -> None:
    """Every scan of the network is a permutation of the vehicles' fixes, and not always the same one."""
    streams = recorded()
    fixes = np.stack([streams[f"/vehicle{number}/fix"]["position_m"] for number in range(1, 6)], axis=1)
    told = streams["/network/detection"]["position_m"].reshape(20, 5, 2)
    order = np.argmin(np.sum((told[:, :, None] - fixes[:, None]) ** 2, axis=-1), axis=2)
    assert_allclose(np.take_along_axis(fixes, order[..., None], axis=1), told)
    assert len(np.unique(order, axis=0)) > 10
    seen = streams["/infrastructure/detection"]
    pose = streams["/infrastructure/truth"]["state"][0]
    truth = np.stack([streams[f"/vehicle{number}/truth"]["state"][1:, ::2] for number in range(1, 6)], 1)
    places = np.stack(out_of_frame(pose, seen["position_m"].T), axis=1).reshape(20, 5, 2)
    nearest = np.sqrt(np.sum((places[:, :, None] - truth[:, None]) ** 2, axis=-1)).min(axis=2)
    assert 0.2 < np.sqrt(np.mean(nearest**2)) < 0.6  # sigma sqrt(0.1) in two axes: 0.447


def test_counts_are_what_losses_and_clutter_say() -> None:
    """Mean detections per scan: N p_D + clutter, within 5 standard errors; counts match the messages."""
    losses = {"detection_probability": 0.9, "clutter_per_scan": 3.0}
    streams = recorded(duration_s=1000.0, network=losses)
    counts = streams["/network/scan"]["detections"].astype(float)
    assert counts.sum() == len(streams["/network/detection"])
    assert abs(counts.mean() - 7.5) < 5 * np.sqrt((5 * 0.09 + 3.0) / len(counts))
    assert_allclose(np.bincount(streams["/network/detection"]["scan_id"], minlength=len(counts)), counts)
    assert float(streams["/network/scan"].metadata["clutter_per_m2"]) == pytest.approx(3.0 / 200_000)


def test_delays_dropouts_and_a_sensor_that_never_reports() -> None:
    """Late messages keep when they were measured; a rate of zero leaves empty streams."""
    streams = recorded(
        fix={"dropout_probability": 0.5, "latency_s": 0.25}, infrastructure={"rate_hz": 0.0}
    )
    fix = streams["/vehicle1/fix"]
    assert 3 < len(fix) < 17
    assert np.all(fix.log_time_ns - fix.publish_time_ns == 250_000_000)
    assert len(streams["/infrastructure/scan"]) == len(streams["/infrastructure/detection"]) == 0


def test_geodetic_fixes_are_the_same_places() -> None:
    """Back through the tangent plane at the scenario's origin, to a tenth of a millimetre."""
    streams = recorded(origin_deg=[-33.9, 151.2])
    geodetic, fix = streams["/vehicle2/geodetic_fix"], streams["/vehicle2/fix"]
    east, north, _ = into_tangent_plane(
        (geodetic["latitude_deg"], geodetic["longitude_deg"]), (-33.9, 151.2)
    )
    assert_allclose(np.stack([east, north], axis=1), fix["position_m"], atol=1e-4)


def test_turn_rates_must_fit_the_vehicles() -> None:
    with pytest.raises(BadInput, match="2 entries for 5 vehicles"):
        recorded(turn_rate_radps=[0.1, 0.2])
