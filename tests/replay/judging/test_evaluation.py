"""Alignment with truth, errors, NEES and NIS: known answers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import (
    RunMetadata,
    Stream,
    make_stream,
    open_log,
    read_streams,
    schemas,
    write_log,
)
from fuselog.recorders.log.streams import empty_stream
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import Findings, Ragged, gather
from fuselog.replay.engine.streams.priors import priors_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.engine.vectors.tangent import states_at, states_of_runs, truth_at
from fuselog.replay.judging.errors.alignment import Alignment, aligned_estimates
from fuselog.replay.judging.errors.evaluation import (
    chi_square_interval,
    components_without_truth,
    errors_of,
    innovations_of,
)
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.metrics import ACCURACY, CONSISTENCY, INNOVATION, LIKELIHOOD
from fuselog.replay.judging.tables import error_table

SECOND = 1_000_000_000
POSE = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}


def truth(times_s: list[float], states: list[list[float]], **metadata: str) -> Stream:
    stamps = (np.array(times_s) * SECOND).astype(np.int64)
    state = np.reshape(np.array(states, float), (len(times_s), -1 if times_s else 3))
    return make_stream("/truth", schemas.TRUTH_STATE, stamps, metadata={**POSE, **metadata}, state=state)


def estimates(
    times_s: list[float], means: list[list[float]], covariance: NDArray, **metadata: str
) -> Stream:
    """Estimates of one covariance."""
    return make_stream(
        "/estimates/ekf/robot1/pose",
        schemas.GAUSSIAN_ESTIMATE,
        (np.array(times_s) * SECOND).astype(np.int64),
        metadata={**POSE, "truth": "/truth", **metadata},
        mean=np.reshape(means, (len(times_s), -1)),
        covariance=np.tile(np.ravel(covariance), (len(times_s), 1)),
    )


def source(stream: Stream, epoch_ns: int = 0) -> MemorySource:
    return memory_source(Recording([stream]), RunMetadata("test", epoch_ns=epoch_ns))


# Truth at the estimates' stamps.


def at(stream: Stream, times_s: list[float], gap_limit_s: float = 10.0) -> NDArray:
    stamps = np.rint(np.array(times_s) * SECOND).astype(np.int64)
    return truth_at(stream, stamps, ["linear", "linear", "angle"], gap_limit_s)


def test_angles_are_interpolated_the_short_way_round():
    """From 3.1 to -3.1 rad through the back: half way is pi, not zero."""
    path = truth([0, 2], [[0, 1, 3.1], [4, 1, -3.1]])
    x, y, heading = at(path, [1.0])[0]
    assert (x, y) == (2.0, 1.0)
    assert_allclose(np.exp(1j * heading), -1)
    assert_allclose(np.exp(1j * at(path, [0.5])[0, 2]), np.exp(1j * (3.1 + (np.pi - 3.1) / 2)))


def test_truth_is_not_interpolated_over_gaps_nor_beyond_its_ends():
    path = truth([1, 2, 2.5, 4], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    found = at(path, [0.999, 1.0, 1.5, 2.25, 3.0, 4.0, 4.001], gap_limit_s=1.0)[:, 0]
    assert_array_equal(found, [np.nan, 0, 0.5, 1.5, np.nan, 3, np.nan])


def test_an_exact_stamp_needs_no_neighbour():
    """Even a single truth in the middle of nowhere serves the estimate of its own stamp."""
    assert_array_equal(at(truth([5], [[1, 2, 3]]), [4, 5, 6], 0.2)[:, 0], [np.nan, 1, np.nan])
    islands = truth([0, 100, 200], [[0, 0, 0], [7, 7, 0], [9, 9, 0]])
    assert_array_equal(at(islands, [100], 0.2)[0], [7, 7, 0])


def test_empty_truth_is_unknown_everywhere():
    """As a log gives it back: its vectors have no width."""
    none = empty_stream("/truth", schemas.TRUTH_STATE, POSE)
    assert np.isnan(at(none, [1.0, 2.0])).all()
    errors = errors_of(gather([estimates([1], [[0, 0, 0]], np.eye(3))]), [*map(Truths, [source(none)])])
    assert errors is not None
    assert errors.without_truth == 1
    assert len(errors.nees) == 0


def test_equal_stamps_in_the_truth_divide_nothing_by_zero():
    path = truth([0, 1, 1, 2], [[0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]])
    assert_array_equal(at(path, [0.5, 1.0, 1.5])[:, 0], [0.5, 1.0, 3.5])


@given(st.lists(st.integers(0, 1000), min_size=2, max_size=30, unique=True), st.integers(1, 300))
def test_truth_at_agrees_with_numpy_where_it_answers(stamps: list[int], limit: int):
    """For any schedule: linear interpolation within spans of at most the limit, silence elsewhere."""
    stamps = sorted(stamps)
    values = np.cumsum(np.sin(stamps))
    stream = make_stream(
        "/truth", schemas.TRUTH_STATE, np.array(stamps) * 1_000_000, state=values[:, None]
    )
    asked = np.arange(-5, 1006)
    found = truth_at(stream, asked * 1_000_000, ["linear"], limit * 1e-3)[:, 0]
    after = np.searchsorted(stamps, asked)
    inside = (after > 0) & (after < len(stamps))
    span = np.diff(stamps)[after.clip(1, len(stamps) - 1) - 1]
    answered = (inside & (span <= limit)) | np.isin(asked, stamps)
    assert_array_equal(np.isfinite(found), answered)
    assert_allclose(found[answered], np.interp(asked[answered], stamps, values), atol=1e-9)


@settings(max_examples=40)
@given(st.data())
def test_runs_together_have_the_truths_of_each_alone(data: st.DataObject):
    """Whatever the order of the stamps, and for runs without truth or without stamps."""
    draw = data.draw
    truths = [np.array(sorted(draw(st.lists(st.integers(0, 50), max_size=8))), int) for _ in range(4)]
    known = [(times, np.sin([times, times + 1.0]).T * 3.0) for times in truths]
    asked = [np.array(draw(st.lists(st.integers(-5, 55), max_size=8)), int) for _ in known]
    kinds, limit_s = ["linear", "angle"], 9e-9
    offsets = np.cumsum([0, *map(len, asked)])
    found = states_of_runs(known, np.concatenate(asked), offsets, kinds, limit_s)
    alone = [states_at(*own, at, kinds, limit_s) for own, at in zip(known, asked, strict=True)]
    assert_array_equal(found, np.concatenate(alone))


# Errors and NEES.


def test_estimators_of_the_same_stamps_share_the_true_states() -> None:
    """Other stamps, and the same stamps in other runs, have their own true states."""
    paths = [truth([0, 2], [[0, 0, 0], [end, 4, 1]]) for end in (2, 8)]
    truths, shared = [Truths(source(path)) for path in paths], Findings(1)

    def found(*times_s: list[float]) -> object:
        rows = gather([estimates(each, np.ones((len(each), 3)), np.eye(3)) for each in times_s])
        alone, errors = (errors_of(rows, truths, 9.0, shared=each) for each in (None, shared))
        assert alone is not None
        assert errors is not None
        assert_array_equal(errors.error, alone.error)
        return next(iter(shared.values()))

    first = found([0.5], [1.0, 1.5])
    assert found([0.5], [1.0, 1.5]) is first
    assert found([0.5, 1.0], [1.5]) is not first
    assert found([0.5], [1.0, 1.6]) is not first


def test_errors_of_a_known_case():
    """Errors wrapped, NEES e' P^-1 e, steps counted per run, time since the run's epoch."""
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.01]])
    still = truth([10, 20], [[1, 2, 3.1], [1, 2, 3.1]])
    first = estimates([10, 15], [[2, 2, -3.1], [1, 4, 3.1]], covariance)
    second = estimates([12], [[1, 2, 3.2]], covariance)
    sources = [source(still, epoch_ns=10 * SECOND), source(still)]
    errors = errors_of(gather([first, second]), [*map(Truths, sources)], gap_limit_s=20)
    assert errors is not None
    assert (errors.estimator, errors.case) == ("ekf", "robot1")
    turn = 2 * np.pi - 6.2
    assert_allclose(errors.error, [[1, 0, turn], [0, 2, 0], [0, 0, 0.1]], atol=1e-12)
    assert_allclose(errors.nees, [2 / 7 + turn**2 / 0.01, 16 / 7, 1], atol=1e-9)
    assert_array_equal(errors.run, [0, 0, 1])
    assert_array_equal(errors.step, [0, 1, 0])
    assert_allclose(errors.elapsed_s, [0, 5, 12])
    expected = {
        "estimates_without_truth": 0,
        "position_rmse_m": np.sqrt(5 / 3),
        "heading_rmse_rad": np.sqrt((turn**2 + 0.01) / 3),
    }
    assert ACCURACY.of(errors) == pytest.approx(expected)
    assert CONSISTENCY.of(errors)["position_nees"] == pytest.approx((2 / 7 + 16 / 7) / 3)


def test_estimates_without_truth_are_counted_not_judged():
    gappy = truth([0, 1, 5], [[0, 0, 0], [0, 0, 0], [0, 0, 0]])
    stream = gather([estimates([0.5, 3, 5, 6], [[1, 0, 0]] * 4, np.eye(3))])
    errors = errors_of(stream, [*map(Truths, [source(gappy)])], gap_limit_s=1)
    assert errors is not None
    assert errors.without_truth == 2
    assert_array_equal(errors.step, [0, 2])
    assert ACCURACY.of(errors)["position_rmse_m"] == 1


def test_without_truth_or_with_that_of_something_else_nothing_is_judged():
    stream = gather([estimates([1], [[0, 0, 0]], np.eye(3))])
    elsewhere = source(replace(truth([1], [[0, 0, 0]]), topic="/other"))
    assert errors_of(stream, [*map(Truths, [elsewhere])]) is None
    nothing = truth([1], [[0, 0, 0]], components="a,b,heading_deg")
    assert errors_of(stream, [*map(Truths, [source(nothing)])]) is None
    assert components_without_truth(stream, [source(nothing)]) == ("x_m", "y_m", "heading_rad")
    turned = truth([1], [[0, 0, 0]], kinds="linear,angle,angle")
    with pytest.raises(BadInput, match="component y_m has the kind angle; the kind must be linear"):
        errors_of(stream, [*map(Truths, [source(turned)])])
    nameless = gather([estimates([1], [[0, 0, 0]], np.eye(3), kinds="linear,linear,quaternions")])
    with pytest.raises(BadInput, match="must name components and, for each, one of"):
        errors_of(nameless, [*map(Truths, [source(truth([1], [[0, 0, 0]]))])])


def test_components_are_matched_by_name():
    """The truth may have more components, in another order."""
    mixed = truth(
        [1],
        [[9, 3, 1, 2]],
        components="speed_mps,heading_rad,x_m,y_m",
        kinds="linear,angle,linear,linear",
    )
    errors = errors_of(gather([estimates([1], [[1, 2, 3]], np.eye(3))]), [*map(Truths, [source(mixed)])])
    assert errors is not None
    assert_array_equal(errors.error, [[0, 0, 0]])


def test_a_component_without_truth_is_left_out_of_errors_and_nees():
    """The common ones are judged by their block of the covariance, whatever the others say."""
    covariance = np.array([[2.0, 0.5, 0.9], [0.5, 3.0, 0.2], [0.9, 0.2, 0.01]])
    stream = gather([estimates([1], [[2, 9, 1]], covariance)])
    place = truth([1], [[7, 1]], components="y_m,x_m", kinds="linear,linear")
    errors = errors_of(stream, [*map(Truths, [source(place)])])
    assert errors is not None
    assert errors.components == ("x_m", "y_m")
    assert (
        errors.components_without_truth
        == components_without_truth(stream, [source(place)])
        == ("heading_rad",)
    )
    assert_array_equal(errors.error, [[1, 2]])
    assert_array_equal(errors.covariance, [covariance[:2, :2]])
    expected = np.array([1, 2]) @ np.linalg.inv(covariance[:2, :2]) @ [1, 2]
    assert_allclose(errors.nees, expected, rtol=1e-12)
    judged = ACCURACY.of(errors)
    assert np.isnan(judged.pop("heading_rmse_rad"))
    assert judged == pytest.approx({"position_rmse_m": np.sqrt(5), "estimates_without_truth": 0})


def test_an_orientation_keeps_its_block_where_other_components_are_left_out():
    """Three of the tangent space for its four components; the truth has another order and more."""
    own = {f"orientation_{each}": "quaternion" for each in "wxyz"}
    kinds = {"x_m": "linear", **own, "y_m": "linear", "v_mps": "linear"}
    root = np.random.default_rng(2).normal(size=(6, 6))
    covariance = root @ root.T
    turned = np.array([0.02, -0.03, 0.05])
    mean = [1, *Rotation.from_rotvec(turned).as_quat(scalar_first=True), 9, 4]
    stated = {"components": ",".join(kinds), "kinds": ",".join(kinds.values())}
    stream = gather([estimates([1], [mean], covariance, **stated)])
    known = {"v_mps": "linear", **own, "w_mps": "linear", "x_m": "linear"}
    stated = {"components": ",".join(known), "kinds": ",".join(known.values())}
    errors = errors_of(stream, [Truths(source(truth([1], [[2, 1, 0, 0, 0, 9, 3]], **stated)))])
    assert errors is not None
    kept = [0, 1, 2, 3, 5]  # x, the orientation, v
    error = np.array([-2, *turned, 2])
    assert_allclose(errors.error, [error], atol=1e-12)
    assert_array_equal(errors.covariance, [covariance[kept][:, kept]])
    assert_allclose(errors.nees, error @ np.linalg.solve(covariance[kept][:, kept], error), rtol=1e-9)


def test_rotation_covariances_about_the_axes_of_the_world():
    """As ROS states them: the same numbers as about those of the body, aligned and as a prior too."""
    own = {f"orientation_{each}": "quaternion" for each in "wxyz"}
    kinds = {"v_mps": "linear", "x_m": "linear", "y_m": "linear", "z_m": "linear", **own}
    stated = {"components": ",".join(kinds), "kinds": ",".join(kinds.values())}
    body = Rotation.from_rotvec([0.9, -1.1, 0.4])
    root = np.random.default_rng(2).normal(size=(7, 7))
    own_covariance = root @ root.T
    turn = np.eye(7)
    turn[4:, 4:] = body.as_matrix()
    mean = [4, 1, 2, 3, *body.as_quat(scalar_first=True)]
    in_body = estimates([1], [mean], own_covariance, **stated)
    in_world = estimates([1], [mean], turn @ own_covariance @ turn.T, **stated, rotation_axes="world")
    move = Alignment(Rotation.from_rotvec([0.1, 0.7, -0.4]).as_matrix(), np.arange(3.0))
    true = [Truths(source(truth([1], [[3, 1, 1, 1, 1, 0, 0, 0]], **stated)))]
    for change in (lambda stream: stream, lambda stream: aligned_estimates(stream, move)):
        first, second = (errors_of(gather([change(each)]), true) for each in (in_body, in_world))
        assert first is not None
        assert second is not None
        assert_allclose(second.covariance, first.covariance, atol=1e-12)
        assert_allclose(second.nees, first.nees, rtol=1e-9)
    wanted = {name: kinds[name] for name in (*own, "v_mps")}
    first, second = (priors_of(gather([each]), wanted).covariance for each in (in_body, in_world))
    assert_allclose(second, first, atol=1e-12)
    wrong = estimates([1], [mean], own_covariance, **stated, rotation_axes="map")
    with pytest.raises(BadInput, match="rotation_axes = map; state body or world"):
        errors_of(gather([wrong]), true)


def test_of_an_ensemble_only_what_all_truths_have_is_judged():
    stream = estimates([1], [[2, 9, 1]], np.eye(3))
    whole = truth([1], [[0, 0, 0]])
    partial = truth([1], [[7, 1]], components="y_m,x_m", kinds="linear,linear")
    errors = errors_of(gather([stream, stream]), [*map(Truths, [source(whole), source(partial)])])
    assert errors is not None
    assert_array_equal(errors.error, [[2, 9], [1, 2]])
    other = make_stream("/else", schemas.TRUTH_STATE, [SECOND], metadata=POSE, state=[[0, 0, 0]])
    both = [source(whole), source(other)]
    assert errors_of(gather([stream, stream]), [*map(Truths, both)]) is None


def test_a_step_has_the_means_of_every_quantity_over_the_runs():
    """Of a body's place, orientation and range, against sums written out; all errors differ."""
    kinds = {"x_m": "linear", "y_m": "linear"} | {f"orientation_{each}": "quaternion" for each in "wxyz"}
    kinds["range_m"] = "linear"
    stated = {"components": ",".join(kinds), "kinds": ",".join(kinds.values())}
    truth_of_it = truth([0, 1, 2], [[0, 0, 1, 0, 0, 0, 0]] * 3, **stated)
    half = 0.5 * np.array([[0.1, 0.3], [0.2, 0.5]])
    off = np.array([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], [[7.0, 8.0, 9.0], [10.0, 11.0, 12.0]]])
    parts = [
        estimates(
            [1, 2],
            [
                [
                    *off[run, step, :2],
                    np.cos(half[run, step]),
                    np.sin(half[run, step]),
                    0,
                    0,
                    off[run, step, 2],
                ]
                for step in range(2)
            ],
            np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
            **stated,
        )
        for run in range(2)
    ]
    judge = Judge([source(truth_of_it)] * 2, gap_limit_s=10.0)
    judge.add({parts[0].topic: gather(parts)})
    [table] = judge.steps.values()
    square = np.mean(off**2, axis=0)
    angle = np.mean((2.0 * half) ** 2, axis=0)
    wanted = {
        "position_rmse_m": square[:, 0] + square[:, 1],
        "rmse_x_m": square[:, 0],
        "rmse_y_m": square[:, 1],
        "rmse_range_m": square[:, 2],
        "orientation_rmse_deg": np.degrees(np.degrees(angle)),
        "nees": square @ [1.0, 0.5, 1.0 / 6.0] + angle / 3.0,
    }
    for column, value in wanted.items():
        found = table[column] if column == "nees" else table[column] ** 2
        assert_allclose(found, value, err_msg=column)


def test_an_orientation_is_judged_whole_or_not_at_all():
    """Three of a quaternion's four components are none; what stands after it keeps its variance."""
    body = {
        "components": "q_w,q_x,q_y,q_z,x_m",
        "kinds": "quaternion,quaternion,quaternion,quaternion,linear",
    }
    stream = gather([estimates([1], [[1, 0, 0, 0, 5]], np.diag([1, 2, 3, 4.0]), **body)])
    partial = truth(
        [1], [[0, 0, 0, 3]], components="q_x,q_y,q_z,x_m", kinds="linear,linear,linear,linear"
    )
    errors = errors_of(stream, [*map(Truths, [source(partial)])])
    assert errors is not None
    assert errors.components_without_truth == ("q_w", "q_x", "q_y", "q_z")
    assert_array_equal(errors.covariance, [[[4]]])
    assert_array_equal(errors.nees, [1])


def test_an_indefinite_position_block_counts_for_nothing():
    """Of three estimates one has a covariance of the position that is none: the others are the mean."""
    good, bad = np.diag([4.0, 1.0, 0.01]), np.array([[1, 2, 0], [2, 1, 0], [0, 0, 0.01]])
    stream = estimates([1, 2, 3], [[2, 0, 0], [2, 2, 0], [0, 3, 0]], good)
    stream.columns["covariance"][1] = bad.ravel()
    errors = errors_of(gather([stream]), [*map(Truths, [source(truth([1, 2, 3], [[0, 0, 0]] * 3))])])
    assert errors is not None
    assert CONSISTENCY.of(errors)["position_nees"] == pytest.approx((1 + 9) / 2)
    assert np.isnan(errors.nees[1])


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_normalized_error_squared_is_the_quadratic_form(size: int, seed: int):
    generator = np.random.default_rng(seed)
    roots = generator.normal(size=(20, size, size)) + 3 * np.eye(size)
    covariance, error = roots @ roots.transpose(0, 2, 1), generator.normal(size=(20, size))
    expected = [e @ np.linalg.inv(p) @ e for e, p in zip(error, covariance, strict=True)]
    assert_allclose(normalized_error_squared(error, covariance), expected, rtol=1e-6)


@pytest.mark.parametrize("size", [1, 7, 8, 9, 16, 23])
def test_nees_sums_its_squares_in_the_order_of_numpy(size: int):
    """Results keep their bytes: with unit covariances, nothing but the sum rounds."""
    error = np.random.default_rng(size).normal(size=(50, size))
    assert_array_equal(normalized_error_squared(error, np.eye(size)), np.sum(error**2, axis=1))


def test_covariances_that_are_none_give_nan_alone():
    """Singular, indefinite or NaN, and none at all where all is unknown: the others are not touched."""
    eye = np.eye(2)
    odd = [
        eye,
        np.zeros((2, 2)),
        np.array([[1, 2], [2, 1]]),
        -eye,
        np.inf * np.ones((2, 2)),
        np.nan * eye,
    ]
    found = normalized_error_squared(np.ones((7, 2)), np.array([*odd, 0.5 * eye]))
    assert_allclose(found, [2, *[np.nan] * 3, 0, np.nan, 4], rtol=1e-15)


# Intervals, tables, innovations.


def test_chi_square_intervals_of_the_books():
    """100 runs: Bar-Shalom 5.4.2 has [1.627, 2.411] for two; 18 components have [16.843, 19.195]."""
    assert_allclose(chi_square_interval(2, 100), [1.627, 2.411], atol=1e-3)
    assert_allclose(chi_square_interval(18, 100), [16.843, 19.195], atol=1e-3)
    assert_allclose(chi_square_interval(3, 1, 0.9), chi2.ppf([0.05, 0.95], 3))


def ensemble(runs: int, steps: int, seed: int) -> tuple[Ragged, list[Truths]]:
    """Estimates whose errors are Gaussian with the covariance that they state; run 0 ends half way."""
    generator = np.random.default_rng(seed)
    covariance = np.diag([0.04, 0.09, 0.01])
    times_s = np.arange(steps, dtype=float)
    lengths = [steps // 2] + [steps] * (runs - 1)
    still = truth(list(times_s), [[0, 0, 0]] * steps)
    parts = [
        estimates(
            list(times_s[:length]),
            (generator.normal(size=(length, 3)) * np.sqrt(np.diag(covariance))).tolist(),
            covariance,
        )
        for length in lengths
    ]
    return gather(parts), [Truths(source(still)) for _ in range(runs)]


def test_honest_estimates_lie_within_the_bounds_at_95_of_100_steps():
    """2000 independent steps: 95 % +- 1.5 % (three standard deviations) are inside."""
    errors = errors_of(*ensemble(40, 2000, 3), gap_limit_s=2)
    assert errors is not None
    assert abs(CONSISTENCY.of(errors)["nees_steps_within_95"] - 0.95) < 0.015
    liars = replace(errors, nees=errors.nees * 1.3)
    assert CONSISTENCY.of(liars)["nees_steps_within_95"] < 0.8


def test_the_table_of_steps_counts_the_runs_that_are_there():
    stream, truths = ensemble(5, 10, 4)
    errors = errors_of(stream, truths, gap_limit_s=2)
    assert errors is not None
    judge = Judge([each.source for each in truths], {}, gap_limit_s=2)
    judge.add({stream.stream.topic: stream})
    [table] = judge.steps.values()
    assert table["runs"].tolist() == [5] * 5 + [4] * 5
    last = errors.error[errors.step == 9]
    assert table["rmse_x_m"].iloc[9] == pytest.approx(np.sqrt(np.mean(last[:, 0] ** 2)))
    position = np.sqrt(np.mean(np.sum(last[:, :2] ** 2, axis=1)))
    assert table["position_rmse_m"].iloc[9] == pytest.approx(position)
    assert (table["nees_low"].iloc[9], table["nees_high"].iloc[9]) == chi_square_interval(3, 4)
    rows = error_table(errors)
    assert len(rows) == 5 * 10 - 5
    assert_allclose(rows["sigma_y_m"], 0.3)
    assert_array_equal(rows["error_heading_rad"], errors.error[:, 2])


def test_innovations_count_the_components_that_were_measured():
    """A range and bearing, a bearing alone, and one that the gate kept out."""
    stream = make_stream(
        "/estimates/ekf/robot1/innovation",
        schemas.INNOVATION,
        [1, 2, 3],
        target_id=[1, 1, 1],
        accepted=[1, 1, 0],
        innovation=[[0.1, 0.2], [np.nan, 0.2], [9, 9]],
        covariance=np.full((3, 4), np.nan),
        normalised_innovation_squared=[2.0, 1.5, 50.0],
        log_likelihood=[-1.0, -2.0, 0.0],
    )
    innovations = innovations_of(gather([stream]))
    assert innovations.degrees.tolist() == [2, 1, 2]
    assert INNOVATION.of(innovations) == pytest.approx(
        {"nis_per_component": 53.5 / 5, "gated_share": 1 / 3}
    )
    assert INNOVATION.of(innovations_of(gather([stream.take(slice(0, 0))]))) == {}
    assert LIKELIHOOD.of(innovations) == {"log_likelihood": -3.0}


def test_innovations_of_logs_from_before_the_log_likelihood_are_judged(tmp_path: Path):
    """They lack the field; all else that is said of them stays."""
    older = replace(schemas.INNOVATION, fields=schemas.INNOVATION.fields[:-1])
    stream = make_stream(
        "/estimates/ekf/robot1/innovation",
        older,
        [1, 2],
        metadata={"components": "range_m", "kinds": "linear"},
        target_id=[1, 1],
        accepted=[1, 1],
        innovation=[[0.1], [0.2]],
        covariance=[[1.0], [1.0]],
        normalised_innovation_squared=[2.0, 1.0],
    )
    write_log(tmp_path / "old.mcap", [stream], RunMetadata("landmarks", epoch_ns=0))
    read = read_streams(open_log(tmp_path / "old.mcap"), [stream.topic])[stream.topic]
    innovations = innovations_of(gather([read]))
    assert INNOVATION.of(innovations) == {"nis_per_component": 1.5, "gated_share": 0.0}
    assert LIKELIHOOD.of(innovations) == {}
