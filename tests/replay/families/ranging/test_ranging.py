"""Ranges between anchors and tags: the models, their start, robust updates, and the sheet's targets."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.recording import import_run, record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.ranging.model import (
    RANGING_POSE,
    RANGING_POSITION,
    PoseRangingParameters,
    RangingParameters,
    find_pose,
    find_position,
    see,
    see_by_tag,
)
from fuselog.replay.inference.linear_algebra.inflation import inflation
from fuselog.replay.inference.model.augmentation import augmented
from fuselog.replay.inference.model.checking import check_model
from fuselog.replay.inference.model.point_errors import PointError
from tests.replay.inference.replays import bound, outputs

# --- the models ------------------------------------------------------------------------------------


@pytest.mark.paper
def test_the_model_is_what_it_says_with_errors_in_its_state() -> None:
    """With a bias, and with the errors of anchors and of links."""
    errors = PointError("range_m", (1,)), PointError("range_m", (0, 2))
    check_model(augmented(RANGING_POSE, ("bias_range_m",), errors))


def test_a_range_is_that_of_the_tag_as_the_body_is_turned() -> None:
    parameters = SimpleNamespace(height_m=1.0, bias_range_m=0.2)
    pose = 2.0, 1.0, 0.5 * np.pi, 0.0, 0.0, 0.0
    # the tag, 1 m ahead and .5 m left, is at (1.5, 2, 1.1)
    (found,) = see_by_tag(pose, (1.5, 5.0, 5.1, 1.0, 0.5, 0.1), parameters)
    assert found == pytest.approx(5.2, abs=1e-12)
    (found,) = see((2.0, 1.0, 0.0, 0.0), (2.0, 4.0, 5.0), parameters)
    assert found == pytest.approx(5.2, abs=1e-12)


def recorded(seed: int = 1, **values: Any) -> MemorySource:
    """A log of the recorder `ranging`."""
    return memory_source(*record_run("ranging", values, seed))


def reference(source: MemorySource, sigma_m: float, time_s: float) -> tuple[Any, Any]:
    """The last mean and covariance of an extended filter with errors of anchors, written out."""
    streams = source.streams
    ranges, prior = streams["/trolley/ranges"], streams["/trolley/prior"]
    anchors, tags = (streams[name]["position_m"] for name in ("/anchors", "/tags"))
    stated = {name: float(value) for name, value in ranges.metadata.items()}
    n = 6 + len(anchors)
    x, p = np.zeros(n), sigma_m**2 * np.eye(n)
    x[:6], p[:6, :6] = prior["mean"][0], prior["covariance"][0].reshape(6, 6)
    densities = [stated["acceleration_density"]] * 2 + [stated["turn_acceleration_density"]]
    before_ns = prior.publish_time_ns[0]
    columns = ranges.publish_time_ns, ranges["anchor_id"], ranges["tag_id"], ranges["range_m"]
    for time_ns, anchor, tag, measured in zip(*columns, strict=True):
        dt, before_ns = (time_ns - before_ns) * 1e-9, time_ns
        transition, noise, kept = np.eye(n), np.zeros((n, n)), np.exp(-dt / time_s)
        for k, density in enumerate(densities):
            transition[k, k + 3] = dt
            block = density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            noise[np.ix_([k, k + 3], [k, k + 3])] = block
        transition[range(6, n), range(6, n)] = kept
        noise[range(6, n), range(6, n)] = (1 - kept**2) * sigma_m**2
        x, p = transition @ x, transition @ p @ transition.T + noise
        cosine, sine = np.cos(x[2]), np.sin(x[2])
        turned = np.array([[cosine, -sine], [sine, cosine]]) @ tags[tag, :2]
        away = np.append(x[:2] + turned, stated["height_m"] + tags[tag, 2]) - anchors[anchor]
        distance = np.linalg.norm(away)
        row = np.zeros(n)
        row[:2] = away[:2] / distance
        row[2] = (away[1] * turned[0] - away[0] * turned[1]) / distance
        row[6 + anchor] = 1.0
        gain = p @ row / (row @ p @ row + stated["sigma_range_m"] ** 2)
        x = x + gain * (measured - distance - 0.15 - x[6 + anchor])
        p = p - np.outer(gain, row @ p)
    return x, p


ANCHORS: dict[str, Any] = {
    "estimate": ["range_m[0:6]"],
    "estimate_sigma": {"range_m[0:6]": 0.1},
    "estimate_time_s": {"range_m[0:6]": 5.0},
}


@pytest.mark.usefixtures("uncompiled")
def test_errors_that_last_are_a_gauss_markov_process_of_each_anchor() -> None:
    source = recorded(duration_s=1.0, bias_range_m=0.15, error_sigma_m=0.1)
    found = outputs(RANGING_POSE, "ekf", [source], bias_range_m=0.15, **ANCHORS)["state"].stream
    assert found.components[6:] == [f"error_range_m_{anchor}" for anchor in range(6)]
    mean, covariance = reference(source, 0.1, 5.0)
    assert_allclose(found["mean"][-1], mean, atol=1e-10)
    assert_allclose(found["covariance"][-1].reshape(12, 12), covariance, atol=1e-12)


BAD: list[tuple[dict[str, Any], str]] = [
    (
        {"estimate": ["range_m[0:3,0,1]"]},
        "a second map; this model measures range_m about the points of 2",
    ),
    ({"estimate": ["range_m[3:3]"]}, "expected NUMBER or FIRST:END in the brackets"),
    ({"estimate": ["bearing_rad[0]"]}, "measures bearing_rad about the points of 0 maps"),
    ({"estimate": ["range_m[0]"]}, r"estimate_sigma.range_m\[0\]="),
    ({**ANCHORS, "estimate": ["range_m[0:6]", "range_m[2]"]}, r"the parameter is named twice"),
    (
        {"estimate_time_s": {"bias_range_m": 1.0}},
        "estimate_time_s.bias_range_m: bias_range_m is not in",
    ),
]


@pytest.mark.parametrize(("values", "sentence"), BAD)
def test_what_cannot_be_estimated_is_said(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        bound(RANGING_POSE, "ekf", [recorded(duration_s=0.2)], **values)


# --- robust updates --------------------------------------------------------------------------------


def one_range(range_m: float) -> MemorySource:
    """A prior of 1 m about the origin, and one range of an anchor that is 10 m away."""
    names = {"components": "x_m,y_m,vx_mps,vy_mps", "kinds": "linear,linear,linear,linear"}
    streams = [
        make_stream("/anchors", schemas.LANDMARK, [0], landmark_id=[7], position_m=[[10.0, 0.0, 1.0]]),
        make_stream(
            "/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [0],
            metadata=names,
            mean=np.zeros((1, 4)),
            covariance=np.eye(4).reshape(1, 16),
        ),
        make_stream("/ranges", schemas.ANCHOR_RANGE, [0], anchor_id=[7], tag_id=[0], range_m=[range_m]),
    ]
    return MemorySource({each.topic: each for each in streams}, RunMetadata("one range"), "one range")


NUMBERS = {"height_m": 1.0, "sigma_range_m": 1.0, "acceleration_density": 0.0}
ROBUST = [("inflate_nis", 9.0, 2.0), ("student_freedom", 3.0, 21.0 / 4.0), ("switch_nis", 6.0, 4.0)]


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("method", ["ekf", "iekf", "lrkf", "smoother"])
@pytest.mark.parametrize(("option", "value", "factor"), ROBUST)
def test_an_innovation_of_nis_18_counts_with_a_larger_covariance(
    method: str, option: str, value: float, factor: float
) -> None:
    """S is 2, so that a range 6 m too short has the NIS 18; the noise becomes factor * S - 1."""
    found = outputs(RANGING_POSITION, method, [one_range(4.0)], **NUMBERS, **{option: value})
    state, innovation = found["state"].stream, found["innovation"].stream
    spread = 2.0 * factor
    if method == "lrkf":  # whose samples see that a range is no straight line
        assert state["mean"][0, 0] == pytest.approx(6.0 / spread, rel=0.1)
    else:
        assert state["mean"][0, 0] == pytest.approx(6.0 / spread, rel=1e-9)
        assert state["covariance"][0, 0] == pytest.approx(1.0 - 1.0 / spread, rel=1e-9)
        assert innovation["normalised_innovation_squared"][0] == pytest.approx(18.0, rel=1e-9)
        likelihood = -0.5 * (36.0 / spread + np.log(2.0 * np.pi * spread))
        assert innovation["log_likelihood"][0] == pytest.approx(likelihood, rel=1e-9)
    plain = outputs(RANGING_POSITION, method, [one_range(4.0)], **NUMBERS)["state"].stream
    assert state["mean"][0, 0] < 0.7 * plain["mean"][0, 0]
    near = [
        outputs(RANGING_POSITION, method, [one_range(9.5)], **NUMBERS, **given)["state"]["mean"]
        for given in ({}, {option: value})
    ]
    assert_allclose(*near, rtol=0.0 if option != "student_freedom" else 0.05)


def test_the_largest_of_several_options_holds_and_none_makes_noise_smaller() -> None:
    given = SimpleNamespace(inflate_nis=9.0, student_freedom=3.0, switch_nis=np.nan)
    assert inflation(18.0, 1, given) == pytest.approx(21.0 / 4.0)
    assert inflation(0.0, 1, given) == 1.0


# --- the start -------------------------------------------------------------------------------------


def maps(source: MemorySource) -> dict[str, Stream]:
    """What `Start.find` is handed."""
    streams = source.streams
    return {
        "/anchors": streams["/anchors"],
        "/tags": streams["/tags"],
        "ranges": streams["/trolley/ranges"],
    }


FOUND = {"sigma_range_m": 0.05, "height_m": 1.0}


@pytest.mark.paper
def test_a_pose_is_found_in_the_first_ranges_whatever_its_heading() -> None:
    for seed in range(4):
        source = recorded(seed, duration_s=0.1, start_sigma_m=4.0, start_sigma_rad=2.0)
        started = find_pose(maps(source), PoseRangingParameters(**FOUND))
        error = started.mean[:3] - source.streams["/trolley/truth"]["state"][0, :3]
        assert np.hypot(*error[:2]) < 0.15
        assert abs((error[2] + np.pi) % (2 * np.pi) - np.pi) < 0.3
        assert started.time_ns == source.streams["/trolley/ranges"].publish_time_ns[0]


def test_a_start_that_ranges_do_not_tell_is_refused_with_what_is_needed() -> None:
    source = recorded(duration_s=5.0, anchors_m=[[0, 5, 2], [5, 0, 2]])
    with pytest.raises(BadInput, match=r"/trolley/ranges: no span of 1 s has ranges of 3 pairs"):
        find_position(maps(source), RangingParameters(**FOUND))


@pytest.mark.usefixtures("uncompiled")
def test_a_log_without_a_prior_begins_where_its_ranges_fit_best() -> None:
    source = recorded(duration_s=1.0)
    streams = {name: each for name, each in source.streams.items() if name != "/trolley/prior"}
    found = outputs(RANGING_POSE, "ekf", [MemorySource(streams, source.run, "no prior")])
    error = found["state"]["mean"][-1, :2] - source.streams["/trolley/truth"]["state"][-1, :2]
    assert np.hypot(*error) < 0.1
    assert any(
        "at the best fit to its first ranges" in text
        for text in found["started"].stream.metadata.values()
    )


# --- the warehouse ---------------------------------------------------------------------------------

POSE = {"kind": "ekf", "model": "ranging-pose"}


def test_errors_that_last_are_as_large_and_last_as_long_as_stated() -> None:
    """From seed to seed the deviation scatters by 1.4 %, the correlation over a second by .022."""
    rate_hz, sigma_m = 4, 2.0
    stated = {"error_sigma_m": sigma_m, "error_time_s": 1.0, "sigma_range_m": 1e-3}
    log = fl.record(
        "ranging", seed=5, duration_s=400.0, rate_hz=rate_hz, tags_m=[[0, 0, 0]], height_m=0.0, **stated
    )
    places = np.pad(log["/trolley/truth"]["state"][:, :2], ((0, 0), (0, 1)))
    true = np.linalg.norm(places[:, None] - log["/anchors"]["position_m"], axis=2)
    error = log["/trolley/ranges"]["range_m"].reshape(true.shape) - true
    assert error.std() == pytest.approx(sigma_m, rel=0.08)
    lasting = (error[rate_hz:] * error[:-rate_hz]).mean() / sigma_m**2
    assert lasting == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.paper
def test_nees_is_what_it_should_be_where_errors_that_last_are_modelled() -> None:
    """And above 30 where they are taken for white noise; blocked lines need a robust update."""
    logs = [
        fl.record("ranging", seed=5, run=run, duration_s=30.0, error_sigma_m=0.1) for run in range(20)
    ]
    replay = fl.replay(logs, [{"white": POSE, "lasting": {**POSE, **ANCHORS}}])
    found = replay.metrics.pivot(index="quantity", columns="estimator", values="value")
    assert 5.0 < found.loc["nees", "lasting"] < 7.0
    assert found.loc["nees", "white"] > 30.0
    assert found.loc["position_rmse_m", "lasting"] < found.loc["position_rmse_m", "white"]
    blocked = [fl.record("warehouse-uwb", seed=5, run=run, duration_s=30.0) for run in range(10)]
    biased = {**POSE, **ANCHORS, "bias_range_m": 0.15}
    replay = fl.replay(blocked, [{"lasting": biased, "robust": {**biased, "inflate_nis": 9.0}}])
    found = replay.metrics.pivot(index="quantity", columns="estimator", values="value")
    assert found.loc["position_rmse_m", "robust"] < 0.6 * found.loc["position_rmse_m", "lasting"]


# --- the sheet's likelihood ------------------------------------------------------------------------


def every_tenth_row(folder: Path) -> MemorySource:
    """The recording of lias with the rows 0, 10, 20, ... of its ranges."""
    source = memory_source(*import_run("table", folder / "uwb_lias", {"mapping": "uwb-lias"}))
    ranges = source.streams["/ranges"]
    _, row = np.unique(ranges.publish_time_ns, return_inverse=True)
    return MemorySource(
        {**source.streams, "/ranges": ranges.take(np.flatnonzero(row % 10 == 0))}, source.run, "tenth"
    )


def found_prior(source: MemorySource, parameters: PoseRangingParameters) -> Stream:
    """Where the first ranges fit best, as a topic: finding it takes as long as a replay."""
    streams = source.streams
    started = find_pose({**streams, "ranges": streams["/ranges"]}, parameters)
    return make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [started.time_ns],
        metadata={
            "components": ",".join(RANGING_POSE.state),
            "kinds": ",".join(RANGING_POSE.state.values()),
        },
        mean=started.mean[None],
        covariance=started.covariance.reshape(1, -1),
    )


LIKELIEST = {
    "sigma_range_m": 0.0757,
    "bias_range_m": 0.1714,
    "acceleration_density": 0.037,
    "turn_acceleration_density": 0.068,
}


@pytest.mark.paper
def test_the_likelihood_of_innovations_is_largest_where_the_sheet_says(
    navigation: Path, tmp_path: Path
) -> None:
    """Common noise and bias of ranges: .0763 m and .1714 m, and 33550; all four: .0757 m, 35450."""
    source = every_tenth_row(navigation)
    fl.write(tmp_path / "tenth.mcap", list(source.streams.values()))
    begin = {
        "model": "ranging-pose",
        "height_m": 0.9675,
        "acceleration_density": 1.0,
        "turn_acceleration_density": 2.0,
        "sigma_range_m": 0.1,
        "bias_range_m": 0.1,
    }
    tuned = fl.tune(tmp_path / "tenth.mcap", "ekf", ["sigma_range_m", "bias_range_m"], set=begin)
    found = tuned.parameters.set_index("parameter")["value"]
    assert found["sigma_range_m"] == pytest.approx(0.0763, abs=0.002)
    assert found["bias_range_m"] == pytest.approx(0.1714, abs=0.002)
    assert -tuned.costs[1] == pytest.approx(33550, abs=5)

    likeliest = {**LIKELIEST, "height_m": 0.9675}
    prior = found_prior(source, PoseRangingParameters(**likeliest))
    begun = MemorySource({**source.streams, prior.topic: prior}, source.run, "with a prior")

    def likelihood(**values: float) -> float:
        found = outputs(RANGING_POSE, "ekf", [begun], **{**likeliest, **values})
        return float(found["innovation"]["log_likelihood"].sum())

    largest = likelihood()
    assert largest == pytest.approx(35450, abs=10)
    for name, value in LIKELIEST.items():
        for factor in (0.9, 1.1):
            assert likelihood(**{name: value * factor}) < largest, (name, factor)
