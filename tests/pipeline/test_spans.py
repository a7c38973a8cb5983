"""Parts of logs: what their times count from, by which clock, and what a filter starts from there."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fuselog.pipeline.runs.ensemble import RunGroup, replay_parts
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, open_log, read_streams, write_log
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, record_run
from fuselog.replay.engine.streams.sources import LogSource
from tests.replay.timeline.test_timeline import read

Fuselog = Callable[..., Any]
SECOND = 10**9
POSE = "/estimates/ekf/robot1/pose"
# Simulated stamps begin in 2026; this log's publish stamps begin 50 s after zero, its log times in 2001.
SIMULATED, WALL = 50 * SECOND, 10**18
LATENCY_S = 0.25


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def landmarks(duration_s: float = 4.0) -> list[Stream]:
    recording, _ = record_run("landmarks", {"duration_s": duration_s}, 0)
    return recording.streams


def with_two_clocks(stream: Stream) -> Stream:
    """Simulated publish stamps and wall log times, sightings with a latency: nothing in common."""
    elapsed_ns = stream.publish_time_ns - SIMULATION_EPOCH_NS
    late_ns = round(LATENCY_S * SECOND) if "range_bearing" in stream.topic else 0
    return replace(
        stream, publish_time_ns=SIMULATED + elapsed_ns, log_time_ns=WALL + elapsed_ns + late_ns
    )


@pytest.fixture
def two_clocks() -> Path:
    """A log without run metadata, as others write them."""
    path = Path("two-clocks.mcap")
    write_log(path, [with_two_clocks(stream) for stream in landmarks()])
    return path


def stamps_of(path: str, topic: str = POSE) -> Any:
    return read_streams(open_log(path), [topic])[topic].publish_time_ns


def test_without_run_metadata_times_count_from_the_first_publish_stamp(
    two_clocks: Path, fuselog: Fuselog
) -> None:
    """Not from 1970, and not from the log times; the estimates say so too."""
    assert fuselog("replay", two_clocks, "-e", "ekf", "--end", "1.5", "-o", "first.mcap").code == 0
    stamps_ns = stamps_of("first.mcap")
    assert SIMULATED <= stamps_ns[0] < stamps_ns[-1] < SIMULATED + 1.5 * SECOND
    assert stamps_ns[-1] > SIMULATED + 1.4 * SECOND
    run = open_log("first.mcap").run
    assert run is not None
    assert run.epoch_ns == SIMULATED
    said = fuselog("replay", two_clocks, "-e", "ekf", "--start", "5", "-o", "none.mcap")
    assert (said.code, "from 0 to 4 s" in said.err) == (2, True)


def test_spans_are_in_the_clock_that_orders_the_replay(two_clocks: Path, fuselog: Fuselog) -> None:
    """By arrival the seconds count from the first log time, and the late sightings are of the span."""
    by_arrival = ["--arrival-order", "--end", "1.5", "-o", "arrived.mcap"]
    assert fuselog("replay", two_clocks, "-e", "ekf", *by_arrival).code == 0
    stamps_ns = stamps_of("arrived.mcap")
    assert WALL <= stamps_ns[0] < stamps_ns[-1] < WALL + 1.5 * SECOND
    assert fuselog("replay", two_clocks, "-e", "ekf", "--end", "1.5", "-o", "measured.mcap").code == 0
    seen = {
        name: len(stamps_of(name, "/estimates/ekf/robot1/innovation"))
        for name in ("arrived.mcap", "measured.mcap")
    }
    assert 0 < seen["arrived.mcap"] < seen["measured.mcap"]


def test_an_epoch_that_is_stated_need_not_be_the_first_stamp(fuselog: Fuselog) -> None:
    """--start and --end count from it, whatever the log's first stamps are."""
    recording, run = record_run("landmarks", {"duration_s": 4.0}, 0)
    shifted = replace(run, epoch_ns=run.epoch_ns - 100 * SECOND)
    write_log("shifted.mcap", recording.streams, shifted)
    span = ["--start", "100", "--end", "101", "-o", "part.mcap"]
    assert fuselog("replay", "shifted.mcap", "-e", "ekf", *span).code == 0
    stamps_ns = stamps_of("part.mcap")
    assert run.epoch_ns <= stamps_ns[0] < stamps_ns[-1] < run.epoch_ns + SECOND
    said = fuselog("replay", "shifted.mcap", "-e", "ekf", "--start", "105", "-o", "none.mcap")
    assert (said.code, "from 100 to 104 s" in said.err) == (2, True)


@pytest.fixture(scope="module")
def run_log(tmp_path_factory: pytest.TempPathFactory, fuselog: Fuselog) -> Path:
    """A run of 60 s beside the estimates of it."""
    folder = tmp_path_factory.mktemp("run")
    log = folder / "run.mcap"
    assert fuselog("record", "landmarks", "--seed", "3", "-o", log).code == 0
    both = ["-e", "ekf", "-e", "dead-reckoning", "-o", folder / "estimates.mcap"]
    assert fuselog("replay", log, *both).code == 0
    return log


def test_a_start_after_the_prior_says_from_what(run_log: Path, fuselog: Fuselog) -> None:
    """The prior is of another time: the filter would begin half a run away, and believe itself."""
    start = ["replay", run_log, "-e", "ekf", "--start", "30", "-o", "late.mcap"]
    said = fuselog(*start)
    assert said.code == 2
    assert all(words in said.err for words in ("/robot1/prior", "30 s before", "--start-from truth"))
    assert not Path("late.mcap").exists()
    for origin in ("truth", run_log.with_name("estimates.mcap")):
        metrics = fuselog(*start, "--start-from", origin, "--json").json["metrics"]
        assert metrics["ekf.position_rmse_m.robot1"] < 0.03
        assert 2 < metrics["ekf.nees.robot1"] < 5
    at_the_prior = ["replay", run_log, "-e", "ekf", "--start", "0", "-o", "whole.mcap"]
    assert fuselog(*at_the_prior).code == 0


def test_only_what_has_a_prior_needs_a_start(fuselog: Fuselog) -> None:
    assert fuselog("record", "landmarks", "--set", "duration_s=4", "-o", "log.mcap").code == 0
    solve = ["replay", "log.mcap", "-e", "set-membership:exact", "--set", "bound_deg=4"]
    assert fuselog(*solve, "--start", "2", "-o", "sets.mcap").code == 0
    assert stamps_of("sets.mcap", "/estimates/set-membership:exact/robot1/size")[0] >= (
        open_log("log.mcap").run.epoch_ns + 2 * SECOND  # type: ignore[union-attr]
    )


def test_the_truth_starts_a_filter_as_exactly_as_is_stated(run_log: Path, fuselog: Fuselog) -> None:
    """Without measurements, the first covariance is the one that was stated."""
    start = ["replay", run_log, "-e", "dead-reckoning", "--start", "30", "--start-from", "truth"]
    quiet = ["--set", "forward_noise_density=0", "--set", "turn_noise_density=0"]
    sigmas = ["--start-sigma", "x_m=3", "--start-sigma", "y_m=4"]
    assert fuselog(*start, *quiet, *sigmas, "-o", "late.mcap").code == 0
    topic = "/estimates/dead-reckoning/robot1/pose"
    first = read_streams(open_log("late.mcap"), [topic])[topic].take(slice(0, 1))
    prior = read_streams(open_log(run_log), ["/robot1/prior"])["/robot1/prior"]
    expected = prior["covariance"].reshape(3, 3) * [[0, 0, 0], [0, 0, 0], [0, 0, 1]] + np.diag(
        [9, 16, 0]
    )
    assert_allclose(first["covariance"].reshape(3, 3), expected, atol=1e-9)
    assert fuselog(*start, "-o", "late.mcap").code == 0
    truth = read_streams(open_log(run_log), ["/robot1/truth"])["/robot1/truth"]
    there = truth["state"][np.searchsorted(truth.publish_time_ns, first.publish_time_ns[0])]
    assert_allclose(first["mean"][0], there, atol=1e-9)


@pytest.mark.paper
def test_a_filter_goes_on_from_its_own_estimate_as_if_it_had_never_stopped(fuselog: Fuselog) -> None:
    """Each of five Kalman filters, from the estimate before the start: to the last bit.

    An estimate at the start itself holds what is replayed again, and is not the one to start from.
    """
    assert fuselog("record", "vehicles", "--set", "duration_s=30", "-o", "log.mcap").code == 0
    every = ["replay", "log.mcap", "-e", "vehicle-kalman"]
    assert fuselog(*every, "-o", "whole.mcap").code == 0
    assert fuselog(*every, "--end", "12", "-o", "before.mcap").code == 0
    for origin in ("before.mcap", "whole.mcap"):
        later = ["--start", "12", "--start-from", origin, "-o", "after.mcap"]
        assert fuselog(*every, *later).code == 0
        for vehicle in range(1, 6):
            topic = f"/estimates/vehicle-kalman/vehicle{vehicle}/state"
            whole, before, after = (
                read_streams(open_log(f"{name}.mcap"), [topic])[topic]
                for name in ("whole", "before", "after")
            )
            assert len(before) > 10 < len(after)
            assert after.publish_time_ns[0] == SIMULATION_EPOCH_NS + 12 * SECOND
            for field in ("mean", "covariance"):
                assert_array_equal(np.concatenate([before[field], after[field]]), whole[field])


def test_a_start_by_arrival_is_compared_with_the_priors_arrival(
    two_clocks: Path, fuselog: Fuselog
) -> None:
    late = ["replay", two_clocks, "-e", "ekf", "--arrival-order", "--start", "2", "-o", "late.mcap"]
    assert "2 s before" in fuselog(*late).err
    assert fuselog(*late, "--start-from", "truth").code == 0
    first_ns = stamps_of("late.mcap")[0]
    assert WALL + 2 * SECOND <= first_ns < WALL + 2.2 * SECOND
    swapped = [
        replace(each, publish_time_ns=each.log_time_ns, log_time_ns=each.publish_time_ns)
        for each in map(with_two_clocks, landmarks())
    ]
    write_log("swapped.mcap", swapped)
    assert fuselog("replay", "swapped.mcap", *late[2:], "--start-from", "truth").code == 0
    first = read_streams(open_log("late.mcap"), [POSE])[POSE].take(slice(0, 1))
    (truth,) = [each for each in swapped if each.topic == "/robot1/truth"]
    there = truth["state"][np.searchsorted(truth.log_time_ns, first.publish_time_ns[0])]
    assert_allclose(first["mean"][0, :2], there[:2], atol=0.1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--start-from", "truth"], ["--start-from truth", "--start"]),
        (["--start", "30", "--start-from", "zzz.mcap"], ["zzz.mcap", "No such file"]),
        (["--start", "30", "--start-from", "truth", "--start-from", "truth"], ["2 --start-from"]),
        (["--start", "30", "--start-sigma", "x_m=1"], ["--start-sigma", "--start-from truth"]),
        (
            ["--start", "30", "--start-from", "truth", "--start-sigma", "x_m=-1"],
            ["--start-sigma x_m=-1", "positive"],
        ),
        (
            ["--start", "30", "--start-from", "truth", "--start-sigma", "x=1"],
            ["--start-sigma x", "did you mean 'x_m'"],
        ),
        (["--start", "30", "--start-from", "EARLY"], ["ends 20", "before the start"]),
        (["--start", "30", "--start-from", "LATER"], ["no estimate before the start"]),
        (["--start", "30", "--start-from", "OTHER"], ["estimates of landmarks, seed 4"]),
        (["-e", "ukf", "--start", "30", "--start-from", "BOTH"], ["starting ukf", "several"]),
    ],
)
def test_what_cannot_be_started_from(
    arguments: list[str], words: list[str], run_log: Path, fuselog: Fuselog
) -> None:
    """One sentence each, and no estimates."""
    if "EARLY" in arguments:
        assert fuselog("replay", run_log, "-e", "ekf", "--end", "10", "-o", "EARLY.mcap").code == 0
    if "LATER" in arguments:
        later = ["--start", "40", "--start-from", "truth", "-o", "LATER.mcap"]
        assert fuselog("replay", run_log, "-e", "ekf", *later).code == 0
    if "OTHER" in arguments:
        assert fuselog("record", "landmarks", "--seed", "4", "-o", "other.mcap").code == 0
        assert fuselog("replay", "other.mcap", "-e", "ekf", "-o", "OTHER.mcap").code == 0
    places = {name: f"{name}.mcap" for name in ("EARLY", "LATER", "OTHER")}
    places["BOTH"] = str(run_log.with_name("estimates.mcap"))
    given = [places.get(each, each) for each in arguments]
    estimator = [] if "-e" in given else ["-e", "ekf"]
    said = fuselog("replay", run_log, *estimator, *given, "-o", "late.mcap")
    assert said.code == 2
    assert all(word in said.err for word in words), said.err
    assert not Path("late.mcap").exists()


def test_a_truth_without_a_component_of_the_prior_cannot_start_it(fuselog: Fuselog) -> None:
    streams = {stream.topic: stream for stream in landmarks()}
    truth = streams["/robot1/truth"]
    streams["/robot1/truth"] = replace(
        truth,
        columns={**truth.columns, "state": truth["state"][:, :2]},
        metadata={"components": "x_m,y_m", "kinds": "linear,linear"},
    )
    write_log("log.mcap", list(streams.values()))
    start = ["--start", "2", "--start-from", "truth", "-o", "late.mcap"]
    said = fuselog("replay", "log.mcap", "-e", "ekf", *start)
    assert (said.code, "no component heading_rad" in said.err) == (2, True)


def test_the_library_refuses_an_old_prior_too(run_log: Path) -> None:
    log = open_log(run_log)
    assert log.run is not None
    late = LogSource(log, start_ns=log.run.epoch_ns + 30 * SECOND)
    part = RunGroup([late], estimates=[(Path("late.mcap"), run_log)])
    with pytest.raises(BadInput, match="30 s before the span"):
        replay_parts([part], {"ekf": {}}, gap_limit_s=0.2)
    assert not list(Path().iterdir())


def test_a_view_shows_a_span_of_a_log_and_of_estimates(fuselog: Fuselog) -> None:
    """Only what is in it, at its time in the run; the map holds for good."""
    write_log(Path("run.mcap"), *_recorded())
    assert fuselog("replay", "run.mcap", "-e", "dead-reckoning", "-o", "est.mcap").code == 0
    for log in ("run.mcap", "est.mcap"):
        said = fuselog("view", log, "--start", "1", "--end", "2", "--save", f"{log}.rrd")
        assert said.code == 0, said.err
        found = read(Path(f"{log}.rrd"))
        moving = {entity: columns for entity, columns in found.items() if entity.endswith("/pose")}
        assert set(moving) == {
            f"/map/robot1/{name}/pose"
            for name in (("truth", "dead-reckoning") if log == "est.mcap" else ("truth",))
        }
        for columns in moving.values():
            times = np.array(columns["sim_time"])
            assert SECOND <= times.min() < 1.1 * SECOND
            assert 1.9 * SECOND < times.max() <= 2 * SECOND
        assert "/map/landmarks" in read(Path(f"{log}.rrd"), static=True)
    refused = fuselog("view", "run.mcap", "--start", "9", "--save", "none.rrd")
    assert refused.code == 2
    assert "no messages in this span; the log extends from 0 to 4 s" in refused.err
    assert not Path("none.rrd").exists()


def _recorded() -> tuple[list[Stream], RunMetadata]:
    recording, run = record_run("landmarks", {"duration_s": 4.0}, 0)
    return recording.streams, run
