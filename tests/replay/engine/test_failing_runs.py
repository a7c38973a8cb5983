"""A run that fails ends alone, with its time and reason, whatever the estimator."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.pipeline.runs import ensemble
from fuselog.pipeline.runs.ensemble import RunGroup
from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, RunMetadata, Stream, make_stream, open_log, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.api.functions import batch, each_run, recursive
from fuselog.replay.engine.api.inputs import Floats, Given, Integers, Messages
from fuselog.replay.engine.api.outputs import Estimates, Results
from fuselog.replay.engine.replaying.estimator import Batch, Estimator, Recursive
from fuselog.replay.engine.replaying.replaying import Report, collect, replay
from fuselog.replay.engine.replaying.soundness import (
    FOREVER,
    LANES,
    SOUND,
    unsound_over_runs,
    work_space,
)
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.failures import Failure, failure_stream, sentences_of
from fuselog.replay.engine.streams.results import failures_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source, memory_source
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import Output
from fuselog.replay.judging.metrics.metrics import COVERAGE

STEP_NS = 10**8
COUNT = 200
# What a bearing of this number makes a filter do, from there on or at once.
NAN_COVARIANCE, INDEFINITE, SILENT, RAISE, BEYOND, BRIEFLY_SILENT = range(1, 7)
AT = 120


class State(NamedTuple):
    """What went wrong so far."""

    mode: Integers
    mean: Floats


def start(given: Given[Parameters]) -> tuple[Floats, State]:
    return np.zeros(3), State(np.zeros(given.runs, np.int64), np.zeros((given.runs, 2)))


def follow(run: int, table: Floats, messages: Messages, state: State, results: Results) -> None:
    """A mean of all bearings, and a covariance of two components; target_id is what goes wrong."""
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        mode = int(messages.value[row, 0])
        if mode > 0:
            state.mode[run] = mode
        if mode == BEYOND:
            state.mean[run, 0] += table[5]
        if mode == RAISE:
            raise ZeroDivisionError
        if state.mode[run] == SILENT or (state.mode[run] == BRIEFLY_SILENT and row % COUNT < AT + 50):
            continue
        state.mean[run, 0] += 0.1 * messages.value[row, 1]
        wrong = state.mode[run]
        for i in range(2):
            results.mean[row, i] = state.mean[run, i]
            for j in range(2):
                results.covariance[row, i, j] = 2.0 if i == j else 3.0 * (wrong == INDEFINITE)
                if wrong == NAN_COVARIANCE:
                    results.covariance[row, i, j] = math.nan


def make_filter(*, compiled: bool = False) -> Estimator[Parameters]:
    return recursive(
        "a filter that fails on command",
        parameters=Parameters,
        streams={"bearing": schemas.BEARING},
        static={"/landmarks": schemas.LANDMARK},
        components={"a_m": "linear", "b_m": "linear"},
        start=start,
        follow=follow,
        compiled=compiled,
    )


def make_run(mode: int = 0, count: int = COUNT) -> MemorySource:
    target = np.zeros(count, np.int64)
    target[AT : AT + 1] = mode
    bearing = make_stream(
        "/bearing",
        schemas.BEARING,
        STEP_NS * np.arange(count),
        target_id=target,
        bearing_rad=np.cos(np.arange(count)),
    )
    landmark = make_stream("/landmarks", schemas.LANDMARK, [0], landmark_id=[1], position_m=[[0.0, 0.0]])
    return memory_source(Recording([bearing, landmark], 0), RunMetadata("test"))


def run(
    estimator: Estimator[Any], runs: list[Source], **options: int
) -> tuple[dict[str, Ragged], list[float | None]]:
    report = Report()
    bound = estimator.bind("m", runs[0].topics, estimator.parameters())
    out = collect(replay(runs, bound, report=report, **options))
    assert report.seconds["m"] > 0
    return out, [
        COVERAGE.of(Output("", "", "coverage", each, [])).get("estimated_share")
        for each in report.coverage
    ]


CASES = {
    NAN_COVARIANCE: "the estimate is no longer finite",
    INDEFINITE: "the covariance is no longer positive definite",
    SILENT: "there is no estimate in the last 8.0 s of the measurements",
    RAISE: "ZeroDivisionError",
    BEYOND: "IndexError: index 5 is out of bounds",
}


@pytest.mark.parametrize("mode", CASES)
def test_a_run_fails_alone_with_time_and_reason(mode: int, tmp_path: Path) -> None:
    """Beside good runs, in memory and from a log in small blocks; its estimates end where it fails."""
    good, bad, other = make_run(), make_run(mode), make_run(count=90)
    path = tmp_path / "bad.mcap"
    with LogWriter(path, bad.run, chunk_bytes=500) as log:
        log.write(bad.streams.values())
    alone, shares = run(make_filter(), [good])
    assert shares == [1.0]
    for source in (bad, LogSource(open_log(path))):
        out, shares = run(make_filter(), [good, source, other], block_messages=20)
        state, failure = out["/estimates/m/state"], out["/estimates/m/failure"]
        assert failure.offsets.tolist() == [0, 0, 1, 1]
        (sentence,) = sentences_of(failure.stream)
        assert CASES[mode] in sentence
        failed = AT - 1 if mode == SILENT else AT
        assert failure.stream.publish_time_ns.tolist() == [failed * STEP_NS]
        assert np.diff(state.offsets).tolist() == [COUNT, AT, 90]
        whole = alone["/estimates/m/state"]["mean"]
        assert_array_equal(state.of_run(0)["mean"], whole)
        assert_array_equal(state.of_run(1)["mean"], whole[:AT])
        spans = np.array([COUNT - 1, COUNT - 1, 89])
        assert shares == [pytest.approx((spans.sum() - (COUNT - AT)) / spans.sum())]


def test_a_pause_is_no_failure_and_no_part_of_what_was_estimated() -> None:
    """Five seconds without an estimate among twenty."""
    out, shares = run(make_filter(), [make_run(BRIEFLY_SILENT)])
    assert not len(out["/estimates/m/failure"])
    assert shares == [pytest.approx((COUNT - 1 - 51) / (COUNT - 1))]


def test_what_raises_in_every_run_is_bad_input() -> None:
    for sources in ([make_run(RAISE)], [make_run(RAISE), make_run(RAISE)]):
        with pytest.raises(BadInput, match="estimator m raised ZeroDivisionError"):
            run(make_filter(), sources)


@pytest.mark.parametrize("switch", ["FUSELOG_UNCOMPILED", "FUSELOG_BOUNDSCHECK"])
def test_an_index_beyond_an_array_is_found_where_it_is_asked_for(
    switch: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In plain Python or compiled with checks; either is another kernel than the one without."""
    monkeypatch.setenv(switch, "1")
    out, _ = run(make_filter(compiled=True), [make_run(), make_run(BEYOND)])
    (sentence,) = sentences_of(out["/estimates/m/failure"].stream)
    assert "IndexError" in sentence
    loop = compile_over_runs(beyond)
    with pytest.raises(IndexError):
        loop(1, np.zeros(3), np.zeros(1))
    monkeypatch.delenv(switch)
    compile_over_runs(beyond)(1, np.zeros(9), np.zeros(1))


def beyond(run: int, table: Floats, found: Floats) -> None:
    found[run] = table[5]


def solve_backwards(streams: Mapping[str, Stream], _: Parameters) -> Estimates:
    """Estimates in order; where a target is named they go back in time, or are no covariance."""
    seen = streams["bearing"]
    times, mode = seen.publish_time_ns.copy(), int(seen["target_id"].max())
    covariance = np.tile(np.eye(2), (len(times), 1, 1))
    if mode == RAISE:
        raise KeyError("shape")
    if mode == NAN_COVARIANCE:
        covariance[AT] = np.nan
    if mode == SILENT:
        times[AT:] -= 5 * STEP_NS
    return Estimates(times, np.zeros((len(times), 2)), covariance)


@pytest.mark.parametrize(
    ("mode", "reason", "kept", "time"),
    [
        (SILENT, "the stamps of its estimates go back", AT, AT - 1),
        (NAN_COVARIANCE, "the estimate is no longer finite", AT, AT),
        (RAISE, "KeyError: 'shape'", 0, COUNT - 1),
    ],
)
def test_a_batch_fails_alone_too(mode: int, reason: str, kept: int, time: int) -> None:
    estimator = batch(
        "all at once",
        parameters=Parameters,
        streams={"bearing": schemas.BEARING},
        static={},
        components={"a_m": "linear", "b_m": "linear"},
        solve=each_run(solve_backwards),
    )
    out, _ = run(estimator, [make_run(), make_run(mode)])
    failure = out["/estimates/m/failure"]
    assert failure.offsets.tolist() == [0, 0, 1]
    assert sentences_of(failure.stream) == [reason]
    assert failure.stream.publish_time_ns.tolist() == [time * STEP_NS]
    assert np.diff(out["/estimates/m/state"].offsets).tolist() == [COUNT, kept]


def test_estimators_of_any_make_are_watched() -> None:
    """One that binds itself and handles all runs at once: the run that makes it raise is found."""

    def advance(state: int, block: Any) -> tuple[int, list[Ragged]]:
        seen = block.streams["/bearing"]
        if (seen["target_id"] == RAISE).any():
            raise np.linalg.LinAlgError("Singular matrix")
        count = len(seen)
        stream = make_stream(
            "/estimates/own/state",
            schemas.GAUSSIAN_ESTIMATE,
            seen.stream.publish_time_ns,
            metadata={"components": "a_m", "kinds": "linear", "truth": ""},
            mean=np.zeros((count, 1)),
            covariance=np.ones((count, 1)),
        )
        return state + 1, [Ragged(stream, seen.offsets)]

    bound = Recursive("own", ("/bearing",), (), len, advance)
    runs = [make_run(), make_run(), make_run(RAISE), make_run()]
    out = collect(replay(runs, [bound]))
    assert np.diff(out["/estimates/own/state"].offsets).tolist() == [COUNT, COUNT, AT, COUNT]
    failure = out["/estimates/own/failure"]
    assert failure.offsets.tolist() == [0, 0, 0, 1, 1]
    assert sentences_of(failure.stream) == ["LinAlgError: Singular matrix"]

    def solve(given: dict[str, Ragged]) -> list[Ragged]:
        return advance(0, type("Block", (), {"streams": given}))[1]

    whole = collect(replay(runs, [Batch("own", ("/bearing",), (), solve)]))
    assert np.diff(whole["/estimates/own/state"].offsets).tolist() == [COUNT, COUNT, 0, COUNT]
    assert sentences_of(whole["/estimates/own/failure"].stream) == ["LinAlgError: Singular matrix"]


def test_what_else_is_said_ends_with_the_estimates() -> None:
    """The innovation of an update whose covariance is none is not told either."""

    def advance(state: int, block: Any) -> tuple[int, list[Ragged]]:
        seen = block.streams["/bearing"]
        time_ns, count = seen.stream.publish_time_ns, len(seen)
        own = make_stream(
            "/estimates/own/state",
            schemas.GAUSSIAN_ESTIMATE,
            time_ns,
            metadata={"components": "a_m", "kinds": "linear", "truth": ""},
            mean=np.zeros((count, 1)),
            covariance=1.0 - 2.0 * (seen["target_id"][:, None] == INDEFINITE),
        )
        beside = make_stream(
            "/estimates/own/solution",
            schemas.SOLUTION,
            time_ns,
            **{name: np.ones(count, np.int64) for name in ("iterations", "converged", "rank", "cost")},
        )
        return state, [Ragged(own, seen.offsets), Ragged(beside, seen.offsets)]

    bound = Recursive("own", ("/bearing",), (), len, advance)
    out = collect(replay([make_run(), make_run(INDEFINITE)], [bound]))
    for leaf in ("state", "solution"):
        assert np.diff(out[f"/estimates/own/{leaf}"].offsets).tolist() == [COUNT, AT]


def test_reasons_may_hold_anything_and_are_merged() -> None:
    parts = [
        failure_stream("/f", [Failure(1, "one; two"), Failure(2, 'a "quote"')]),
        failure_stream("/f", []),
        failure_stream("/f", [Failure(3, "three"), Failure(4, "one; two")]),
    ]
    expected = ["one; two", 'a "quote"', "three", "one; two"]
    assert sentences_of(gather(parts).stream) == expected
    old = make_stream("/f", schemas.FAILURE, [1], metadata={"reasons": "one; two"}, reason=[1])
    with pytest.raises(BadInput, match=r"/f: its reasons are not a JSON list .* replay the log again"):
        sentences_of(old)
    unknown = make_stream("/f", schemas.FAILURE, [1], metadata={"reasons": '["a"]'}, reason=[7])
    joined = gather([unknown, parts[0]]).stream
    assert sentences_of(joined) == ["no reason given", "one; two", 'a "quote"']


def test_logs_of_many_blocks_of_runs_keep_each_its_own_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs that are replayed in parts, each part with other reasons, and judged together."""
    monkeypatch.setattr(ensemble, "RUNS_AT_ONCE", 2)
    estimator = make_filter()
    monkeypatch.setattr(
        ensemble, "bind", lambda label, all_, _: estimator.bind(label, all_[0].topics, Parameters())
    )
    modes = [0, RAISE, INDEFINITE, 0, SILENT, 0, RAISE]  # the last part is one run, which raises
    sources = [make_run(mode) for mode in modes]
    paths = [tmp_path / f"{number}.mcap" for number in range(len(modes))]
    places = [(path, path) for path in paths]
    parts = [
        RunGroup(sources[now], now.start, False, places[now]) for now in ensemble.parts_of(len(sources))
    ]
    judge = ensemble.replay_parts(parts, {"m": {}}, gap_limit_s=0.2).judge
    topics = list(open_log(paths[0]).topics)
    read = [LogSource(open_log(path)).read(topics) for path in paths]
    outputs = {topic: gather([each[topic] for each in read]) for topic in topics}
    again = Judge(sources, gap_limit_s=0.2)
    again.add(outputs)
    said = judge.failures
    assert said == again.failures
    assert len(said) == 4
    for sentence, mode in zip(said, [mode for mode in modes if mode], strict=True):
        assert CASES[mode] in sentence
    bad = [replace(part, sources=[make_run(RAISE)], estimates=()) for part in parts]
    with pytest.raises(BadInput, match="estimator m raised ZeroDivisionError"):
        ensemble.replay_parts(bad, {"m": {}}, gap_limit_s=0.2).check()


@pytest.mark.parametrize(
    ("covariance", "is_sound"),
    [
        ([[4.0, 1.9], [1.9, 1.0]], True),
        ([[1e12, 1e-3], [1e-3, 1e-12]], True),  # units far apart
        ([[4.0, 2.0], [2.0, 1.0]], True),  # singular, as of few particles
        ([[4.0, 2.1], [2.1, 1.0]], False),
        ([[4.0, 1.9], [1.899, 1.0]], True),  # rounded
        ([[4.0, 1.9], [1.89, 1.0]], False),  # not symmetric
        ([[4.0, 0.0], [0.0, -1.0]], False),
        ([[0.0, 0.0], [0.0, 1.0]], True),
        ([[0.0, 0.5], [0.5, 1.0]], False),
        ([[1.0, 1.0, 0.5], [1.0, 1.0, 0.0], [0.5, 0.0, 1.0]], False),
        ([[1.0, math.nan], [math.nan, 1.0]], False),
        ([[1.0, 0.0], [0.0, math.inf]], False),
    ],
)
@pytest.mark.parametrize("others", [0, 2 * LANES])
def test_what_a_covariance_is(covariance: list[list[float]], is_sound: bool, others: int) -> None:
    """Alone, and among others that are tested together with it."""
    size, count, place = len(covariance), others + 1, others // 2
    covariances = np.tile(np.eye(size).ravel(), (count, 1))
    covariances[place] = np.ravel(covariance)
    rows, found = np.full(1, -9), np.full(1, -9)
    unsound_over_runs(
        1,
        np.array([0, count]),
        np.arange(count),
        np.zeros(1, np.int64),
        np.zeros((count, size)),
        covariances,
        rows,
        found,
        scratch=partial(work_space, size),
    )
    assert (found[0] == SOUND) == is_sound
    assert rows[0] == (FOREVER if is_sound else place)


def test_a_failure_is_told_in_its_block_alone() -> None:
    """Of four runs: well, failed before, failed in this block, failed in this block."""
    before, after = np.array([-1, 0, -1, -1]), np.array([-1, 0, 1, 0])
    found = failures_of("/estimates/x", before, after, np.arange(10, 14), ["lost", "blind"])
    assert found.offsets.tolist() == [0, 0, 0, 1, 2]
    assert found.stream.publish_time_ns.tolist() == [12, 13]
