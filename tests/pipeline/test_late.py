"""`--late` from the command line, from an experiment and from Python: the same, and said."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.output.results import read_result
from fuselog.recorders.log import Stream, open_log, read_streams
from fuselog.replay.engine.streams.failures import sentences_of

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
Streams = dict[str, Stream]
LATE = """
duration_s=8 odometry_latency_s=0.03 range_bearing.latency_s=0.2 range_bearing.latency_jitter_s=0.3
bearing.rate_hz=10 bearing.latency_s=0.05 bearing.stamp_offset_s=-0.1
"""
POSE, INNOVATION, SKIPPED, REWOUND = (
    f"/estimates/ekf/robot1/{name}" for name in ("pose", "innovation", "skipped", "rewound")
)


@pytest.fixture
def log(fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot whose messages overtake one another, the control's among them."""
    monkeypatch.chdir(tmp_path)
    settings = [word for each in LATE.split() for word in ("--set", each)]
    assert fuselog("record", "landmarks", "-o", "run.mcap", *settings).code == 0
    return Path("run.mcap")


def replayed(fuselog: Fuselog, out: str, *options: str) -> tuple[Streams, str]:
    """The estimates log, and what the command said."""
    said = fuselog("replay", "run.mcap", "-e", "ekf", "-o", out, *options)
    assert said.code == 0, said.err
    found = open_log(out)
    return read_streams(found, list(found.topics)), said.out + said.err


@pytest.mark.paper
@pytest.mark.usefixtures("log")
def test_going_back_ends_where_the_replay_in_order_does(fuselog: Fuselog) -> None:
    """With a control that is late too, and messages of before the prior."""
    in_order, _ = replayed(fuselog, "ordered.mcap")
    back, _ = replayed(fuselog, "back.mcap", "--arrival-order", "--late", "rewind:3")
    for name in ("mean", "covariance"):
        np.testing.assert_array_equal(back[POSE][name][-1], in_order[POSE][name][-1])
    for name, column in in_order[INNOVATION].columns.items():
        np.testing.assert_array_equal(back[INNOVATION][name], column)
    assert (len(back[SKIPPED]), len(back[REWOUND]) > 50) == (0, True)
    issued = back[POSE]
    assert (np.diff(issued.log_time_ns) >= 0).all()
    assert (issued.log_time_ns > issued.publish_time_ns).all()


@pytest.mark.usefixtures("log")
def test_waiting_is_not_free(fuselog: Fuselog) -> None:
    """The table has how old estimates are: by the wait, where that is longer than all delays."""
    ages = {}
    for late in ("drop", "wait:0.2", "wait:0.9", "rewind:3"):
        options = ("-e", "ekf", "-o", "aged.mcap", "--arrival-order", "--late", late)
        metrics = fuselog("replay", "run.mcap", *options, "--json").json["metrics"]
        ages[late] = metrics["ekf.estimate_age_s.robot1"]
    assert ages["wait:0.9"] == pytest.approx(0.9, abs=0.02)
    assert ages["drop"] < ages["wait:0.2"] < ages["wait:0.9"]
    assert ages["rewind:3"] < ages["wait:0.2"]
    stamped = fuselog("replay", "run.mcap", "-e", "ekf", "-o", "aged.mcap", "--json").json["metrics"]
    assert "ekf.estimate_age_s.robot1" not in stamped


@pytest.mark.paper
def test_every_door_gives_the_same_and_says_what_is_left_out(log: Path, fuselog: Fuselog) -> None:
    found, said = replayed(fuselog, "dropped.mcap", "--arrival-order", "--late", "drop")
    reason = "topic /robot1/range_bearing: it is older than what was used before"
    count = sentences_of(found[SKIPPED]).count(reason)
    assert count > 10
    assert f"ekf robot1: {count} not used: {reason}" in said
    done = fl.replay(log, "ekf", arrival_order=True, late="drop")
    assert any(f"{count} not used: {reason}" in sentence for sentence in done.losses)
    options = ["--arrival-order", "--late", "drop", "--out", "optional"]
    assert fuselog("run", log, "-e", "ekf", *options).code == 0
    Path("late.toml").write_text(
        'title = "late"\narrival_order = true\nlate = "drop"\n'
        f'[logs]\nfiles = ["{log}"]\n[estimators.ekf]\n'
    )
    fl.run("late.toml", out="stated")
    for place in ("optional", "stated"):
        estimates = fl.open(Path(place, "estimates", "run-0000.mcap"))
        np.testing.assert_array_equal(estimates[POSE]["mean"], found[POSE]["mean"])
    np.testing.assert_array_equal(done.estimates[0][POSE]["mean"], found[POSE]["mean"])
    done.save("saved")
    for place in ("optional", "stated", "saved"):
        stated = read_result(Path(place)).settings
        assert (stated["arrival_order"], stated["late"]) == (True, "drop")


@pytest.mark.paper
def test_the_report_counts_what_became_of_late_messages(log: Path, fuselog: Fuselog) -> None:
    """Dropped, inserted with what was repeated for them, waited for: as the streams have them."""
    seen = [fl.open(log)[f"/robot1/{name}"] for name in ("odometry", "range_bearing", "bearing")]
    stamp, arrived = (
        np.concatenate([getattr(each, f"{clock}_time_ns") for each in seen])
        for clock in ("publish", "log")
    )
    order = np.argsort(arrived, kind="stable")
    newest = np.maximum.accumulate(np.append(0, stamp[order]))[:-1]
    is_behind, delay_s = stamp[order] < newest, (arrived - stamp)[order] * 1e-9
    late = ["--logs", "1", "--arrival-order", "--late"]
    for way in ("drop", "wait:0.3", "rewind:3"):
        assert fuselog("run", log, "-e", "ekf", *late, way, "--out", way[:4]).code == 0
    tables = {
        way: pd.read_parquet(Path(way[:4], "tables/late.parquet"))
        for way in ("drop", "wait:0.3", "rewind:3")
    }
    counts = {
        way: dict(zip(each["became"], each["messages"], strict=True)) for way, each in tables.items()
    }
    assert counts["drop"] == {"dropped": is_behind.sum()}
    assert counts["wait:0.3"]["waited for"] == (is_behind & (delay_s <= 0.3)).sum()
    assert 0 < counts["wait:0.3"]["dropped"] <= (is_behind & (delay_s > 0.3)).sum()
    np.testing.assert_allclose(tables["drop"]["late_s"], delay_s[is_behind].mean())
    back = fl.open(Path("rewi", "estimates", "run-0000.mcap"))[REWOUND]
    assert counts["rewind:3"] == {"inserted": len(back)}
    assert tables["rewind:3"]["repeated"].tolist() == [back["repeated"].sum()]
    times = pd.read_parquet(Path("drop", "tables/late-times.parquet"))
    assert times["messages"].sum() == is_behind.sum()
    assert fuselog("report", "drop", "wait", "rewi", "-o", "page.html").code == 0
    page = Path("page.html").read_text()
    for said in (
        f"{is_behind.sum()} dropped",
        f"{len(back)} inserted, {back['repeated'].sum()} reprocessed",
    ):
        assert said in page
