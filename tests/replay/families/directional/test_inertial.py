"""The inertial filter on a simulated body: bias, motion, gaps, and the contract."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

import fuselog as fl
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.models.orientation import axis_angle_between
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.families.directional.orientation.inertial import (
    InertialModel,
    InertialSamples,
    OrientationEstimates,
    run_inertial_filter,
    start_inertial_filter,
)

RATE_HZ = 100.0
REST_S = 5.0
MODEL = InertialModel(rest_s=REST_S)
GRAVITY = np.array([0.0, 0.0, 9.81])
FIELD = np.array([0.0, 16.0, -41.0])


def simulate(seconds: float, seed: int, bias: float = 0.02) -> tuple[np.ndarray, InertialSamples]:
    """A body that rests, then tumbles: truth (rows, 4) and its samples, with noise and bias."""
    generator = np.random.default_rng(seed)
    time_s = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    phase = generator.uniform(0.0, 2.0 * np.pi, (3, 1))
    rate = 1.5 * np.sin(np.array([[0.9], [1.3], [0.7]]) * time_s + phase).T
    rate[time_s < REST_S] = 0.0
    attitude = Rotation.random(rng=generator)
    truth = []
    for turn in Rotation.from_rotvec(rate / RATE_HZ):
        attitude = attitude * turn
        truth.append(attitude)
    world = Rotation.concatenate(truth)
    noise = generator.standard_normal((3, len(time_s), 3))
    push = 2.0 * np.sin(np.array([3.0, 5.0, 4.0]) * time_s[:, None])
    samples = InertialSamples(
        np.array([0, len(time_s)]),
        (1e9 * time_s).astype(np.int64) + 10**18,
        rate + bias + 0.01 * noise[0],
        world.inv().apply(GRAVITY + push) + 0.1 * noise[1],
        world.inv().apply(FIELD) + 0.5 * noise[2],
    )
    return world.as_quat(scalar_first=True), samples


def join(*runs: InertialSamples) -> InertialSamples:
    offsets = np.cumsum([0, *(len(each.time_ns) for each in runs)])
    return InertialSamples(
        offsets, *(np.concatenate(parts) for parts in zip(*(r[1:] for r in runs), strict=True))
    )


def cut(samples: InertialSamples, rows: slice) -> InertialSamples:
    parts = [part[rows] for part in samples[1:]]
    return InertialSamples(np.array([0, len(parts[0])]), *parts)


def error_deg(truth: np.ndarray, estimates: OrientationEstimates) -> np.ndarray:
    return 2.0 * np.degrees(axis_angle_between(truth, estimates.orientation))


def test_orientation_is_found_and_kept():
    """Without the bias of the rest, 60 s of tumbling would drift by 69 degrees."""
    truth, samples = simulate(60.0, 0)
    _, estimates = run_inertial_filter(MODEL, start_inertial_filter(1), samples)
    error = error_deg(truth, estimates)
    assert np.isnan(error[: int(RATE_HZ)]).all(), "unknown until the first second is over"
    known = error[int(REST_S * RATE_HZ) :]
    assert np.sqrt((known**2).mean()) < 2.0
    assert known.max() < 5.0


def test_covariance_covers_the_error():
    """Squared errors over what the filter expects: below 1, as ten degrees per block is cautious."""
    truth, samples = simulate(60.0, 1)
    _, estimates = run_inertial_filter(MODEL, start_inertial_filter(1), samples)
    rows = slice(int(REST_S * RATE_HZ), None)
    expected = np.trace(estimates.covariance[rows], axis1=1, axis2=2)
    found = np.radians(error_deg(truth, estimates)[rows]) ** 2
    assert 0.01 < found.mean() / expected.mean() < 1.0
    assert np.linalg.eigvalsh(estimates.covariance[rows]).min() > 0.0


def test_single_block_is_the_attitude_of_its_averages():
    """At rest: up along the mean force, north along the mean field, to the noise of a second."""
    _, samples = simulate(1.5, 2, bias=0.0)
    _, estimates = run_inertial_filter(InertialModel(rest_s=1.5), start_inertial_filter(1), samples)
    first = int(RATE_HZ)
    assert np.isnan(estimates.orientation[first - 1, 0])
    mean_force = samples.force[: first + 1].mean(axis=0)
    seen = Rotation.from_quat(estimates.orientation[first], scalar_first=True)
    np.testing.assert_allclose(
        seen.apply(mean_force), [0.0, 0.0, np.linalg.norm(mean_force)], atol=1e-12
    )
    assert seen.apply(samples.field[: first + 1].mean(axis=0))[0] == pytest.approx(0.0, abs=1e-12)
    # concentration -2 / sigma^2 of one block: the standard deviation of the attitude
    sigma = np.sqrt(np.diagonal(estimates.covariance[first]))
    np.testing.assert_allclose(sigma, MODEL.attitude_sigma_rad, rtol=0.01)


@pytest.mark.parametrize("block_s", [0.5, 2.0, 4.0])
def test_drift_grows_with_time_however_long_the_blocks(block_s):
    """No field tells the attitude after the first block: variances grow linearly, within blocks too."""
    model = InertialModel(REST_S, block_s, attitude_sigma_rad=0.02, drift_sigma_rad=0.01)
    _, samples = simulate(21.0, 9)
    first = int(block_s * RATE_HZ)
    field = samples.field.copy()
    field[first + 1 :] = 0.0
    _, estimates = run_inertial_filter(model, start_inertial_filter(1), samples._replace(field=field))
    for row in (first + 30, 1234, 2050):
        expected = 0.02**2 + 0.01**2 * (row - first) / RATE_HZ
        np.testing.assert_allclose(np.diagonal(estimates.covariance[row]), expected, rtol=0.03)


def test_a_gap_makes_the_orientation_unknown_until_the_next_block():
    truth, samples = simulate(30.0, 3)
    rows = np.r_[0:2000, 2300:3000]
    held = InertialSamples(np.array([0, len(rows)]), *(part[rows] for part in samples[1:]))
    _, estimates = run_inertial_filter(MODEL, start_inertial_filter(1), held)
    error = error_deg(truth[rows], estimates)
    assert np.isfinite(error[1999])
    assert np.isnan(error[2000:2099]).all()
    # one second in motion gives the first attitude, the following ones mend it
    assert error[2110:].max() < 30.0
    assert error[2500:].max() < 5.0


def test_samples_that_are_not_finite_are_passed_over():
    truth, samples = simulate(20.0, 4)
    force = samples.force.copy()
    force[1000:1005] = np.nan
    _, estimates = run_inertial_filter(MODEL, start_inertial_filter(1), samples._replace(force=force))
    error = error_deg(truth, estimates)
    assert np.isnan(error[1000:1005]).all()
    assert error[1005:].max() < 5.0


def test_a_field_along_gravity_gives_no_attitude():
    """There is no north in it: the filter dead-reckons on."""
    _, samples = simulate(10.0, 5)
    field = samples.field.copy()
    field[600:] = samples.force[600:]
    _, estimates = run_inertial_filter(MODEL, start_inertial_filter(1), samples._replace(field=field))
    assert np.isfinite(estimates.orientation[200:]).all()


def test_ensemble_equals_single_runs_and_blocks_equal_the_whole():
    """Bit for bit, cut anywhere: the replay's contract."""
    runs = [simulate(12.0, seed)[1] for seed in (6, 7)]
    ends, whole = run_inertial_filter(MODEL, start_inertial_filter(2), join(*runs))
    for index, samples in enumerate(runs):
        state, early = run_inertial_filter(MODEL, start_inertial_filter(1), cut(samples, slice(0, 777)))
        state, late = run_inertial_filter(MODEL, state, cut(samples, slice(777, None)))
        rows = slice(index * 1200, (index + 1) * 1200)
        for part, before, after in zip(whole, early, late, strict=True):
            assert np.array_equal(part[rows], np.concatenate([before, after]), equal_nan=True)
        for end, at_end in zip(ends, state, strict=True):
            assert np.array_equal(end[index], at_end[0])


def test_bad_input_is_told():
    _, samples = simulate(1.0, 8)
    with pytest.raises(BadInput, match="must be positive"):
        run_inertial_filter(InertialModel(block_s=0.0), start_inertial_filter(1), samples)
    with pytest.raises(BadInput, match="sample needs a time"):
        run_inertial_filter(MODEL, start_inertial_filter(1), samples._replace(rate=samples.rate[:-1]))


def nine_axes(turned_deg: np.ndarray, bias_radps: float = 0.08) -> tuple[fl.MemorySource, Rotation]:
    """A unit that turns about the vertical by these angles, 100 a second, in its own noise and bias."""
    rng, count = np.random.default_rng(5), len(turned_deg)
    world = Rotation.from_euler("z", turned_deg[:, None], degrees=True)
    rate = np.zeros((count, 3))
    rate[:-1] = (world[:-1].inv() * world[1:]).as_rotvec() * RATE_HZ
    noise = rng.standard_normal((3, count, 3))
    samples = fl.make_stream(
        "/body/inertial",
        fl.schemas.INERTIAL_SAMPLE,
        fl.simulation_stamps_ns(np.arange(count) / RATE_HZ),
        specific_force_mps2=world.inv().apply(GRAVITY) + 0.02 * noise[0],
        turn_rate_radps=rate + bias_radps + 0.002 * noise[1],
        magnetic_field_ut=world.inv().apply(FIELD) + 0.3 * noise[2],
    )
    return memory_source(Recording([samples]), RunMetadata("own")), world


@pytest.mark.parametrize("kind", ["gyro", "bingham-inertial"])
def test_the_rest_is_found_and_said(kind: str) -> None:
    """It rests for 5 s and then turns by 90 degrees, or turns slowly, or rests throughout."""
    time_s = np.arange(0.0, 25.0, 1.0 / RATE_HZ)
    turns = {5.0: [5.0, 8.0], 6.0: [6.0, 25.0], 20.0: [30.0, 31.0]}
    for rest_s, way in turns.items():
        source, world = nine_axes(np.interp(time_s, way, [0.0, 90.0]))
        replay = fl.replay(source, {"of": kind})
        [said] = [each for each in replay.losses if "rest" in each]
        told_s = float(said.partition("first ")[2].split()[0])
        assert rest_s - 0.6 < told_s <= rest_s
        last = replay.estimates[0]["/estimates/of/body/state"]["mean"][-1]
        error = world[-1].inv() * Rotation.from_quat(last, scalar_first=True)
        assert np.degrees(error.magnitude()) < 2.0


@pytest.mark.parametrize("kind", ["gyro", "bingham-inertial"])
@pytest.mark.parametrize("rate_radps", [0.2, 3.0])
def test_a_unit_that_never_rests_is_refused(kind: str, rate_radps: float) -> None:
    """A steady turn looks like a bias, but the field turns with it; a stated rest is taken as it is."""
    source, _ = nine_axes(np.degrees(rate_radps) * np.arange(0.0, 10.0, 1.0 / RATE_HZ))
    with pytest.raises(BadInput, match=r"moves within 1 s of its first sample.*rest_s=SECONDS"):
        fl.replay(source, {"of": kind})
    assert len(fl.replay(source, {"of": {"kind": kind, "rest_s": 2.0}}).estimates) == 1


METHODS = ({"kind": "gyro"}, {"kind": "bingham-inertial"}, {"kind": "madgwick"}, {"kind": "mahony"})


def with_own_topic(source: fl.MemorySource, topic: str) -> fl.MemorySource:
    """The fields of a unit as those of a magnetometer, a millisecond before the unit's samples."""
    samples = source.streams["/body/inertial"]
    rows = np.isfinite(samples["magnetic_field_ut"]).all(axis=1)
    fields = fl.make_stream(
        topic,
        fl.schemas.MAGNETIC_FIELD,
        samples.publish_time_ns[rows] - 10**6,
        magnetic_field_ut=samples["magnetic_field_ut"][rows],
        covariance_ut2=np.full((int(rows.sum()), 9), np.nan),
    )
    without = {**samples.columns, "magnetic_field_ut": np.empty((len(samples), 0))}
    streams = {samples.topic: replace(samples, columns=without), topic: fields}
    return replace(source, streams=streams)


@pytest.mark.paper
@pytest.mark.parametrize(
    "settings", [*METHODS, {"kind": "vqf"}, {"kind": "triad"}, {"kind": "ekf", "model": "orientation"}]
)
@pytest.mark.parametrize("every", [3, 10])
def test_a_slower_magnetometer_is_one_of_its_own_rate(settings: dict[str, str], every: int) -> None:
    """Between its samples there are NaN: no sample, and no reading; the turn of 90 degrees is found.

    On a topic of its own, in the unit's namespace or another, it gives the same.
    """
    source, world = nine_axes(
        np.interp(np.arange(0.0, 20.0, 1.0 / RATE_HZ), [6.0, 9.0], [0.0, 90.0]), 0.0
    )
    samples = source.streams["/body/inertial"]
    field = samples["magnetic_field_ut"].copy()
    field[np.arange(len(field)) % every != 1] = np.nan
    slower = replace(samples, columns={**samples.columns, "magnetic_field_ut": field})
    nine = replace(source, streams={samples.topic: slower})
    found = []
    for log in (nine, *(with_own_topic(nine, f"/{name}/magnetic_field") for name in ("body", "mag"))):
        done = fl.replay(log, {"of": settings})
        assert not done.failures
        mean = done.estimates[0]["/estimates/of/body/state"]["mean"][:, :4]
        last = mean[np.isfinite(mean).all(axis=1)][-1]
        found.append(mean)
        error = world[-1].inv() * Rotation.from_quat(last, scalar_first=True)
        assert np.degrees(error.magnitude()) < 3.0
    assert_array_equal(found[1], found[2])
    if settings["kind"] != "ekf":  # which takes the field at its own stamp
        assert_array_equal(found[0], found[1])


@pytest.mark.parametrize("kind", ["madgwick", "bingham-inertial"])
def test_a_magnetometer_in_blocks_is_as_in_the_whole(kind: str) -> None:
    """A field at the end of a block is that of the next block's first sample; of two runs as of each."""
    runs = [
        with_own_topic(
            nine_axes(np.interp(np.arange(1500.0), [700, 900], ends))[0], "/body/magnetic_field"
        )
        for ends in ([0.0, 90.0], [0.0, -40.0])
    ]
    whole, parts = (
        collect(replay(runs, bind("of", runs, {"kind": kind}), block_messages=count))
        for count in (10**6, 7)
    )
    for topic, rows in whole.items():
        if topic.endswith("/state"):
            assert_array_equal(parts[topic]["mean"], rows["mean"])
            alone = [bind("of", [run], {"kind": kind}) for run in runs]
            each = [collect(replay([run], own)) for run, own in zip(runs, alone, strict=True)]
            assert_array_equal(np.concatenate([one[topic]["mean"] for one in each]), rows["mean"])


@pytest.mark.parametrize("settings", [*METHODS, {"kind": "triad"}, {"kind": "vqf"}])
def test_a_unit_without_a_magnetometer_is_refused(settings: dict[str, str]) -> None:
    source, _ = nine_axes(np.zeros(1000))
    samples = source.streams["/body/inertial"]
    field = np.full_like(samples["magnetic_field_ut"], np.nan)
    blind = replace(samples, columns={**samples.columns, "magnetic_field_ut": field})
    with pytest.raises(BadInput, match="has no magnetic field, which the heading needs"):
        fl.replay(replace(source, streams={samples.topic: blind}), {"of": settings})
