"""The one recursion, whatever the model: order, blocks, ensembles, controls, ticks, failures.

A wheel (see `wheel`) is filtered by a plain loop of NumPy too, in an angle instead of an axis. What is
about the recursion and not the compiler runs uncompiled.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.recorders.log import LogWriter, Stream, make_stream, open_log, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, memory_source
from fuselog.replay.inference.run.events import Points
from fuselog.replay.inference.run.recursion import no_results
from fuselog.replay.inference.run.timing import add_output_times, output_times
from tests.replay.inference import vehicle_a, wheel
from tests.replay.inference.replays import outputs
from tests.replay.inference.scalar import SCALAR, VALUE
from tests.replay.inference.scalar import source as scalar_source
from tests.replay.inference.vehicle_a import VEHICLE_A
from tests.replay.inference.wheel import ANGLE, COVARIANCE, RATE, make_wheel

Floats = Any


# A plain filter of the wheel, its state the angle and the rate


def extended(function: Callable[..., Any], jacobians: Callable[..., Any]) -> Callable[..., Any]:
    """A Gaussian through a function by its derivatives: mean, covariance, that with the state."""

    def through(m: Floats, P: Floats, variances: Floats, *arguments: Any) -> Any:  # noqa: N803
        F, G = jacobians(m, *arguments)
        value = np.array(function(m, np.zeros(len(variances)), *arguments))
        return value, F @ P @ F.T + G @ np.diag(variances) @ G.T, P @ F.T

    return through


def sampled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same by the points of the unscented transform with kappa = 1, the noise among them."""

    def through(m: Floats, P: Floats, variances: Floats, *arguments: Any) -> Any:  # noqa: N803
        n = 2 + len(variances)
        joint = np.zeros((n, n))
        joint[:2, :2], joint[2:, 2:] = np.linalg.cholesky(P), np.diag(np.sqrt(variances))
        offsets = np.concatenate([np.zeros((1, n)), np.sqrt(n + 1) * joint.T, -np.sqrt(n + 1) * joint.T])
        weights = np.full(2 * n + 1, 0.5 / (n + 1))
        weights[0] = 1 / (n + 1)
        values = np.array([function(m + each[:2], each[2:], *arguments) for each in offsets])
        mean = weights @ values
        away = values - mean
        return mean, (away.T * weights) @ away, (offsets[:, :2].T * weights) @ away

    return through


def moved(x: Floats, noise: Floats, control: float, duration_s: float) -> Any:
    return wheel.turned(x[0], x[1], control, noise, duration_s)


def moved_jacobians(x: Floats, control: float, duration_s: float) -> Any:
    turn = (x[1] + 0.5 * control * duration_s) * duration_s
    return np.array([[1, duration_s], [0, 1]]), np.array([[turn, 0], [0, 1]])


def dial(x: Floats, noise: Floats) -> Any:
    gain = 1 + noise[0]
    return gain * np.cos(2 * x[0]) + noise[1], gain * np.sin(2 * x[0]) + noise[2]


def dial_jacobians(x: Floats) -> Any:
    cosine, sine = np.cos(2 * x[0]), np.sin(2 * x[0])
    return np.array([[-2 * sine, 0], [2 * cosine, 0]]), np.array([[cosine, 1, 0], [sine, 0, 1]])


FILTERS = {
    "ekf": (extended(moved, moved_jacobians), extended(dial, dial_jacobians)),
    "ukf": (sampled(moved), sampled(dial)),
}


def plain_filter(
    method: str, messages: dict[str, Any], order: Sequence[str], ticks_s: Sequence[float] = ()
) -> tuple[list[float], Floats, Floats, float]:
    """Times, means and covariances where there are estimates, and the log-likelihood."""
    predict, read = FILTERS[method]
    control_s, control = messages["drive"]
    events = [(0.0, -1, "prior", None)]
    events += [
        (round(t, 9), n, topic, row)
        for n, topic in enumerate(order)
        for row, t in enumerate(messages[topic][0])
    ]
    events += [(t, len(order), "tick", None) for t in ticks_s]
    m, P, now, likelihood = np.array([ANGLE, RATE]), COVARIANCE, 0.0, 0.0
    drive = np.interp(0.0, control_s, control[:, 0])
    found: dict[float, Any] = {}
    for time_s, _, topic, row in sorted(events, key=lambda each: each[:2]):
        if time_s < 0:
            continue
        if time_s > now:
            there = np.interp(time_s, control_s, control[:, 0])
            variances = np.array([0.1**2, 0.3**2 * (time_s - now)])
            m, P, _ = predict(m, P, variances, 0.5 * (drive + there), time_s - now)
            drive, now = there, time_s
        if topic in ("dial", "tacho"):
            value = messages[topic][1][row]
            if topic == "dial":
                h, S, C = read(m, P, np.array([0.05**2, 0.1**2, 0.1**2]))
            else:
                h, S, C = m[1:], P[1:, 1:] + 0.2**2, P[:, 1:]
            v, K = value - h, C @ np.linalg.inv(S)
            m, P = m + K @ v, P - K @ S @ K.T
            likelihood -= 0.5 * (v @ np.linalg.solve(S, v) + np.linalg.slogdet(2 * np.pi * S)[1])
        if topic in ("dial", "tacho", "tick"):
            found[time_s] = m, P
    means, covariances = zip(*found.values(), strict=True)
    return list(found), np.array(means), np.array(covariances), likelihood


CONTROL_S = np.arange(-1, 15) * 0.1
CONTROLS = {
    "one at the prior's stamp, and an end before that of the sensors": np.arange(-1, 20) * 0.07,
    "none at the prior's stamp": np.arange(-1, 15) * 0.1 + 0.04,
    "the first after the prior, at stamps of sensors": np.arange(1, 21) * 0.1,
}


def test_a_prior_of_long_before_makes_no_ticks_before_the_log() -> None:
    """A year of them at 20 Hz would be 600 million estimates; a second of them is as asked for."""
    year_ns, second_ns, every_ns = 366 * 86_400 * 10**9, 10**9, 50_000_000
    log_ns = 2 * year_ns + np.arange(0, 2 * second_ns, 10**8)
    events = output_times(np.array([0, 10, 20]), log_ns, 1, wants_estimate=True)
    start_ns = np.array([log_ns[0] - year_ns, log_ns[10] - second_ns])
    found, next_output = add_output_times(events, start_ns, np.zeros(2, np.int64), every_ns)
    runs = np.split(found.time_ns, found.offsets[1:-1])
    assert [run[0] for run in runs] == [log_ns[0], log_ns[10] - second_ns]
    assert [len(run) for run in runs] == [19, 39]
    assert next_output.tolist() == [log_ns[9] // every_ns + 1, log_ns[19] // every_ns + 1]
    gap = output_times(np.array([0, 1, 1]), log_ns[9:10] + 100 * second_ns, 1, wants_estimate=True)
    assert len(add_output_times(gap, log_ns[[9, 19]], next_output, every_ns)[0].time_ns) == 2000


@pytest.mark.parametrize("method", ["ekf", "ukf"])
@pytest.mark.parametrize("case", CONTROLS)
def test_axis_noise_that_is_not_additive_and_an_interpolated_control(
    method: str, case: str, uncompiled: None
) -> None:
    """Against the plain loop: before the prior nothing is said, what waits for a control is not lost."""
    messages = wheel.simulate(1, CONTROLS[case])
    values = {"kappa": 1.0} if method == "ukf" else {}
    order = ("dial", "tacho", "drive")
    found = outputs(make_wheel(), method, [wheel.source(messages, order)], every_s=0.05, **values)
    times_s, mean, covariance, likelihood = plain_filter(
        method, messages, order, [round(0.05 * k, 9) for k in range(40)]
    )
    state = found["state"]
    assert_array_equal(state.stream.publish_time_ns, wheel.stamps_of(np.array(times_s)))
    angle = np.arctan2(state["mean"][:, 1], state["mean"][:, 0])
    assert_allclose(np.sin(angle - mean[:, 0]), 0, atol=1e-12)  # up to half a turn
    assert_allclose(state["mean"][:, 2], mean[:, 1], rtol=1e-11)
    assert_allclose(state["covariance"].reshape(-1, 2, 2), covariance, rtol=1e-10, atol=1e-14)
    assert_allclose(found["innovation"]["log_likelihood"].sum(), likelihood, rtol=1e-11)
    assert len(found["innovation"]) == 29  # 22 and 8, less one before the prior


@pytest.mark.parametrize("order", [("dial", "tacho", "drive"), ("drive", "dial", "tacho")])
@pytest.mark.parametrize("every_s", [None, 0.05])
def test_blocks_of_an_interpolated_control_are_the_whole(
    order: Sequence[str], every_s: float | None, uncompiled: None, tmp_path: Path
) -> None:
    """Bit for bit, and no estimate twice: where a block ends, events wait for the next control."""
    messages = wheel.simulate(2, np.arange(-1, 19) * 0.1)
    source, model = wheel.source(messages, order), make_wheel()
    whole = outputs(model, "ekf", [source], every_s=every_s)
    blocks = in_blocks(
        source, tmp_path, lambda log, size: outputs(model, "ekf", [log], size, every_s=every_s)
    )
    for found in blocks:
        assert_same(found, whole)
    times_ns = whole["state"].stream.publish_time_ns
    assert np.all(np.diff(times_ns) > 0)


def test_without_a_message_of_the_control_the_initial_one_holds(uncompiled: None) -> None:
    """Of an interpolated control too, in the run that has none; the other does not notice."""
    messages = wheel.simulate(3, np.arange(-1, 21) * 0.1)
    silent = {**messages, "drive": (np.empty(0), np.empty((0, 1)))}
    still = {**messages, "drive": (np.array([0.0, 1.0]), np.zeros((2, 1)))}
    model = make_wheel()
    found = outputs(model, "ekf", [wheel.source(each) for each in (messages, silent)])
    assert len(found["failure"]) == 0
    for run, each in enumerate((messages, still)):
        alone = outputs(model, "ekf", [wheel.source(each)])
        assert_equal(found["state"].of_run(run), alone["state"].of_run(0))


# Blocks, ensembles and equal stamps, of vehicle A


def in_blocks(source: MemorySource, folder: Path, replayed: Callable[[Any, int], Any]) -> Iterator[Any]:
    """What a replay of the log in smaller and smaller blocks gives."""
    path = folder / "log.mcap"
    with LogWriter(path, source.run, chunk_bytes=512) as writer:
        writer.write(source.streams.values())
    for block_messages in (1, 20):
        yield replayed(LogSource(open_log(path)), block_messages)


def assert_equal(ours: Stream, theirs: Stream) -> None:
    """Equal to the last bit."""
    assert_array_equal(ours.publish_time_ns, theirs.publish_time_ns)
    for name, column in ours.columns.items():
        assert_array_equal(column, theirs.columns[name], err_msg=name, strict=True)


def assert_same(ours: dict[str, Ragged], theirs: dict[str, Ragged]) -> None:
    for leaf in ("state", "innovation"):
        assert_equal(ours[leaf].of_run(0), theirs[leaf].of_run(0))


@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_small_blocks_are_the_whole_log(method: str, tmp_path: Path) -> None:
    source = vehicle_a.source(vehicle_a.simulate(7)[0][:70])

    def replayed(source: Any, size: int = 1 << 18) -> dict[str, Ragged]:
        return outputs(VEHICLE_A, method, [source], size, every_s=0.07)

    whole = replayed(source)
    assert len(whole["state"]) > 100
    for found in in_blocks(source, tmp_path, replayed):
        assert_same(found, whole)


@pytest.mark.parametrize("method", ["ekf", "iekf", "ukf"])
def test_an_ensemble_is_its_runs_alone(method: str) -> None:
    """Schedules of their own: one is cut off, one has no message of a sensor."""
    told = [vehicle_a.simulate(seed)[0] for seed in (7, 8, 9)]
    told[1], told[2] = told[1][:50], [each for each in told[2] if each[1] == "rb"]
    sources = [vehicle_a.source(each) for each in told]
    together = outputs(VEHICLE_A, method, sources)
    for run, source in enumerate(sources):
        alone = outputs(VEHICLE_A, method, [source])
        for leaf in ("state", "innovation"):
            assert_equal(together[leaf].of_run(run), alone[leaf].of_run(0))
    assert np.diff(together["state"].offsets).tolist() == [160, 38, 80]


def with_streams(source: MemorySource, order: Sequence[str]) -> MemorySource:
    """The topics in another order, which is that of equal stamps."""
    return memory_source(Recording([source.streams[topic] for topic in order]), source.run)


def test_messages_of_one_stamp_are_taken_in_the_order_of_the_file() -> None:
    """With one estimate after the last of them; the other order is another, nearby, estimate."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    found = outputs(VEHICLE_A, "ekf", [source])
    other = outputs(
        VEHICLE_A, "ekf", [with_streams(source, ["/landmarks", "/prior", "/speed", "/sighting"])]
    )
    speed = np.isfinite(found["innovation"]["innovation"][:, 2])
    same_stamp = np.diff(found["innovation"].stream.publish_time_ns) == 0
    assert np.all(speed[1:][same_stamp] >= speed[:-1][same_stamp])  # sightings first
    other_speed = np.isfinite(other["innovation"]["innovation"][:, 2])
    assert np.all(other_speed[1:][same_stamp] <= other_speed[:-1][same_stamp])
    difference = np.abs(found["state"]["mean"] - other["state"]["mean"]).max()
    assert 1e-9 < difference < 0.1


def test_messages_before_the_prior_say_nothing() -> None:
    """Neither do they move the state: the rest is the replay without them."""
    told = vehicle_a.simulate(7)[0]
    source = vehicle_a.source(told)
    prior = source.streams["/prior"]
    later_ns = vehicle_a.EPOCH_NS + 5 * 10**9
    late = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [later_ns],
        metadata=prior.metadata,
        mean=prior["mean"],
        covariance=prior["covariance"],
    )
    found = outputs(VEHICLE_A, "ekf", [with_prior(source, late)])
    rest = outputs(
        VEHICLE_A, "ekf", [with_prior(vehicle_a.source([m for m in told if m[0] >= 5]), late)]
    )
    assert_same(found, rest)
    assert found["state"].stream.publish_time_ns[0] == later_ns


def with_prior(source: MemorySource, prior: Stream) -> MemorySource:
    streams = {**source.streams, "/prior": prior}
    return memory_source(Recording(list(streams.values())), source.run)


def test_ticks_are_multiples_of_their_interval_beside_the_sensors_stamps() -> None:
    """From the prior on to the last message; where a sensor has one there is one estimate alone."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    plain = outputs(VEHICLE_A, "ekf", [source])["state"]
    ticked = outputs(VEHICLE_A, "ekf", [source], every_s=0.1)["state"]
    own, times_ns = (each.stream.publish_time_ns for each in (plain, ticked))
    wanted = np.arange(vehicle_a.EPOCH_NS, own[-1] + 1, 10**8)
    assert_array_equal(times_ns, np.union1d(own, wanted))
    at_own = np.isin(times_ns, own)
    assert_allclose(ticked["mean"][at_own], plain["mean"], atol=0.05)  # shorter steps of the motion
    assert_array_equal(ticked["mean"][0], vehicle_a.MEAN)


def test_results_are_one_piece_of_memory_and_columns_of_their_own():
    """Runs of 2 and 3 estimates, and of 1 and 4 innovations in two slots."""
    due, noted = np.array([0, 2, 5]), np.array([0, 1, 5])
    estimates, innovations = no_results(due, noted, VEHICLE_A, 2)
    n, t = VEHICLE_A.size, VEHICLE_A.tangent
    columns = [*estimates[1:], *innovations[1:]]
    shapes = [(5,), (5, n), (5, t, t), (5,), (5,), (5, 2), (5, 2, 2), (5, 3)]
    assert [column.shape for column in columns] == shapes
    for number, column in enumerate(columns):
        column[...] = number
    for number, column in enumerate(columns):
        assert_array_equal(column, number)
        assert column.flags.c_contiguous
        assert np.shares_memory(column, _whole(columns[1]))
    assert_array_equal(estimates.end, [0, 2])
    assert_array_equal(innovations.end, [0, 1])


def _whole(column: Any) -> Any:
    """The memory that a column is a part of."""
    return column if column.base is None else _whole(column.base)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("method", ["ekf", "iekf", "ukf", "particles", "smoother"])
def test_a_measurement_that_leaves_no_covariance_ends_the_run(method: str) -> None:
    """A variance of the innovation below zero, of the second message: a number of the model is wrong."""
    wrong = replace(VALUE, noise=lambda parameters: (parameters.sigma_measured,))
    model = replace(SCALAR, sensors=(wrong,))
    found = outputs(model, method, [scalar_source([0.1, 0.2])], sigma_measured=-1.07, sigma_moved=0.5)
    assert sentences_of(found["failure"].stream) == ["the covariance is no longer positive definite"]


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("method", ["ekf", "iekf", "ukf", "smoother", "particles"])
@pytest.mark.paper
def test_what_memory_holds_before_it_is_written_changes_nothing(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensors of one and of two components, noise that is not additive, an interpolated control."""
    found, few = [], {"particles": 30} if method == "particles" else {}
    for garbage in (np.nan, 7e77):

        def holding(shape: Any, dtype: Any = float, value: float = garbage, **options: Any) -> Any:
            made = np.zeros(shape, dtype, **options)
            made[...] = value if made.dtype.kind == "f" else 0
            return made

        with monkeypatch.context() as changed:
            changed.setattr(np, "empty", holding)
            source = wheel.source(wheel.simulate(1, CONTROL_S))
            found.append(outputs(make_wheel(), method, [source], **few))
    for topic, ragged in found[0].items():
        for name, column in ragged.stream.columns.items():
            assert_array_equal(column, found[1][topic][name], err_msg=f"{topic} {name}")


@pytest.mark.parametrize("last", [3, 4_000_000_000])
def test_points_are_found_by_run_and_number(last: int) -> None:
    """Of two points with one number the first is taken; numbers may be far apart."""
    keys = np.array([1, 2, 2, last, (2 << 32) + 1])
    points = Points(keys, np.arange(10.0).reshape(5, 2))
    run = np.array([0, 0, 0, 0, 0, 1, 2, 2, 3])
    number = np.array([last, 2, 0, -1, 7, 1, 1, 2, 1])
    for asked in (slice(0, 3), slice(0, 8), slice(None), slice(0, 0)):
        rows = points.rows(run[asked], number[asked])
        assert rows.tolist() == [3, 1, -1, -1, -1, -1, 4, -1, -1][asked]
    assert_array_equal(points.at(np.array([-1, 2])), [[np.nan, np.nan], [4.0, 5.0]])
