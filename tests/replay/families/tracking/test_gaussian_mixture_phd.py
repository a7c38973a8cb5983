"""The GM-PHD filter: one update by hand, how many there are, its outputs, blocks, and bad input."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.pipeline.runs.recorded import judge, replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, make_stream, schemas
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams import channels
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.families.sets.judging.errors import set_errors
from fuselog.replay.families.tracking.gaussian_mixture_phd import (
    PhdParameters,
    filter_scans,
    no_components,
    scans_of,
    settings_of,
)
from fuselog.replay.families.tracking.phd_recursion import Scans
from fuselog.replay.families.vehicles.streams import scanning_of
from fuselog.replay.judging.errors.truths import Truths
from tests.replay.families.tracking.scan_scenes import VARIANCE_M2, simulate, source

STATED = {"variance_m2": "0.5", "detection_probability": "0.9", "clutter_per_m2": "1e-3"}


def scan_of(stated):
    """A channel of scans that states something."""
    return Topic("/scan", schemas.SCAN.full_name, "protobuf", (), stated, 0)


PRIOR = np.array([[2.5, 0.3, 0.2, 0], [0.3, 1, 0, 0.1], [0.2, 0, 2, 0.4], [0, 0.1, 0.4, 1.5]])
SEEN = np.array([1, 0, 0, 0, 0, 0, 1, 0]).reshape(2, 4)


def one_target(second: float = 2.0):
    """A mixture of one component at time zero, and a scan of two detections, one far off."""
    mixture = no_components(1, 10)
    mixture.used[:], mixture.time_ns[:] = 1, 0
    mixture.weight[0, 0] = 0.8
    mixture.mean[0, 0] = (1.0, 2.0, -3.0, 0.5)
    mixture.covariance[0, 0] = PRIOR
    place = np.array([(5.5, -2.5), (500.0, 500.0)])
    one = np.array([0]), np.array([2])
    return mixture, Scans(np.array([0, 1]), np.array([int(second * 1e9)]), *one, place)


def test_one_update_of_one_target_by_hand():
    """Vo and Ma, table I, with matrices: weights, mean and covariance after 2 s, and a birth."""
    mixture, scans = one_target()
    parameters = PhdParameters(births_per_m2=1e-4, merge_squared=1e-9)
    after, sets = filter_scans(mixture, scans, settings_of(parameters, scan_of(STATED)))
    motion = np.kron(np.eye(2), [[1, 2], [0, 1]])
    noise = 0.25 * np.kron(np.eye(2), [[4.0, 4.0], [4.0, 4.0]])
    mean = motion @ mixture.mean[0, 0]
    predicted = motion @ PRIOR @ motion.T + noise
    innovation = scans.place[0] - SEEN @ mean
    spread = SEEN @ predicted @ SEEN.T + 0.5 * np.eye(2)
    gain = predicted @ SEEN.T @ np.linalg.inv(spread)
    squared = innovation @ np.linalg.solve(spread, innovation)
    density = np.exp(-0.5 * squared) / (2 * np.pi * np.sqrt(np.linalg.det(spread)))
    found, born = 0.9 * 0.99 * 0.8 * density, 0.9 * 1e-4
    total = 1e-3 + found + born
    expected = [
        (found / total, mean + gain @ innovation, predicted - gain @ SEEN @ predicted),
        (born / (1e-3 + born), [500, 0, 500, 0], np.diag([0.5, 4, 0.5, 4])),
        (0.1 * 0.99 * 0.8, mean, predicted),
        (born / total, [5.5, 0, -2.5, 0], np.diag([0.5, 4, 0.5, 4])),
    ]
    expected.sort(key=lambda each: -each[0])
    assert after.used[0] == 4
    for place, (weight, mean_of, covariance) in enumerate(expected):
        assert_allclose(after.weight[0, place], weight, rtol=0, atol=1e-12)
        assert_allclose(after.mean[0, place], mean_of, rtol=0, atol=1e-12)
        assert_allclose(after.covariance[0, place], covariance, rtol=0, atol=1e-12)
    assert_allclose(sets.expected[0], sum(each[0] for each in expected), atol=1e-12)
    assert sets.elements[0] == 1


def test_merging_keeps_weight_and_moments():
    """However much is merged, the mixture's weight, mean and covariance stay as they were."""

    def moments(merge_squared: float):
        mixture, scans = one_target()
        parameters = PhdParameters(births_per_m2=1e-4, merge_squared=merge_squared)
        after, _ = filter_scans(mixture, scans, settings_of(parameters, scan_of(STATED)))
        weight, mean = after.weight[0, : after.used[0]], after.mean[0, : after.used[0]]
        centre = weight @ mean / weight.sum()
        offset = mean - centre
        second = after.covariance[0, : after.used[0]] + offset[:, :, None] * offset[:, None, :]
        return after.used[0], weight.sum(), centre, np.tensordot(weight, second, 1)

    separate, *apart = moments(1e-9)
    merged, *together = moments(1e9)
    assert (separate, merged) == (4, 1)
    for before, after in zip(apart, together, strict=True):
        assert_allclose(after, before, rtol=1e-12)


def test_a_sensor_states_its_noise_as_sigma_or_variance_to_every_estimator() -> None:
    """One log serves all of its estimators; the old name of the setting is still accepted."""
    by_sigma = {**STATED, "sigma_m": str(0.5**0.5)}
    del by_sigma["variance_m2"]
    for stated in (STATED, by_sigma):
        assert settings_of(PhdParameters(), scan_of(stated)).variance_m2 == pytest.approx(0.5)
        assert scanning_of({"/scan": scan_of(stated)}, "/scan").variance_m2 == pytest.approx(0.5)
        assert channels.stated([scan_of(stated)], "sigma_m") == pytest.approx(0.5**0.5)
    assert settings_of(PhdParameters(sigma_m=3.0), scan_of(STATED)).variance_m2 == 9.0
    with pytest.warns(FutureWarning, match="'variance_m2' will be removed in the next release"):
        old = settings_of(PhdParameters(variance_m2=4.0), scan_of(STATED))
    assert old.variance_m2 == 4.0
    with pytest.raises(BadInput, match=r"topic /scan: parameter 'sigma_m' is -1\.0"):
        settings_of(PhdParameters(), scan_of({**by_sigma, "sigma_m": "-1"}))


def test_two_things_in_one_place_are_two():
    """Two components that merge into one of weight 2 are told as two elements."""
    mixture = no_components(1, 10)
    mixture.used[:], mixture.time_ns[:] = 2, 0
    mixture.weight[0, :2] = 1.0
    mixture.covariance[0, :2] = np.eye(4)
    place = np.array([(0.1, 0.0), (0.0, 0.1)])
    scans = Scans(np.array([0, 1]), np.array([0]), np.array([0]), np.array([2]), place)
    sure = {**STATED, "detection_probability": "1", "clutter_per_m2": "0"}
    parameters = PhdParameters(survival_probability=1.0, births_per_m2=0)
    after, sets = filter_scans(mixture, scans, settings_of(parameters, scan_of(sure)))
    assert after.used[0] == 1
    assert_allclose(after.weight[0, 0], 2.0, rtol=1e-12)
    assert sets.elements[0] == 2


def test_expected_number_and_gospa_over_runs():
    """The expected number is right within its scatter; few are missed or false for long."""
    sources = [source(simulate(seed)) for seed in range(40)]
    outputs = replay_in_memory(sources, {"gm-phd": {"acceleration_sigma_mps2": 0.2}})
    expected = outputs["/estimates/gm-phd/sensor/cardinality"]["mean"].reshape(40, -1)
    standard_error = expected.mean(axis=1).std() / np.sqrt(40)
    assert abs(expected.mean() - 5.0) < 3.0 * standard_error
    [found] = judge(sources, outputs, 0.2).others
    assert_array_equal(found.true, 5)
    # with a detection probability of .9 a thing that is missed for one scan is below one half
    assert found.missed.mean() / 50 < 0.7
    assert found.false.mean() / 50 < 0.1
    per_thing = found.localisation.mean() / (5 - found.missed.mean() / 50)
    assert per_thing < 2 * VARIANCE_M2


def test_without_priors_things_are_found():
    """Births alone find what there is: after ten scans no more is missed than with priors."""
    scene = simulate(1, clutter=1.0)
    whole = source(scene, clutter=1.0)
    streams = {name: each for name, each in whole.streams.items() if not name.endswith("prior")}
    bare = type(whole)(streams, whole.run, whole.name)
    outputs = replay_in_memory([bare], {"gm-phd": {"acceleration_sigma_mps2": 0.2}})
    [found] = set_errors(outputs, [Truths(bare)]).values()
    assert found.missed[10:].mean() / 50 < 0.8


def test_blocks_and_ensembles_change_nothing():
    """Scans handed over in two blocks, and three runs at once, give the same bits."""
    sources = [source(simulate(seed, scans=12 + seed)) for seed in range(3)]
    together = replay_in_memory(sources, {"gm-phd": {}})
    for run, each in enumerate(sources):
        alone = replay_in_memory([each], {"gm-phd": {}})
        for topic, ragged in alone.items():
            for name, column in ragged.stream.columns.items():
                assert_array_equal(column, together[topic].of_run(run)[name])
    scans = scans_of(
        *(gather([sources[0].streams[f"/sensor/{leaf}"]]) for leaf in ("scan", "detection"))
    )
    settings = settings_of(PhdParameters(), sources[0].topics["/sensor/scan"])
    whole, _ = filter_scans(no_components(1, 100), scans, settings)
    state = no_components(1, 100)
    for part in (slice(0, 5), slice(5, 12)):
        some = Scans(
            np.array([0, part.stop - part.start]), scans.time_ns[part], scans.first[part],
            scans.end[part], scans.place,
        )  # fmt: skip
        state, _ = filter_scans(state, some, settings)
    for before, after in zip(whole, state, strict=True):
        assert_array_equal(before, after)


def test_empty_scans_are_scans():
    """Without a detection for long, nothing is left, and that is told."""
    scene = simulate(3, scans=12, clutter=0.0)
    empty = scene._replace(scans=[np.empty((0, 2))] * 12)
    outputs = replay_in_memory([source(empty)], {"gm-phd": {}})
    assert outputs["/estimates/gm-phd/sensor/set"]["elements"].tolist() == [0] * 12
    expected = outputs["/estimates/gm-phd/sensor/cardinality"]["mean"][:, 0]
    assert_allclose(expected[0], 5 * 0.1 * 0.99, rtol=1e-12)
    assert expected[-1] < 1e-4


def test_one_sensor_of_several_can_be_chosen():
    """A sensor in a frame of its own, say, is left out by naming the other."""
    one = source(simulate(0, scans=3))
    other = {
        f"/radar{topic}": replace(stream, topic=f"/radar{topic}")
        for topic, stream in one.streams.items()
        if topic.startswith("/sensor")
    }
    both = type(one)({**one.streams, **other}, one.run, one.name)
    names = [each.name for each in bind("gm-phd", [both], {})]
    assert names == ["gm-phd/sensor", "gm-phd/radar/sensor"]
    assert [each.name for each in bind("gm-phd", [both], {"sensor": "sensor"})] == names[:1]


def test_bad_input_is_named():
    good = source(simulate(0, scans=3))
    scan = good.streams["/sensor/scan"]
    lost = {**good.streams, "/sensor/detection": good.streams["/sensor/detection"].take(slice(1, None))}
    with pytest.raises(BadInput, match="scan 0 states"):
        collect(replay([type(good)(lost, good.run, "x")], bind("gm-phd", [good], {})))
    with pytest.raises(BadInput, match="does not state variance_m2"):
        settings_of(PhdParameters(), scan_of({}))
    with pytest.raises(BadInput, match="'detection_probability' is 0"):
        settings_of(PhdParameters(), scan_of({**STATED, "detection_probability": "0"}))
    with pytest.raises(BadInput, match="priors exceed the limit of 2 components"):
        collect(replay([good], bind("gm-phd", [good], {"most_components": 2})))
    line = make_stream(
        "/sensor/detection", schemas.DETECTION, scan.publish_time_ns, scan_id=[0, 1, 2],
        position_m=np.zeros((3, 1)),
    )  # fmt: skip
    with pytest.raises(BadInput, match="two coordinates"):
        scans_of(gather([scan]), gather([line]))
