"""The orientation of what is carried about: its bias, its gravity, and a field that is disturbed."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.orientation import axis_angle_between, conjugate, rotate
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.estimators.navigation.attitude import ATTITUDE
from fuselog.replay.inference.model.model import Model
from tests.replay.inference.replays import outputs

RATE_HZ, SECONDS = 25.0, 30
BIAS_RADPS = np.array([0.01, -0.006, 0.004])
FIELD_UT = np.array([0.0, 18.0, -40.0])
TIME_S = np.arange(int(RATE_HZ * SECONDS)) / RATE_HZ


def carried(disturbance_ut: float = 0.0) -> tuple[Stream, np.ndarray]:
    """A body that rests for two seconds, then is swung about; a magnet comes near from 12 to 20 s.

    Its samples, and its true orientations (n, 4).
    """
    swing = 0.5 * (1.0 - np.cos(np.pi * np.clip(TIME_S - 2.0, 0.0, 1.0)))
    turned = Rotation.from_euler("ZYX", np.stack([0.8 * np.sin(TIME_S), 0.4 * swing, 0.3 * swing], 1))
    turned = Rotation.from_euler("z", 0.7) * Rotation.from_rotvec(swing[:, None] * turned.as_rotvec())
    truth = turned.as_quat(scalar_first=True)
    rate = (turned[:-1].inv() * turned[1:]).as_rotvec() * RATE_HZ
    rate = 0.5 * (np.concatenate([rate[:1], rate]) + np.concatenate([rate, rate[-1:]]))
    acceleration = 6.0 * swing[:, None] * np.sin(5.0 * TIME_S[:, None] + [0.0, 1.0, 2.0])
    force = rotate(conjugate(truth), acceleration + np.array([0.0, 0.0, 9.80665]))
    field = rotate(conjugate(truth), FIELD_UT)
    field[(TIME_S >= 12.0) & (TIME_S < 20.0), 0] += disturbance_ut
    noise = np.random.default_rng(0).normal(size=(3, len(TIME_S), 3))
    samples = make_stream(
        "/hand/inertial",
        schemas.INERTIAL_SAMPLE,
        SIMULATION_EPOCH_NS + np.rint(TIME_S * 1e9).astype(int),
        metadata={"rate_hz": repr(RATE_HZ)},
        specific_force_mps2=force + 0.02 * noise[0],
        turn_rate_radps=rate + BIAS_RADPS + 0.002 * noise[1],
        magnetic_field_ut=field + 0.2 * noise[2],
    )
    return samples, truth


def logged(*streams: Stream) -> MemorySource:
    return memory_source(Recording(list(streams)), RunMetadata("hand", epoch_ns=SIMULATION_EPOCH_NS))


def errors_deg(
    model: Model, disturbance_ut: float, until_s: float, **values: Any
) -> tuple[np.ndarray, Any, Any]:
    samples, truth = carried(disturbance_ut)
    samples = samples.take(slice(0, round(until_s * RATE_HZ)))
    found = outputs(model, "ekf", [logged(samples)], **values)
    state = found["state"].stream
    rows = np.searchsorted(samples.publish_time_ns, state.publish_time_ns)
    error = 2.0 * np.degrees(axis_angle_between(state["mean"][:, :4], truth[rows]))
    return error, state, found["innovation"].stream


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_bias_and_orientation_are_found_in_motion():
    """There is an estimate at every sample; velocity and field are measured once a second."""
    error, state, innovation = errors_deg(ATTITUDE, 0.0, SECONDS)
    assert len(error) == len(TIME_S)
    assert len(innovation) == 2 * SECONDS
    assert error[-250:].max() < 1.5
    deviation = state["mean"][-1, 4:7] - BIAS_RADPS
    sigma = np.sqrt(np.diag(state["covariance"][-1].reshape(11, 11))[3:6])
    assert np.abs(deviation).max() < 0.002
    assert np.abs(deviation / sigma).max() < 3.0


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_a_disturbed_field_is_kept_out_by_the_gate_and_turns_the_heading_without_it():
    error, _, innovation = errors_deg(ATTITUDE, 25.0, 21.0)
    rejected = innovation.publish_time_ns[innovation["accepted"] == 0] - SIMULATION_EPOCH_NS
    np.testing.assert_array_equal(rejected, np.arange(12, 20) * 10**9)
    assert error.max() < 5.0
    error, _, innovation = errors_deg(ATTITUDE, 25.0, 21.0, gate_probability=1.0)
    assert innovation["accepted"].all()
    assert error.max() > 10.0


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (np.full(3, np.nan), "no magnetic field in the first 1 s"),
        (np.array([0.0, 0.0, 40.0]), "parallel at the start, so they do not determine"),
    ],
)
def test_a_start_without_heading_is_refused(field, message):
    count = 50
    samples = make_stream(
        "/hand/inertial",
        schemas.INERTIAL_SAMPLE,
        SIMULATION_EPOCH_NS + 40_000_000 * np.arange(count),
        specific_force_mps2=np.tile([0.0, 0.0, 9.8], (count, 1)),
        turn_rate_radps=np.zeros((count, 3)),
        magnetic_field_ut=np.tile(field, (count, 1)),
    )
    with pytest.raises(BadInput, match=message):
        outputs(ATTITUDE, "ekf", [logged(samples)])


@pytest.mark.usefixtures("uncompiled")
def test_one_topic_may_drive_and_be_measured_as_several_topics_would_be():
    """The same samples on a topic of their own for every use give the same estimates, bit for bit."""
    samples = carried()[0].take(TIME_S < 6.0)
    uses = [dataclasses.replace(samples, topic=f"/hand/{name}") for name in ("velocity", "field")]
    of_samples = [sensor for sensor in ATTITUDE.sensors if sensor.topic == "inertial"]
    sensors = [
        dataclasses.replace(sensor, topic=use.topic.rpartition("/")[2])
        for sensor, use in zip(of_samples, uses, strict=True)
    ]
    apart = dataclasses.replace(ATTITUDE, sensors=(*sensors, ATTITUDE.sensors[-1]))
    one, several = (
        outputs(model, "ekf", [logged(*streams), logged(*streams)], block_messages=block)["state"]
        for model, streams, block in ((ATTITUDE, [samples], 100), (apart, [samples, *uses], 1 << 18))
    )
    np.testing.assert_array_equal(one.offsets, several.offsets)
    np.testing.assert_array_equal(one["mean"], several["mean"])
