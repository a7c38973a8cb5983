"""The table `coverage`: what became of every topic; nothing is unused in silence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.api.replays import replay
from fuselog.pipeline.output.coverage import sentences
from fuselog.recorders.log import Stream, make_stream, open_log, read_streams, schemas, write_log
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.usage import UNTAKEN, Row, Usage
from fuselog.replay.engine.streams.blocks import gather
from tests.pipeline.conftest import Said

pytestmark = pytest.mark.usefixtures("blank_figures")

SIGHTINGS, MAP, PRIOR, TRUTH = "/robot1/range_bearing", "/landmarks", "/robot1/prior", "/robot1/truth"
Streams = dict[str, Stream]


def changed(stream: Stream, **columns: Any) -> Stream:
    return replace(stream, columns={**stream.columns, **columns})


def _as_it_is(_: Streams) -> None:
    pass


def _another_map(streams: Streams) -> None:
    streams[MAP] = changed(streams[MAP], landmark_id=streams[MAP]["landmark_id"] + 1000)


def _another_topic(streams: Streams) -> None:
    name = "/robot1/front/range_bearing"
    streams[name] = replace(streams.pop(SIGHTINGS), topic=name)


def _infinite(streams: Streams) -> None:
    ranges = streams[SIGHTINGS]["range_m"].copy()
    ranges[3] = np.inf
    streams[SIGHTINGS] = changed(streams[SIGHTINGS], range_m=ranges)


def _repeated(streams: Streams) -> None:
    rows = np.sort(np.r_[np.arange(len(streams[SIGHTINGS])), np.arange(5)])
    streams[SIGHTINGS] = streams[SIGHTINGS].take(rows)


def _a_landmark_twice(streams: Streams) -> None:
    both = streams[MAP].take(np.r_[np.arange(len(streams[MAP])), 0])
    places = both["position_m"].copy()
    places[-1, 0] += 100.0
    streams[MAP] = changed(both, position_m=places)


def _the_truth_at_two_places(streams: Streams) -> None:
    both = streams[TRUTH].take(np.sort(np.r_[np.arange(len(streams[TRUTH])), 7]))
    places = both["state"].copy()
    places[7, 1] += 100.0
    streams[TRUTH] = changed(both, state=places)


def _another_truth(streams: Streams) -> None:
    places = streams[TRUTH]["state"] + [0.0, 100.0, 0.0]
    streams["/robot1/laser"] = replace(changed(streams[TRUTH], state=places), topic="/robot1/laser")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_as_it_is, ""),
        (_another_map, "{n} of {n} not used: {n} measure targets that are not in the map"),
        (
            _another_topic,
            "ekf: /robot1/front/range_bearing: {n} of {n} not used: the estimator does not",
        ),
        (
            _infinite,
            f"ekf: {SIGHTINGS}: 1 of {{n}} not used: 1 message is left out: range_m is infinite",
        ),
        (_repeated, f"ekf: {SIGHTINGS}: 5 repeat the previous message"),
        (_a_landmark_twice, f"ekf: {MAP}: landmark "),
        (
            _the_truth_at_two_places,
            f"ekf: {TRUTH}: a truth is stated twice with the same stamp: y_m differs by up to 100",
        ),
        (
            _another_truth,
            f"ekf: {TRUTH}: /robot1/laser states the truth of the same object and is not used: y_m "
            "differs by up to 100",
        ),
    ],
)
def test_nothing_is_unused_in_silence(
    change: Callable[[Streams], None],
    words: str,
    tmp_path: Path,
    fuselog: Callable[..., Said],
    uncompiled: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    recording, run = record_run("landmarks", {"duration_s": 2.0, "robots": 2}, 0)
    streams = {stream.topic: stream for stream in recording.streams}
    count = len(streams[SIGHTINGS])
    change(streams)
    write_log("run.mcap", list(streams.values()), run)
    said = fuselog("replay", "run.mcap", "-e", "ekf", "-o", "est.mcap", "--json")
    assert said.code == 0
    losses = said.json["losses"]
    assert any(words.format(n=count) in each for each in losses) if words else not losses, losses
    rows = {row["topic"]: row for row in said.json["coverage"]}
    (row,) = (rows[name] for name in rows if name.startswith("/robot1/") and "range" in name)
    innovations = _innovations(Path("est.mcap"))
    assert (row["estimator"], row["used"], row["gated"]) == ("ekf", *innovations)
    assert row["messages"] == count + 5 * (change is _repeated)
    assert row["skipped"] == 0
    evaluated = fuselog("evaluate", "est.mcap", "--json").json
    assert evaluated["coverage"] == said.json["coverage"]
    assert set(losses) == set(evaluated["losses"])


def _innovations(path: Path) -> tuple[int, int]:
    """How many were accepted, and how many were not."""
    log = open_log(path)
    streams = read_streams(log, [topic for topic in log.topics if topic.endswith("robot1/innovation")])
    accepted = np.concatenate([stream["accepted"] for stream in streams.values()] or [np.zeros(0)])
    return int(accepted.sum()), int((accepted == 0).sum())


def test_an_asymmetric_prior_is_refused(tmp_path: Path, fuselog: Callable[..., Said]) -> None:
    """One triangle of it gives another estimate than the other."""
    recording, run = record_run("landmarks", {"duration_s": 2.0}, 0)
    streams = {stream.topic: stream for stream in recording.streams}
    covariance = streams[PRIOR]["covariance"].copy()
    covariance[0, 1] += 0.1 * covariance[0, 0]
    streams[PRIOR] = changed(streams[PRIOR], covariance=covariance)
    write_log(tmp_path / "run.mcap", list(streams.values()), run)
    said = fuselog("replay", tmp_path / "run.mcap", "-e", "ekf", "-o", tmp_path / "est.mcap")
    assert said.code == 2
    assert f"the covariance of {PRIOR} is not symmetric" in said.err


@pytest.mark.paper
def test_a_result_has_the_table_over_all_runs(
    tmp_path: Path, fuselog: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A campaign of several cells adds them up."""
    monkeypatch.chdir(tmp_path)
    command = ("run", "landmarks", "--set", "duration_s=1", "--logs", "0", "--out")
    assert fuselog(*command, "many", "--runs", "130").code == 0
    table = pd.read_parquet("many/tables/coverage.parquet").set_index(["estimator", "topic"])
    ekf = table.loc["ekf", SIGHTINGS]
    assert ekf["used"] + ekf["gated"] == ekf["messages"] > 130
    bare = table.loc["dead-reckoning", SIGHTINGS]
    assert (bare["used"], bare["why"]) == (0, "the estimator does not use this topic")


def test_what_lies_outside_the_span_is_not_counted(
    tmp_path: Path, fuselog: Callable[..., Said], uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of topics that are taken and of others, in a replay and where its estimates are evaluated."""
    monkeypatch.chdir(tmp_path)
    recording, run = record_run("landmarks", {"duration_s": 2.0, "robots": 1}, 0)
    streams = {stream.topic: stream for stream in recording.streams}
    streams["/robot1/rear/range_bearing"] = replace(
        streams[SIGHTINGS], topic="/robot1/rear/range_bearing"
    )
    write_log("run.mcap", list(streams.values()), run)
    said = fuselog("replay", "run.mcap", "-e", "ekf", "--end", "1", "-o", "est.mcap", "--json").json
    elapsed_ns = streams[SIGHTINGS].publish_time_ns - run.epoch_ns
    within = int((elapsed_ns < 1_000_000_000).sum())
    assert 0 < within < len(elapsed_ns)
    assert [row["messages"] for row in said["coverage"]] == [within, within]
    assert fuselog("evaluate", "est.mcap", "--json").json["coverage"] == said["coverage"]


def test_several_sensors_have_a_row_each(uncompiled: None) -> None:
    """The first one looks half a radian aside, and the gate keeps it out."""
    recording, _ = record_run("moving-los", {"duration_s": 3.0}, 0)
    streams = {stream.topic: stream for stream in recording.streams}
    topics = [f"/sensor{number}/moving_line_of_sight" for number in (1, 2, 3)]
    seen = streams[topics[0]]
    streams[seen.topic] = changed(seen, azimuth_rad=seen["azimuth_rad"] + 0.5)
    askew = replace(recording, streams=list(streams.values()))
    rows = replay(askew, {"ekf": {"kind": "ekf", "gate_probability": 0.999}}).coverage
    counts = rows.set_index("topic").loc[topics, ["used", "gated"]].to_numpy().tolist()
    assert counts == [[0, 5], [5, 0], [5, 0]]


@pytest.mark.parametrize("unused", [0, 1])
def test_sensors_of_one_stamp_are_told_apart_where_all_gave_innovations(unused: int) -> None:
    """Else any of them may be the one that gave none, and they share a row."""
    stamps = np.array([10, 20, 30])
    first, second = (
        make_stream(topic, schemas.RANGE, stamps, target_id=[1, 1, 1], range_m=[5.0, 4.0, 3.0])
        for topic in ("/a", "/b")
    )
    given = {
        "/b": gather([replace(second, position=np.array([0, 2, 4]))]),
        "/a": gather([replace(first, position=np.array([1, 3, 5]))]),
    }
    found = make_stream(
        "/estimates/mine/innovation",
        schemas.INNOVATION,
        np.repeat(stamps, 2)[unused:],
        target_id=np.ones(6 - unused, int),
        accepted=[1, 0, 1, 0, 1, 0][unused:],
        innovation=np.zeros((6 - unused, 1)),
        covariance=np.ones((6 - unused, 1)),
        normalised_innovation_squared=np.zeros(6 - unused),
        log_likelihood=np.zeros(6 - unused),
    )
    usage = Usage("mine")
    usage.note_given(given, {})
    usage.note_outputs([gather([found])])
    counted = [(row.topic, row.used, row.gated) for row in usage.rows()]
    assert counted == ([("/a + /b", 2, 3)] if unused else [("/a", 0, 3), ("/b", 3, 0)])


@pytest.mark.paper
def test_sides_of_a_comparison_have_the_table(
    tmp_path: Path, fuselog: Callable[..., Said], uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fuselog("record", "landmarks", "--set", "duration_s=2", "-o", "run.mcap")
    one = fuselog("compare", "run.mcap", "-e", "ekf", "-e", "dead-reckoning", "--json").json["coverage"]
    fuselog("replay", "run.mcap", "-e", "ekf", "-e", "dead-reckoning", "-o", "est.mcap")
    two = fuselog("compare", "est.mcap", "--out", "out", "--json").json["coverage"]
    assert sorted(one, key=str) == sorted(two, key=str)
    assert {row["estimator"]: row["used"] > 0 for row in one} == {"ekf": True, "dead-reckoning": False}
    table = pd.read_parquet("out/tables/coverage.parquet")
    assert table.to_dict("records") == two


def test_topics_that_an_estimator_does_not_take_are_one_sentence() -> None:
    rows = [Row("ekf", f"/gps{n}/fix", 10, 0, 0, 0, UNTAKEN) for n in range(5)]
    rows.insert(2, Row("ekf", "/radar", 10, 8, 0, 0, "they gave no innovation"))
    rows += [Row("ukf", "/radar", 10, 10, 0, 0, ""), Row("ukf", "/odd", 4, 0, 0, 0, UNTAKEN)]
    assert sentences(rows) == [
        "ekf: 5 topics not used: it does not take /gps0/fix, /gps1/fix, /gps2/fix and 2 more",
        "ekf: /radar: 2 of 10 not used: they gave no innovation",
        "ukf: /odd: 4 of 4 not used: the estimator does not use this topic",
    ]
    assert sentences([rows[0]]) == []  # of one that takes no measurements it is its nature
