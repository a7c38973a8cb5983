"""The Autoferry experiment as it ships, and what its claims stand on."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from fuselog.pipeline.runs.experiment import Experiment, load_experiment, run_experiment
from fuselog.pipeline.runs.inputs import Recording
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import build
from fuselog.replay.judging.verdicts import Claimed
from tests.claims.pages import FOLDER

pytestmark = pytest.mark.usefixtures("blank_figures")

STORED = json.loads((FOLDER / "autoferry.json").read_text(encoding="utf-8"))
LATE = ("jipda-radar-lidar", "jipda-all")


def test_the_stored_result_is_the_sheets() -> None:
    """The reference rows of the sheet, within its tolerances or better; bearings add nothing."""
    verdicts = [Claimed(claim["verdict"]) for claim in STORED["claims"]]
    assert verdicts == [
        *["confirmed"] * 4,
        *["inconclusive"] * 3,
        "confirmed",
        *["inconclusive"] * 2,
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
        assert STORED["metrics"][f"{label}.gospa_m"] < theirs_m + 1.0, label
    assert_late(STORED["metrics"])
    for label in LATE:
        assert STORED["metrics"][f"{label}.from_in_order_m.drop"] is None
        assert 0.2 < STORED["metrics"][f"{label}.nis_per_component.radar"] < 1.0


def assert_late(metrics: Mapping[str, Any], labels: Sequence[str] = LATE) -> None:
    """Going back for late scans gives the tracks in order; waiting is judged by what it knew before."""
    for label in labels:
        figures = {each: metrics[f"{label}.late_gospa_m.{each}"] for each in ("wait", "rewind")}
        assert figures["rewind"] == pytest.approx(metrics[f"{label}.gospa_m"], abs=0.05)
        assert figures["wait"] > figures["rewind"]


@pytest.mark.paper
def test_one_scenario_is_as_stored(autoferry: Path, tmp_path: Path) -> None:
    """Some of its estimators, of which one goes back for late scans; what all estimate is in a golden.

    `make docs-claims NAMES=autoferry` runs all of them on the six scenarios.
    """
    name, whole = load_experiment("autoferry", {}, {})
    labels = (LATE[0], "hungarian-radar-lidar", "jipda-radar-lidar-smoothed")
    few = {label: whole.estimators[label] for label in labels}
    experiment = whole.model_copy(update={"estimators": few, "options": {"late_estimators": [LATE[0]]}})
    result = run_experiment(name, experiment, tmp_path / "out", data=autoferry / "scenario22", logs=1)
    for label in experiment.estimators:
        stored = STORED["metrics"][f"{label}.gospa_m.scenario22"]
        assert result.metrics[f"{label}.gospa_m"] == pytest.approx(stored, rel=1e-6), label
    assert_late(result.metrics, LATE[:1])
    table = pd.read_csv(tmp_path / "out" / "tables" / "scenarios.csv")
    assert len(table) == len(experiment.estimators)
    assert (tmp_path / "out" / "timeline.rrd").exists()


@pytest.mark.paper
def test_claims_of_one_scenario_have_no_verdict_on_another(
    autoferry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that the published tracker itself misses elsewhere; its numbers are those of the study."""
    monkeypatch.setattr(Runner, "draw", lambda *_, **__: None)  # no timeline is looked at
    label = "hungarian-radar-lidar"
    _, whole = load_experiment("autoferry", {}, {})
    files = {"files": "*.json"}
    digest = Recording(**files).digest_of(sorted((autoferry / "scenario5").iterdir()))
    limit = 1.01 * STORED["metrics"][f"{label}.gospa_m.scenario5"]
    claim = {"sentence": "s", "paper": "p", "value": f"gospa_m[{label}]", "holds": f"value < {limit}"}
    own = {
        "estimators": {label: whole.estimators[label]},
        "recordings": {"scenario5": {**files, "sha256": digest}},
        "claims": [claim, {**claim, "recording": "any"}],
    }
    values = {"title": "mine", "study": "autoferry", "import": {"source": "autoferry"}, **own}
    experiment = build(Experiment, values, "experiment mine.toml")
    found = {}
    for scenario in (autoferry / f"scenario{number}" for number in (3, 5)):
        result = run_experiment("mine", experiment, tmp_path / scenario.name, data=scenario, logs=0)
        found[scenario.name] = [each.verdict for each in result.claims]
        gospa_m = STORED["metrics"][f"{label}.gospa_m.{scenario.name}"]
        assert float(result.claims[0].ours) == pytest.approx(gospa_m, rel=0.01)
    assert found == {"scenario5": ["confirmed", "confirmed"], "scenario3": ["no verdict", "refuted"]}


def test_other_estimators_are_refused(autoferry: Path, tmp_path: Path):
    over = {"estimators": {"gm-phd": {"sensor": "radar", "sigma_m": 5.0}}}
    name, experiment = load_experiment("autoferry", {}, over)
    with pytest.raises(BadInput, match="estimator gm-phd gives no tracks"):
        run_experiment(name, experiment, tmp_path / "out", data=autoferry / "scenario2")
