"""The recorders `optical-los` and `acoustic-shots`: what their streams say, and what they refuse."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import line_of_sight
from fuselog.recorders.log import Stream
from fuselog.recorders.recording import Recording, record_run


def record(scenario: str, seed: int = 1, **parameters: object) -> Recording:
    return record_run(scenario, parameters, seed)[0]


def stream(recording: Recording, topic: str) -> Stream:
    [found] = [each for each in recording.streams if each.topic == topic]
    return found


def test_lines_of_sight_are_the_biased_model_plus_noise() -> None:
    """With next to no noise every message is what the biased sensor sees of that target."""
    bias = [(1.0, -2.0, 3.0)] * 3
    recording = record("optical-los", bias_deg=bias, sigma_rad=1e-9, passes=2)
    truth = stream(recording, "/truth")
    targets = truth["state"][0, :9].reshape(3, 3)
    sights = stream(recording, "/sensor2/line_of_sight")
    place = stream(recording, "/sensor2/position")["position_m"][0]
    assert sights["target_id"].tolist() == [1, 2, 3, 1, 2, 3]
    seen = line_of_sight(targets[sights["target_id"] - 1].T, place, np.radians(bias[1]))
    np.testing.assert_allclose(sights["azimuth_rad"], seen[0], atol=1e-8)
    np.testing.assert_allclose(sights["elevation_rad"], seen[1], atol=1e-8)
    assert truth.components[-1] == "sensor_3_roll_bias_rad"
    assert truth["state"][0, -1] == pytest.approx(np.radians(3.0))
    assert np.isin(sights.publish_time_ns, truth.publish_time_ns).all()


def test_nominal_attitude_goes_through_its_quaternion() -> None:
    """A nominal attitude and a bias of the same angles give the same angles in the sensor's frame."""
    turned = [(5.0, 10.0, -20.0)] * 3
    nominal = record("optical-los", nominal_attitude_deg=turned, bias_deg=None)
    biased = record("optical-los", bias_deg=turned)
    one, other = (stream(each, "/sensor1/line_of_sight") for each in (nominal, biased))
    np.testing.assert_array_equal(one["azimuth_rad"], other["azimuth_rad"])
    assert stream(nominal, "/sensor1/attitude")["quaternion"][0, 0] < 1.0
    for_all = stream(record("optical-los", bias_deg=turned[:1]), "/sensor1/line_of_sight")
    np.testing.assert_array_equal(for_all["azimuth_rad"], other["azimuth_rad"])


def test_sensors_are_turned_otherwise_than_stated_by_default() -> None:
    """So that the first view shows what the scenario is about."""
    truth = stream(record("optical-los"), "/truth")
    np.testing.assert_allclose(truth["state"][:, 9:], np.radians(1.0))


def test_field_of_view_and_a_target_on_a_sensor() -> None:
    """Sensor 2 of scenario 1 spans 68 deg: a narrow view loses targets; none is seen from inside."""
    assert len(stream(record("optical-los", passes=1), "/sensor2/line_of_sight")) == 3
    narrow = stream(record("optical-los", passes=1, field_of_view_deg=60.0), "/sensor2/line_of_sight")
    assert 0 < len(narrow) < 3
    on_sensor = [(-5500, 950, 15), (0, 8000, 0)]
    sights = stream(
        record("optical-los", passes=1, target_position_m=on_sensor), "/sensor1/line_of_sight"
    )
    assert sights["target_id"].tolist() == [2]


def test_shots_are_heard_when_the_sound_arrives() -> None:
    recording = record("acoustic-shots", shots=3)
    truth = stream(recording, "/shooter/truth")
    for sensor, hears in ((1, True), (2, False), (3, False), (4, True), (5, True)):
        heard = stream(recording, f"/sensor{sensor}/detections")
        fixes = stream(recording, f"/sensor{sensor}/position")
        place = truth["state"][0, 1 + 2 * sensor : 3 + 2 * sensor]
        delay_s = np.hypot(*(place - [50, 50])) / 342.0
        travelled = (heard.publish_time_ns - fixes.publish_time_ns) * 1e-9
        np.testing.assert_allclose(travelled, delay_s, atol=1e-8)
        assert heard["shot_id"].tolist() == [1, 2, 3]
        assert np.isfinite(heard["time_difference_s"]).all() == hears
        assert np.isin(heard.publish_time_ns, truth.publish_time_ns).all()


def test_noise_is_as_stated() -> None:
    """Deviations of 2000 shots and fixes, within 5 sigma of what the channel states."""
    recording = record("acoustic-shots", shots=2000)
    heard = stream(recording, "/sensor1/detections")
    for field, key in (
        ("muzzle_blast_azimuth_rad", "sigma_muzzle_blast_rad"),
        ("shockwave_azimuth_rad", "sigma_shockwave_rad"),
        ("time_difference_s", "sigma_time_difference_s"),
    ):
        assert heard[field].std() == pytest.approx(float(heard.metadata[key]), rel=0.08)
    fixes = stream(recording, "/sensor1/position")["position_m"]
    assert fixes.std(axis=0) == pytest.approx(2.0, rel=0.08)


@pytest.mark.parametrize(
    ("scenario", "parameters", "sentence"),
    [
        ("optical-los", {"bias_deg": [(1.0, 1.0, 1.0)] * 2}, "bias_deg has 2 rows for 3 sensors"),
        ("optical-los", {"sigma_rad": 0.0}, "sigma_rad"),
        ("acoustic-shots", {"interval_s": 0.1}, "give a longer interval_s"),
        ("acoustic-shots", {"mach_number": 1.0}, "mach_number"),
    ],
)
def test_what_cannot_be_recorded_is_refused(scenario: str, parameters: dict, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        record(scenario, **parameters)
