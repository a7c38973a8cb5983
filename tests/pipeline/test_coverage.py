"""The table `coverage`: what became of every topic; nothing is unused in silence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from recorders.log import Stream, open_log, read_streams, write_log
from recorders.recording import record_run
from tests.pipeline.conftest import Said

SIGHTINGS, MAP, PRIOR = "/robot1/range_bearing", "/landmarks", "/robot1/prior"
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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_as_it_is, ""),
        (_another_map, "{n} of {n} not used: {n} are of targets that the map lacks"),
        (
            _another_topic,
            "ekf: /robot1/front/range_bearing: {n} of {n} not used: the estimator does not",
        ),
        (_infinite, f"ekf: {SIGHTINGS}: 1 are infinite"),
        (_repeated, f"ekf: {SIGHTINGS}: 5 repeat the message before"),
        (_a_landmark_twice, f"ekf: {MAP}: landmark "),
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
    assert (bare["used"], bare["why"]) == (0, "the estimator does not take this topic")
