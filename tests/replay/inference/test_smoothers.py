"""Smoothers against the reference sheet, dense least squares, and their own filters."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.pipeline.runs.recorded import replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import rotation_vector
from fuselog.replay.inference.linear_algebra.gaussian import solve_semidefinite
from fuselog.replay.inference.linear_algebra.manifold import by_right_jacobian
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.smoothing import smoothers
from tests.replay.inference import attitude, vehicle_a, wheel
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.test_recursion import assert_equal, in_blocks
from tests.replay.inference.vehicle_a import SIGHTING, VEHICLE_A

pytestmark = pytest.mark.paper

EXACT = 1e-9


@cache
def smoothed(forward: str, **values: Any) -> Any:
    """The states of the sheet's problem, with one at t = 0, which a tick of every second gives."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    return outputs(VEHICLE_A, "smoother", [source], forward=forward, every_s=1.0, **values)


def at(found: Any, time_s: float) -> tuple[Any, float]:
    """The mean at a time, and the covariance's trace."""
    state = found["state"]
    [row] = np.flatnonzero(state.stream.publish_time_ns == vehicle_a.EPOCH_NS + round(time_s * 1e9))
    return state["mean"][row], np.trace(state["covariance"][row].reshape(5, 5))


def assert_state(found: Any, wanted: Any, rtol: float = EXACT) -> None:
    """Equal where headings, the third component, are compared modulo 2 pi."""
    turns = np.round((wanted[2] - found[2]) / (2 * np.pi))
    assert_allclose(found + 2 * np.pi * turns * (np.arange(len(found)) == 2), wanted, rtol=rtol)


# Mean at t = 0 and trace of its covariance, the same at 10 s.
TABLE: dict[tuple[str, float], Any] = {
    ("ekf", 0.0): (
        [-0.0626422216014, 0.103770584072, -0.0348630438855, 0.578689672975, -0.0233868661392],
        0.0678264783352,
        [2.01855210422, -3.58791871575, -3.77125600079, 0.687321030701, -0.792335479041],
        0.0264802094164,
    ),
    ("iekf", 0.0): (
        [-0.0621273027319, 0.105472066708, -0.0351599160562, 0.57874269584, -0.023177960869],
        0.0677561623666,
        [2.01807307282, -3.58744108543, -3.77129365557, 0.68729832069, -0.792334012201],
        0.026483814415,
    ),
    ("ukf", 0.5): (
        [-0.0510576341466, 0.102239831592, -0.0334154222009, 0.578729623017, -0.0242939882579],
        0.0683529523744,
        [2.01896533822, -3.5867325688, -3.77124562915, 0.687378274622, -0.79230497787],
        0.0264817021031,
    ),
    ("ukf", 0.0): (
        [-0.0512008849459, 0.102950352717, -0.0334712903097, 0.578738713915, -0.0242494486923],
        0.0682969825665,
        [2.01896278551, -3.58672714945, -3.77124532309, 0.687377772046, -0.792305923519],
        0.0264815520986,
    ),
}


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(("forward", "kappa"), TABLE)
def test_smoothers_give_the_sheets_table(forward: str, kappa: float) -> None:
    """Section 2; nodes are the 160 stamps and the prior's."""
    start, trace, middle, middle_trace = TABLE[forward, kappa]
    found = smoothed(forward, kappa=kappa)
    assert len(found["state"]) == 161
    for time_s, mean, size in ((0.0, start, trace), (10.0, middle, middle_trace)):
        state, spread = at(found, time_s)
        assert_state(state, mean)
        assert_allclose(spread, size, rtol=EXACT)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(
    ("forward", "kappa", "mean", "trace"),
    [
        (
            "ekf",
            0.0,
            [1.97548806713, -3.5368929894, -3.77204364917, 0.694612118743, -0.78804540927],
            0.030333442522,
        ),
        (
            "ukf",
            0.5,
            [1.97598909858, -3.53595299005, -3.77203092308, 0.694644494332, -0.788020882623],
            0.0303360354921,
        ),
    ],
)
def test_a_fixed_lag_gives_the_sheets_numbers(
    forward: str, kappa: float, mean: list[float], trace: float
) -> None:
    """At 10 s by all messages up to 11 s."""
    state, spread = at(smoothed(f"{forward}:lag=1s", kappa=kappa), 10.0)
    assert_state(state, mean)
    assert_allclose(spread, trace, rtol=EXACT)


def test_a_fixed_lag_is_the_smoothed_log_that_ends_there(uncompiled: None) -> None:
    """At every node, up to the end: messages just within the lag are used, those beyond are not."""
    told = vehicle_a.simulate(8)[0][:40]
    found = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)], forward="ekf:lag=500ms")["state"]
    times_ns = found.stream.publish_time_ns
    lag_ns = 500_000_000
    assert np.isin(times_ns[::3] + lag_ns, times_ns).any()  # a node is just at the lag
    for row in range(0, len(found), 3):
        until_s = (times_ns[row] - vehicle_a.EPOCH_NS) / 1e9 + 0.5
        cut = [each for each in told if each[0] <= until_s + 1e-9]
        whole = outputs(VEHICLE_A, "smoother", [vehicle_a.source(cut)])["state"]
        for name in ("mean", "covariance"):
            assert_allclose(found[name][row], whole[name][row], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("lag", ["60ms", "2s", "100s"])
def test_the_window_of_steps_gives_what_the_direct_way_gives(
    lag: str, uncompiled: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lags of no node, of some and of all, across a gap; to the last bit whatever the blocks."""
    told = [each for each in vehicle_a.simulate(8)[0][:60] if not 2.5 < each[0] < 3.8]
    source, forward = vehicle_a.source(told), f"ekf:lag={lag}"
    slid = outputs(VEHICLE_A, "smoother", [source], forward=forward)["state"]
    for found in in_blocks(
        source, tmp_path, lambda log, size: outputs(VEHICLE_A, "smoother", [log], size, forward=forward)
    ):
        assert_equal(found["state"].of_run(0), slid.of_run(0))
    monkeypatch.setattr(smoothers, "is_flat", lambda _: False)
    direct = outputs(VEHICLE_A, "smoother", [source], forward=forward)["state"]
    for name in ("mean", "covariance"):
        assert_allclose(slid[name], direct[name], rtol=1e-10, atol=1e-12)


# Linear models: the dense solution


class LevelParameters(ModelParameters):
    """Densities of the noise of a level and its slope, and the variance of what is measured."""

    level: float = 0.4
    slope: float = 0.1
    measured: float = 0.5


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return state[0] + duration_s * state[1], state[1]


def move_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return parameters.level * duration_s, parameters.slope * duration_s


def read(state: Any, reference: Any, parameters: Any) -> Any:
    return state[0], state[0] + state[1]


def read_noise(parameters: Any) -> Any:
    return parameters.measured, parameters.measured


LEVEL = Model(
    "a level and its slope",
    {"level": "linear", "slope": "linear"},
    LevelParameters,
    (
        Sensor(
            "values",
            SIGHTING,  # any two numbers that may be missing
            {"level": "linear", "sum": "linear"},
            read,
            read_noise,
            read=lambda stream: np.stack([stream["range_m"], stream["bearing_rad"]], axis=1),
            linear=True,
        ),
    ),
    Motion(move, move_noise, linear=True),
)


def levels(times_s: Any, values: Any, mean: Any, covariance: Any) -> MemorySource:
    """Values (n, 2) at times, and a prior at second 1."""
    stamps = np.rint(1e9 * (1 + np.asarray(times_s))).astype(np.int64)
    first, second = np.asarray(values).T
    prior = {"mean": [mean], "covariance": [np.ravel(covariance)]}
    metadata = {"components": "level,slope", "kinds": "linear,linear"}
    streams = [
        make_stream("/prior", schemas.GAUSSIAN_ESTIMATE, [10**9], metadata=metadata, **prior),
        make_stream(
            "/values", SIGHTING, stamps, target_id=0 * stamps, range_m=first, bearing_rad=second
        ),
    ]
    run = RunMetadata(scenario="levels", parameters={}, seed=0, run=0, epoch_ns=10**9)
    return memory_source(Recording(streams), run)


def dense(times_s: Any, values: Any, mean: Any, covariance: Any) -> tuple[Any, Any, Any]:
    """The posterior of the states at the distinct times, by one joint information matrix."""
    nodes = np.unique(np.append(0.0, times_s))
    size = 2 * len(nodes)
    information, vector = np.zeros((size, size)), np.zeros(size)
    information[:2, :2] = np.linalg.inv(covariance)
    vector[:2] = np.linalg.solve(covariance, mean)
    for k, duration in enumerate(np.diff(nodes)):
        rows = np.zeros((2, size))
        rows[:, 2 * k : 2 * k + 2] = -np.array([[1, duration], [0, 1]])
        rows[:, 2 * k + 2 : 2 * k + 4] = np.eye(2)
        information += rows.T @ np.diag([1 / (0.4 * duration), 1 / (0.1 * duration)]) @ rows
    for time_s, value in zip(times_s, values, strict=True):
        at = 2 * int(np.searchsorted(nodes, time_s))
        for of, number in zip(([1.0, 0.0], [1.0, 1.0]), value, strict=True):
            if np.isfinite(number):
                row = np.zeros(size)
                row[at : at + 2] = of
                information += np.outer(row, row) / 0.5
                vector += row * number / 0.5
    spread = np.linalg.inv(information)
    blocks = np.array([spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(nodes))])
    return nodes, (spread @ vector).reshape(-1, 2), blocks


@pytest.mark.parametrize("forward", ["ekf", "iekf", "ukf", "lrkf:s2kf-6", "analytic"])
def test_a_linear_smoother_is_dense_least_squares(forward: str, uncompiled: None) -> None:
    """Equal stamps, missing components, uneven steps; every filter is the Kalman filter here."""
    rng = np.random.default_rng(1)
    times_s = np.sort(np.round(rng.uniform(0.1, 5.0, 25), 1))
    assert len(np.unique(times_s)) < 25
    values = rng.standard_normal((25, 2))
    values[3], values[7, 0], values[12, 1] = np.nan, np.nan, np.nan
    given = times_s, values, np.array([0.5, -0.2]), np.array([[2.0, 0.3], [0.3, 1.0]])
    found = outputs(LEVEL, "smoother", [levels(*given)], forward=forward)["state"]
    times, mean, covariance = dense(*given)
    assert_allclose(found.stream.publish_time_ns / 1e9 - 1, times[1:], atol=1e-9)
    assert_allclose(found["mean"], mean[1:], rtol=1e-10, atol=1e-12)
    assert_allclose(found["covariance"].reshape(-1, 2, 2), covariance[1:], rtol=1e-10, atol=1e-12)


NILE = """
1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 1100
1210 1150 1250 1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 831 726 456 824
702 1120 1100 832 764 821 768 845 864 862 698 845 744 796 1040 759 781 865 845 944 984 897 822 1010
771 676 649 846 812 742 801 1040 860 874 848 890 744 749 838 1050 918 986 797 923 975 815 1020 906
901 1170 912 746 919 718 714 740
"""


def test_the_nile_to_its_digits(uncompiled: None) -> None:
    """Section 9: a level whose slope is known to be zero; a diffuse start at year one."""
    flow = np.array(NILE.split(), float)
    values = np.stack([flow, np.full(100, np.nan)], axis=1)
    values[0] = np.nan  # the start already holds it
    source = levels(np.arange(100), values, [flow[0], 0.0], np.diag([15098.52, 1e-30]))
    settings = {"level": 1469.17, "slope": 0.0, "measured": 15098.52}
    found = outputs(LEVEL, "smoother", [source], **settings)
    smoothed = found["state"]["mean"][[0, 49, 99], 0]
    assert_allclose(smoothed, [1111.66865966, 834.762968144, 798.367452097], rtol=1e-11)
    likelihood = found["innovation"]["log_likelihood"].sum() - 0.5 * np.log(2 * np.pi)
    assert_allclose(likelihood, -633.464563636, rtol=1e-9)


def test_what_is_known_exactly_is_left_as_it_is() -> None:
    """A singular matrix has a solution for what lies in its range, an indefinite one has none."""
    rng = np.random.default_rng(2)
    root = rng.standard_normal((4, 4))
    root[:, 1] = 0.0
    matrix, wanted = root @ root.T, rng.standard_normal((4, 3))
    right = matrix @ wanted
    solution = right.copy()
    assert solve_semidefinite(matrix, solution, np.empty((4, 4)))
    assert_allclose(matrix @ solution, right, rtol=1e-9)
    assert not solve_semidefinite(np.diag([1.0, -1.0, 1.0]), np.eye(3), np.empty((3, 3)))
    assert not solve_semidefinite(np.full((2, 2), np.nan), np.eye(2), np.empty((2, 2)))


# Manifolds


def test_the_reset_back_undoes_the_reset() -> None:
    for size in (1e-9, 0.04, 0.06, 1.0, 3.1):
        d, rows = size * np.array([1.0, 2.0, -2.0]) / 3, np.eye(3)
        by_right_jacobian(("quaternion",) * 4)(d, rows)
        by_right_jacobian(("quaternion",) * 4, back=True)(d, rows)
        assert_allclose(rows, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("forward", ["ekf", "ukf"])
def test_predictions_between_nodes_are_nodes_that_nobody_asked_for(
    forward: str, uncompiled: None
) -> None:
    """Five gyro messages a node, or each a node of its own: equal estimates, rotations and all."""
    source, *_ = attitude.simulate(21)
    streams = [
        each.take(slice(0, np.searchsorted(each.publish_time_ns, attitude.EPOCH_NS + 10**9)))
        for each in source.streams.values()
    ]
    short = memory_source(Recording(streams), source.run)
    few, many = (
        outputs(ATTITUDE, "smoother", [short], forward=forward, every_s=every_s)["state"]
        for every_s in (None, attitude.STEP_S)
    )
    rows = np.isin(many.stream.publish_time_ns, few.stream.publish_time_ns)
    assert (len(few), len(many)) == (rows.sum(), 5 * len(few) + 5)
    assert_allclose(many["mean"][rows], few["mean"], atol=1e-12)
    assert_allclose(many["covariance"][rows], few["covariance"], rtol=1e-8, atol=1e-12)


@pytest.mark.paper
def test_smoothed_attitude_is_better_and_consistent() -> None:
    """Thirty runs: the error of the rotation against the filter's, and the mean NEES of six."""
    runs = [attitude.simulate(seed) for seed in range(5000, 5030)]
    errors, nees = {}, {}
    for method in ("iekf", "smoother"):
        own = {"forward": "iekf"} if method == "smoother" else {}
        found = outputs(ATTITUDE, method, [source for source, *_ in runs], **own)["state"]
        turns, consistent = [], []
        for run, (_, truth, _) in enumerate(runs):
            stream = found.of_run(run)
            step = (stream.publish_time_ns - attitude.EPOCH_NS) // 20_000_000 - 1
            mean, covariance = stream["mean"], stream["covariance"].reshape(-1, 6, 6)
            turn = rotation_vector(compose(conjugate(mean[:, :4]), truth[step, :4]))
            e = np.concatenate([turn, truth[step, 4:] - mean[:, 4:]], axis=1)
            consistent.append(
                np.einsum("ki,ki->k", e, np.linalg.solve(covariance, e[..., None])[..., 0])
            )
            turns.append(turn)
        errors[method] = np.sqrt(np.mean(np.square(turns)))
        nees[method] = np.mean(consistent)
    assert errors["smoother"] < 0.8 * errors["iekf"]
    assert abs(nees["smoother"] - 6) < 1


def test_a_heading_at_the_cut_is_one_like_any_other(
    monkeypatch: pytest.MonkeyPatch, uncompiled: None
) -> None:
    """The whole problem turned by -3.1 rad: places turn with it, headings are 3.1 less."""
    told, angle = vehicle_a.simulate(7)[0][:80], -3.1
    plain = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)])["state"]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    monkeypatch.setattr(vehicle_a, "BEACONS", vehicle_a.BEACONS @ turn.T)
    mean = vehicle_a.MEAN + np.array([0, 0, angle, 0, 0])
    turned = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told, mean)])["state"]
    assert np.ptp(turned["mean"][:, 2]) > 6  # both sides of the cut
    assert_allclose(turned["mean"][:, :2], plain["mean"][:, :2] @ turn.T, atol=1e-9)
    apart = turned["mean"][:, 2] - plain["mean"][:, 2] - angle
    assert_allclose(np.sin(apart / 2), 0, atol=1e-9)
    diagonal = np.arange(2, 5) * 6
    assert_allclose(turned["covariance"][:, diagonal], plain["covariance"][:, diagonal], rtol=1e-7)


# Blocks, ensembles, gates, failures


@pytest.mark.parametrize("forward", ["ekf", "ekf:lag=300ms"])
@pytest.mark.parametrize("every_s", [None, 0.05])
def test_blocks_are_the_whole(
    forward: str, every_s: float | None, uncompiled: None, tmp_path: Path
) -> None:
    """Bit for bit, with an axis and an interpolated control, for which events wait."""
    messages = wheel.simulate(2, np.arange(-1, 19) * 0.1)
    source, model = wheel.source(messages, ("dial", "tacho", "drive")), wheel.make_wheel()
    given = {"forward": forward, "every_s": every_s}
    whole = outputs(model, "smoother", [source], **given)
    filtered = outputs(model, "ekf", [source], every_s=every_s)
    for found in in_blocks(
        source, tmp_path, lambda log, size: outputs(model, "smoother", [log], size, **given)
    ):
        for leaf in ("state", "innovation"):
            assert_equal(found[leaf].of_run(0), whole[leaf].of_run(0))
    assert_equal(whole["innovation"].of_run(0), filtered["innovation"].of_run(0))
    ours, theirs = whole["state"], filtered["state"]
    assert_array_equal(ours.stream.publish_time_ns, theirs.stream.publish_time_ns)
    assert_array_equal(ours["mean"][-1], theirs["mean"][-1])
    assert np.all(ours["covariance"][:-1, 0] < theirs["covariance"][:-1, 0])


def test_nodes_beyond_what_memory_may_hold_lie_on_disk(
    uncompiled: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    collect: Callable[[], int],
) -> None:
    """Bit for bit the same, and no file is left, be it that the way back fails."""
    source = vehicle_a.source(vehicle_a.simulate(8)[0][:60])
    inside = outputs(VEHICLE_A, "smoother", [source], 16)["state"]
    monkeypatch.setattr(smoothers, "IN_MEMORY_BYTES", 6000)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kept: list[bool] = []
    gone_back = smoothers.Smoother.gone_back

    def watched(self: Any, pieces: Any, stop: Any = None) -> Any:
        kept.extend(isinstance(piece, smoothers.Stored) for piece in pieces)
        if fails and stop is None:
            raise RuntimeError("the way back")
        return gone_back(self, pieces, stop)

    monkeypatch.setattr(smoothers.Smoother, "gone_back", watched)
    fails = False
    outside = outputs(VEHICLE_A, "smoother", [source], 16)["state"]
    assert any(kept)
    assert not all(kept)
    assert_equal(outside.of_run(0), inside.of_run(0))
    assert not any(tmp_path.iterdir())
    fails = True
    with pytest.raises((RuntimeError, BadInput), match="the way back"):
        outputs(VEHICLE_A, "smoother", [source], 16)
    collect()
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("forward", ["ekf", "ekf:lag=500ms"])
def test_an_ensemble_is_its_runs_alone_and_one_that_fails_fails_alone(
    forward: str, uncompiled: None
) -> None:
    """A run that ends early, and one whose range at 3 s is beyond all numbers: it ends before that."""
    told = [vehicle_a.simulate(seed)[0][:80] for seed in (7, 8, 9)]
    told[1] = told[1][:30]
    row = next(k for k, each in enumerate(told[2]) if each[0] >= 3 and each[1] == "rb")
    told[2][row] = (*told[2][row][:3], np.array([1e308, 1e308]))
    sources = [replace(vehicle_a.source(each), is_raw=True) for each in told]
    together = outputs(VEHICLE_A, "smoother", sources, forward=forward)
    assert np.diff(together["failure"].offsets).tolist() == [0, 0, 1]
    for run in (0, 1):
        alone = outputs(VEHICLE_A, "smoother", [sources[run]], forward=forward)
        for leaf in ("state", "innovation"):
            assert_equal(together[leaf].of_run(run), alone[leaf].of_run(0))
    until = outputs(
        VEHICLE_A, "smoother", [vehicle_a.source([m for m in told[2] if m[0] < 3])], forward=forward
    )
    assert_equal(together["state"].of_run(2), until["state"].of_run(0))


def test_what_the_gate_kept_out_says_nothing_backwards_either(uncompiled: None) -> None:
    """The outlier is as if it had not come, but for its stamp."""
    told = vehicle_a.simulate(7, outlier=True)[0][:85]
    kept = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)], gate_probability=0.999)
    [row] = np.flatnonzero(kept["innovation"]["accepted"] == 0)
    at_ns = kept["innovation"].stream.publish_time_ns[row]
    target = kept["innovation"]["target_id"][row]
    without = [
        (*each[:3], np.full(2, np.nan))
        if each[1] == "rb" and vehicle_a.EPOCH_NS + round(each[0] * 1e9) == at_ns and each[2] == target
        else each
        for each in told
    ]
    missing = outputs(VEHICLE_A, "smoother", [vehicle_a.source(without)], gate_probability=0.999)
    assert_equal(kept["state"].of_run(0), missing["state"].of_run(0))


@pytest.mark.parametrize(
    ("forward", "sentence"),
    [
        ("smoother", "'smoother' is not a filter that a smoother can use; available: ekf"),
        ("efk", "did you mean 'ekf'"),
        ("ekf:s2kf-50", "filter ekf has no variants; give 'smoother:ekf' without ':s2kf-50'"),
        ("ekf:lag=0ms", "lag=0ms is not a valid lag; give a positive whole number and its unit"),
        ("ekf:lag=-1s", "lag=-1s is not a valid lag"),
        ("ekf:lag=5", "lag=5 is not a valid lag"),
        ("lrkf:s2kf-50:lag=", "lag= is not a valid lag"),
        ("lrkf:nonsense", "sampling"),
    ],
)
def test_what_is_no_smoother_is_one_sentence(forward: str, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence) as error:
        bound(VEHICLE_A, "smoother", [vehicle_a.source([])], forward=forward)
    assert "\n" not in str(error.value)


@pytest.mark.paper
def test_mrclam_6_is_better_by_more_than_five_percent(mrclam6_log: MemorySource) -> None:
    """Every robot's position; measured 29 to 53, with at most 1.3 of the filter's NEES."""
    replayed = replay_ensemble([mrclam6_log], {"ekf": {}, "smoother:ekf": {}}, gap_limit_s=1.0)
    found = {(each.case, each.estimator): each for each in replayed.errors}
    robots = {case for case, _ in found}
    assert len(robots) == 5
    for robot in robots:
        rmse, nees = {}, {}
        for name in ("ekf", "smoother:ekf"):
            error = found[robot, name].error[:, :2]
            spread = found[robot, name].covariance[:, :2, :2]
            scaled = np.linalg.solve(spread, error[..., None])[..., 0]
            rmse[name] = np.sqrt(np.nanmean(np.sum(error**2, axis=1)))
            nees[name] = np.nanmean(np.sum(error * scaled, axis=1))
        assert rmse["smoother:ekf"] < 0.95 * rmse["ekf"]
        assert nees["smoother:ekf"] < 1.3 * nees["ekf"]
