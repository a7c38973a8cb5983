"""Where a sound came from: differences that share a reference, the start, microphones in a plane."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.acoustic.sound_source import (
    SOUND_SOURCE,
    SoundSourceParameters,
    find_source,
)
from tests.replay.inference.replays import outputs

SPEED = 343.0
ARRAY = np.array([[0, 0, 0], [30, 0, 4], [0, 30, 8], [30, 30, 1], [15, 5, 12], [5, 20, 15.0]])


def streams(places: np.ndarray, source: np.ndarray, sigma_s: np.ndarray) -> dict[str, Stream]:
    """Differences without error of a sound at a place, later than at the first microphone."""
    arrival_s = np.linalg.norm(places - source, axis=1) / SPEED
    others = len(places) - 1
    return {
        "/microphones": make_stream(
            "/microphones",
            schemas.LANDMARK,
            [0] * len(places),
            landmark_id=np.arange(1, others + 2),
            position_m=places,
        ),
        "/owl/differences": make_stream(
            "/owl/differences",
            schemas.ARRIVAL_DIFFERENCE,
            [10**9] * others,
            metadata={"speed_of_sound_mps": repr(SPEED)},
            microphone_id=np.arange(2, others + 2),
            reference_id=[1] * others,
            difference_s=(arrival_s - arrival_s[0])[1:],
            variance_s2=sigma_s[1:] ** 2,
            reference_variance_s2=[sigma_s[0] ** 2] * others,
            likeness=[1.0] * others,
        ),
    }


def found(of: dict[str, Stream], **values: Any) -> Any:
    parameters = SoundSourceParameters(speed_of_sound_mps=SPEED, **values)
    return find_source(
        {"differences": of["/owl/differences"], "/microphones": of["/microphones"]}, parameters
    )


@pytest.mark.usefixtures("uncompiled")
def test_differences_share_the_error_of_their_reference() -> None:
    """The covariance is that of least squares weighted by the differences' whole covariance."""
    place, sigma_s = np.array([12.0, 40.0, 3.0]), np.array([3e-4, 1e-4, 2e-4, 1e-4, 4e-4, 1e-4])
    source = MemorySource(streams(ARRAY, place, sigma_s), RunMetadata("test"), "test")
    state = outputs(SOUND_SOURCE, "ekf", [source], start_sigma_m=1e4)["state"].stream
    unit = (place - ARRAY) / np.linalg.norm(place - ARRAY, axis=1)[:, None]
    rows = (unit[1:] - unit[0]) / SPEED
    spread = np.diag(sigma_s[1:] ** 2) + sigma_s[0] ** 2
    expected = np.linalg.inv(rows.T @ np.linalg.inv(spread) @ rows)
    assert_allclose(state["mean"][-1][:3], place, atol=1e-3)
    assert_allclose(state["covariance"][-1].reshape(4, 4)[:3, :3], expected, rtol=1e-3)


@pytest.mark.parametrize("place", [(12.0, 40.0, 3.0), (-60.0, 10.0, 20.0), (15.0, 15.0, 100.0)])
def test_a_source_is_found_inside_and_outside_of_the_microphones(place: tuple) -> None:
    of = streams(ARRAY, np.array(place), np.full(6, 1e-5))
    assert_allclose(found(of).mean[:3], place, atol=1e-2)


def test_a_start_does_not_hang_on_rounding_nor_lie_at_infinity() -> None:
    flat = ARRAY * [1.0, 1.0, 0.0]
    for array, place in (
        (ARRAY, [12.0, 40.0, 3.0]),
        (ARRAY, [-200.0, 10.0, 20.0]),
        (flat, [0.0, 40.0, 0.0]),
    ):
        of = streams(array, np.array(place), np.full(6, 1e-4))
        of["/owl/differences"]["difference_s"][:] += [2e-4, -1e-4, 3e-4, -2e-4, 1e-4]
        start = found(of).mean
        of["/owl/differences"]["difference_s"][:] *= 1.0 + 1e-15
        assert_allclose(found(of).mean, start, rtol=1e-9, atol=1e-9)
    # from so far away nothing tells how far: waves are plane, and their differences even a little larger
    of = streams(flat, np.array([1e9, 2e9, 0.0]), np.full(6, 1e-4))
    of["/owl/differences"]["difference_s"][:] *= 1.001
    assert np.linalg.norm(found(of).mean) < 1e7


@pytest.mark.parametrize("size", [0.01, 100.0])
def test_a_start_grows_with_the_array(size: float) -> None:
    """Places, their uncertainty and the differences' errors have no other unit than the array's size."""
    place = np.array([-60.0, 10.0, 20.0])
    start = found(streams(ARRAY, place, np.full(6, 1e-5)), start_sigma_m=1e6)
    grown = found(streams(size * ARRAY, size * place, np.full(6, size * 1e-5)), start_sigma_m=size * 1e6)
    assert_allclose(grown.mean[:3], size * start.mean[:3], rtol=1e-6)
    assert_allclose(grown.covariance[:3, :3], size**2 * start.covariance[:3, :3], rtol=1e-6)


def test_microphones_in_a_plane_have_their_source_there() -> None:
    flat = ARRAY * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    of = streams(flat[:4], np.array([12.0, 40.0, 2.0]), np.full(4, 1e-5))
    start = found(of, height_sigma_m=0.5)
    assert_allclose(start.mean, [12.0, 40.0, 2.0, 0.0], atol=1e-3)
    assert np.sqrt(np.diag(start.covariance))[2:] == pytest.approx([0.5, 1e-5])
    with pytest.raises(BadInput, match=r"1 differences of microphones .* 2 are needed"):
        found(streams(flat[:2], np.zeros(3), np.full(2, 1e-5)))
    with pytest.raises(BadInput, match=r"2 differences of microphones .* 3 are needed"):
        found(streams(ARRAY[:3], np.zeros(3), np.full(3, 1e-5)))


def test_a_start_is_as_wide_as_the_differences_leave_it_and_no_wider_than_is_said() -> None:
    """A hundred times their standard deviations: wide enough not to count, too narrow to lose digits."""
    place, sigma_s = np.array([12.0, 40.0, 3.0]), np.full(6, 1e-4)
    unit = (place - ARRAY) / np.linalg.norm(place - ARRAY, axis=1)[:, None]
    rows = (unit[1:] - unit[0]) / SPEED / (np.sqrt(2.0) * 1e-4)
    start = found(streams(ARRAY, place, sigma_s), start_sigma_m=1e6)
    assert_allclose(start.covariance[:3, :3], 1e4 * np.linalg.inv(rows.T @ rows), rtol=1e-3)
    start = found(streams(ARRAY, place, sigma_s), start_sigma_m=1e-3)
    assert_allclose(start.covariance[:3, :3], 1e-6 * np.eye(3), atol=1e-9)


@pytest.mark.usefixtures("uncompiled")
def test_simulated_recordings_are_located_as_surely_as_is_said() -> None:
    squared = []
    for run in range(6):
        values = {"rate_hz": 16000.0, "sound_s": 0.1, "snr_db": 15.0}
        source = memory_source(*record_run("sound-source", values, 2, run))
        state = outputs(SOUND_SOURCE, "ekf", [source])["state"].stream
        off = state["mean"][-1][:2] - source.streams["/sound/truth"]["state"][0]
        covariance = state["covariance"][-1].reshape(4, 4)[:2, :2]
        squared.append(off @ np.linalg.solve(covariance, off))
    # chi-square of 12 degrees of freedom, within 99.9 %
    assert 1.4 < sum(squared) < 35.0


def test_a_band_that_the_rate_cannot_hold_is_named() -> None:
    with pytest.raises(BadInput, match=r"band_hz = \[1000, 9000\].*half of rate_hz = 16000"):
        record_run("sound-source", {"rate_hz": 16000.0, "band_hz": [1000.0, 9000.0]}, 1)


def test_hearing_is_later_where_it_is_farther() -> None:
    parameters = SimpleNamespace(speed_of_sound_mps=SPEED)
    reference = (3.0, 4.0, 0.0, 0.0, 0.0, 1.0)
    (later_s,) = SOUND_SOURCE.sensors[0].measure((0.0, 0.0, 0.0, 2e-3), reference, parameters)
    assert later_s == pytest.approx(4.0 / SPEED + 2e-3)
