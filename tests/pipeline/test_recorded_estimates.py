"""A recording that has estimates of its own, as an autopilot's has: judged, diagnosed, compared."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

import fuselog as fl
from fuselog.recorders.errors import BadInput
from tests.pipeline.conftest import run_here


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that logged what its own filter, which believes its ranges too little, estimated."""
    log = fl.record("landmarks", seed=3, duration_s=20.0)
    done = fl.replay(log, {"theirs": {"kind": "ekf", "sigma_range_m": 1.0}})
    topics = [topic for topic, about in done.estimates[0].topics.items() if about.messages]
    estimates = done.estimates[0].read(topics)
    path = tmp_path_factory.mktemp("recorded") / "flight.mcap"
    fl.write(path, replace(log, streams={**log.streams, **estimates}))
    return path


def test_its_estimates_are_judged_by_its_own_truth(recording: Path):
    said = run_here("evaluate", str(recording))
    assert said.code == 0
    assert re.search(r"position_rmse_m +0\.0", said.out)


def test_its_innovations_say_which_noise_is_wrong(recording: Path):
    found = fl.diagnose(recording, "theirs")
    first = found.sentences[0]
    assert (first.kind, first.where) == ("measurement noise", "/estimates/theirs/robot1/innovation")
    assert "range_m are" in first.sentence
    assert first.sentence.endswith("its noise is stated too large")
    assert run_here("diagnose", str(recording)).code == 0  # its only one
    with pytest.raises(BadInput, match="theirs was recorded and takes no settings"):
        fl.diagnose(recording, "theirs", set={"sigma_range_m": 1.0})


def test_its_truth_is_interpolated_over_gaps_that_are_allowed(recording: Path):
    """The truth of every second: between two the estimates have none, unless a gap may be that long."""
    log = fl.open(recording)
    streams = log.read([*log.topics])
    truth = streams["/robot1/truth"].take(slice(None, None, 20))
    sparse = fl.MemorySource({**streams, truth.topic: truth}, log.log.run, "sparse", log.start_ns)
    without = {}
    for gap_limit_s in (0.2, 2.0):
        metrics = fl.diagnose(sparse, "theirs", gap_limit_s=gap_limit_s).metrics
        without[gap_limit_s] = metrics.set_index("quantity")["value"]["estimates_without_truth"]
    assert without[2.0] == 0.0 < without[0.2]


def test_ours_is_replayed_and_drawn_beside_them(recording: Path, tmp_path: Path):
    picture = str(tmp_path / "both.rrd")
    said = run_here("compare", str(recording), "-e", "theirs", "-e", "ekf", "--save", picture)
    assert said.code == 0, said.err
    assert "ekf against theirs" in said.out
    drawn = {chunk.entity_path for chunk in RrdReader(picture).stream()}
    assert {"/plots/robot1/error_x_m/theirs", "/plots/robot1/error_x_m/ekf"} <= drawn
    assert fl.diagnose(recording, "ekf").sentences == []
