"""Madgwick's and Mahony's filters give what the package ahrs gives, VQF what its own does."""

import numpy as np
import pytest

from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

COUNT, STEP_NS = 40, 10_000_000
# after the last sample, by ahrs 0.4.0 from the same start (its north is x for Madgwick: turned to y)
AHRS = {
    "madgwick": [0.9851021368784839, -0.013519229552412276, -0.15698525339597294, 0.06889586755355104],
    "mahony": [0.985333638486612, -0.03338119307295511, -0.14761014549689, 0.07883249179207599],
}


def swung(begin_ns: int = SIMULATION_EPOCH_NS) -> MemorySource:
    time_s = np.arange(COUNT)[:, None] * STEP_NS * 1e-9
    samples = make_stream(
        "/hand/inertial",
        schemas.INERTIAL_SAMPLE,
        begin_ns + STEP_NS * np.arange(COUNT),
        specific_force_mps2=np.sin(9.0 * time_s + np.arange(3)) + np.array([1.0, -2.0, 9.0]),
        turn_rate_radps=np.cos(7.0 * time_s + [0.0, 1.0, 2.0]),
        magnetic_field_ut=3.0 * np.cos(5.0 * time_s + np.arange(2, -1, -1))
        + np.array([5.0, 20.0, -40.0]),
    )
    return memory_source(Recording([samples]), RunMetadata("hand"))


def replayed(label: str, **settings: float) -> Ragged:
    source = swung()
    estimates = collect(replay([source], bind(label, [source], settings)))
    return estimates[f"/estimates/{label}/hand/state"]


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("label", AHRS)
def test_it_gives_what_the_package_ahrs_gives(label):
    found = replayed(label)["mean"]
    assert len(found) == COUNT
    np.testing.assert_allclose(found[-1], AHRS[label], rtol=0, atol=1e-12)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("label", AHRS)
def test_runs_that_begin_at_other_times_are_what_each_is_alone(label):
    sources = [swung(), swung(SIMULATION_EPOCH_NS + 7 * 10**9)]
    [together] = [
        ragged
        for topic, ragged in collect(replay(sources, bind(label, sources, {}))).items()
        if topic.endswith("/state")
    ]
    for run in range(2):
        np.testing.assert_array_equal(together.of_run(run)["mean"], replayed(label)["mean"])


def test_vqf_gives_what_its_package_gives():
    vqf = pytest.importorskip("vqf")
    samples = swung().streams["/hand/inertial"]
    fields = ("turn_rate_radps", "specific_force_mps2", "magnetic_field_ut")
    expected = vqf.VQF(STEP_NS * 1e-9).updateBatch(*(np.ascontiguousarray(samples[f]) for f in fields))
    found = replayed("vqf", sigma_deg=2.0)
    np.testing.assert_allclose(found["mean"], expected["quat9D"])
    np.testing.assert_allclose(found["covariance"][0], (np.radians(2.0) ** 2 * np.eye(3)).ravel())


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("label", ["gyro", "bingham-inertial", "madgwick", "mahony", "vqf"])
def test_both_samples_of_one_stamp_count(label):
    """A turn of 0.1 rad/s, of which one of two samples says all or nothing: 1 s turns 0.1 rad."""
    time_s = np.arange(0.0, 1.5, 0.01)
    turned = 0.1 * np.maximum(time_s - 0.5, 0.0)
    rate = np.where(time_s < 0.5, 0.0, 0.1)

    def yaw(shares: list[float]) -> float:
        rates = np.outer(rate, shares).ravel()
        angle, flat = np.repeat(turned, len(shares)), np.zeros(len(rates))
        samples = make_stream(
            "/hand/inertial",
            schemas.INERTIAL_SAMPLE,
            SIMULATION_EPOCH_NS + np.repeat(np.rint(1e9 * time_s).astype(np.int64), len(shares)),
            specific_force_mps2=np.stack([flat, flat, flat + 9.81], axis=1),
            turn_rate_radps=np.stack([flat, flat, rates], axis=1),
            magnetic_field_ut=20 * np.stack([np.sin(angle), np.cos(angle), flat - 2], axis=1),
        )
        source = memory_source(Recording([samples]), RunMetadata("hand"))
        settings = {"rest_s": 0.4, "block_s": 0.2} if label in ("gyro", "bingham-inertial") else {}
        estimates = collect(replay([source], bind(label, [source], settings)))
        [mean] = [each["mean"] for topic, each in estimates.items() if topic.endswith("/state")]
        angles = np.unwrap(2 * np.arctan2(mean[:, 3], mean[:, 0]))
        return float(angles[-1] - angles[0])

    assert yaw([1.0]) == pytest.approx(0.1, abs=2e-3)
    assert yaw([0.0, 2.0]) == pytest.approx(yaw([1.0]), abs=2e-3)
    assert yaw([2.0, 0.0]) == pytest.approx(yaw([0.0, 2.0]), abs=1e-9)
    assert yaw([np.nan, 1.0]) == pytest.approx(yaw([1.0]), abs=2e-3)
