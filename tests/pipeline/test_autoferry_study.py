"""The Autoferry experiment as it ships, and what its claims stand on."""

from pathlib import Path

import pandas as pd
import pytest

from pipeline.experiment import load_experiment, run_experiment
from recorders.errors import BadInput


@pytest.mark.paper
def test_as_shipped(autoferry: Path, tmp_path: Path):
    """The reference rows of the sheet, within its tolerances or better; bearings add nothing.

    Going back for late scans gives the tracks in order; a tracker that waits for them is judged by what
    it knew a second before.
    """
    name, experiment = load_experiment("autoferry", {}, {})
    result = run_experiment(name, experiment, tmp_path / "out", data=autoferry, logs=1)
    verdicts = [claim.verdict for claim in result.claims]
    assert verdicts == [
        *["confirmed"] * 4,
        *["refuted"] * 3,
        "confirmed",
        *["refuted"] * 2,
        *["confirmed"] * 3,
    ]
    rows = {
        "jipda-radar-lidar": 9.16,
        "jipda-all": 9.76,
        "jipda-radar": 9.30,
        "jipda-lidar": 11.89,
        "jipda-radar-no-lag": 12.05,
        "hungarian-radar-lidar": 9.32,
        "hungarian-all": 9.62,
        "hungarian-radar": 9.07,
        "hungarian-lidar": 11.81,
    }
    for label, theirs_m in rows.items():
        assert result.metrics[f"{label}.gospa_m"] < theirs_m + 1.0, label
    for label in ("jipda-radar-lidar", "jipda-all"):
        figures = {each: result.metrics[f"{label}.late_gospa_m.{each}"] for each in ("wait", "rewind")}
        assert figures["rewind"] == pytest.approx(result.metrics[f"{label}.gospa_m"], abs=0.05)
        assert figures["wait"] > figures["rewind"]
        assert result.metrics[f"{label}.from_in_order_m.drop"] is None
        assert 0.2 < result.metrics[f"{label}.nis_per_component.radar"] < 1.0
    table = pd.read_csv(tmp_path / "out" / "tables" / "scenarios.csv")
    assert len(table) == 6 * len(experiment.estimators)
    assert (tmp_path / "out" / "timeline.rrd").exists()


def test_other_estimators_are_refused(autoferry: Path, tmp_path: Path):
    over = {"estimators": {"gm-phd": {"sensor": "radar", "variance_m2": 25.0}}}
    name, experiment = load_experiment("autoferry", {}, over)
    with pytest.raises(BadInput, match="gm-phd gives no tracks"):
        run_experiment(name, experiment, tmp_path / "out", data=autoferry / "scenario2")
