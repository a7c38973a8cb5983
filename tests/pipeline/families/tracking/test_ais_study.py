"""The AIS experiment from file to result: metrics, tables, claims, timeline."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rerun.chunk

from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput

pytestmark = pytest.mark.usefixtures("blank_figures")

HEADER = "Time,MMSI,Latitude_degrees,Longitude_degrees,COG_degrees,SOG_knots"


def table(folder: Path, *, reports: int = 60, far: bool = False) -> Path:
    """Two vessels that pass each other; one report may be far off."""
    rows = []
    for step in range(reports):
        time = pd.Timestamp("2020-05-01") + pd.Timedelta(seconds=10 * step)
        moved = 7e-4 * step
        rows.append(f"{time},1,{59.0:.6f},{10.0 + moved:.6f},90,7.7")
        latitude = 40.0 if far and step == 30 else 59.002
        rows.append(f"{time},2,{latitude:.6f},{10.04 - moved:.6f},270,7.7")
    path = folder / "ais.csv"
    path.write_text("\n".join([HEADER, *rows]))
    return path


def run(data: Path, out: Path, settings: dict | None = None):
    name, experiment = load_experiment("ais", settings or {}, {})
    return run_experiment(name, experiment, out, data=data, logs=1)


def test_from_table_to_claims_and_timeline(tmp_path: Path):
    """Both keep their track but for the report that is far off; the timeline has all reports."""
    result = run(table(tmp_path, far=True), tmp_path / "out")
    assert result.metrics["report-tracker.judged_targets"] == 2
    assert result.metrics["report-tracker.own_track_mean_percent"] == pytest.approx(100 * 119 / 120)
    assert [claim.verdict for claim in result.claims] == ["no verdict"] * 2  # it is not the Solent
    assert result.claims[0].ours == "100.0 %"
    vessels = pd.read_csv(tmp_path / "out" / "tables" / "vessels.csv")
    own = vessels[vessels["estimator"] == "report-tracker"].set_index("mmsi")
    assert own["tracks"].to_dict() == {1: 1, 2: 2}
    notes = pd.read_csv(tmp_path / "out" / "tables" / "notes.csv")
    assert "wrong positions" in set(notes["what"])
    json.loads((tmp_path / "out" / "result.json").read_text())
    chunks = list(rerun.chunk.RrdReader(str(tmp_path / "out" / "timeline.rrd")).stream())
    drawn = {
        path: sum(c.num_rows for c in chunks if c.entity_path == path and not c.is_static)
        for path in ("/map/report-tracker/reports", "/geodetic/report-tracker/reports")
    }
    assert list(drawn.values()) == [120, 119]


def test_few_reports_decide_nothing(tmp_path: Path):
    """Nothing is confirmed or refuted of vessels that nobody heard often enough."""
    result = run(table(tmp_path, reports=20), tmp_path / "out")
    _, experiment = load_experiment("ais", {}, {})
    claims = decide(experiment.claims, result.metrics, {}, {})
    assert [claim.verdict for claim in claims] == ["not reproducible", "not reproducible"]


def test_settings_reach_the_tracker_and_bad_ones_are_told(tmp_path: Path):
    data = table(tmp_path)
    none = run(data, tmp_path / "none", {"report-tracker": {"births_per_km2_h": 1e12}})
    assert none.metrics["report-tracker.own_track_mean_percent"] < 50
    with pytest.raises(BadInput, match="births_per_km2_h"):
        run(data, tmp_path / "bad", {"report-tracker": {"births_per_km2_h": 0}})


def test_the_solent_meets_its_targets(real_data: Path, tmp_path: Path):
    """The experiment as shipped confirms both claims."""
    result = run(real_data / "solent_ais.csv.xz", tmp_path / "out")
    assert [claim.verdict for claim in result.claims] == ["confirmed", "confirmed"]
    assert result.metrics["report-tracker.kept_track_percent"] >= 70
    assert np.all([value is not None for value in result.metrics.values()])


@pytest.mark.paper
def test_on_the_command_line_block_by_block(
    tmp_path: Path, fuselog: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    """Import tells what was found; a replay from the log and its evaluation agree."""
    monkeypatch.chdir(tmp_path)
    table(tmp_path, far=True)
    said = fuselog("import", "ais", "ais.csv", "-o", "log.mcap")
    assert said.code == 0
    assert "wrong positions: 1 over 50 m/s" in said.out + said.err
    replayed = fuselog("replay", "log.mcap", "-e", "report-tracker", "--json").json
    evaluated = fuselog("evaluate", "log.estimates.mcap", "--json").json
    assert replayed["metrics"] == evaluated["metrics"]
    assert replayed["metrics"]["report-tracker.kept_track_percent"] == 100
    part = fuselog(
        "replay", "log.mcap", "-e", "report-tracker", "--start", "5", "--end", "580", "--json"
    )
    assert part.json["metrics"]["report-tracker.judged_targets"] == 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (HEADER, ("ais.csv", "no reports")),
        (f"{HEADER}\n2020-01-01,1,95,0,0,0", ("data row 1", "Latitude_degrees", "'95'", "-90 to 91")),
        ("a,b\n1,2", ("no column Time",)),
    ],
)
def test_bad_tables_end_with_two_and_one_sentence(
    tmp_path: Path, fuselog: Callable[..., Any], content: str, words: tuple[str, ...]
):
    data = tmp_path / "ais.csv"
    data.write_text(content)
    said = fuselog("run", "ais", "--data", str(data), "--out", str(tmp_path / "out"))
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert all(word in said.err for word in words)
    assert not (tmp_path / "out").exists()
