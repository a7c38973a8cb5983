"""The experiments of cooperative vehicles end to end, small: tables, verdicts that follow from them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from tests.claims.few_runs import as_of_all

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]


def run(name: str, folder: Path, settings: dict[str, Any], runs: int) -> dict[str, Any]:
    label, experiment = load_experiment(name, settings, {"runs": runs})
    run_experiment(label, experiment, folder, logs=1)
    return json.loads((folder / "result.json").read_text())


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """What no claim below is of is small: the straight case, and particles without separate sums."""
    folder = tmp_path_factory.mktemp("vehicles") / "result"
    particles = {
        "particles-set": "set-100",
        "associations": "associations-10",
        "associations-topology": "associations-10-topology",
    }
    options = {
        "few_runs": 2,
        "cases": {"straight": {"duration_s": 5.0}},
        "few": {label: {"kind": f"vehicle-particles:{method}"} for label, method in particles.items()},
    }
    return folder, run("vehicles-ctm2", folder, {"options": options}, 12)


def verdict(result: dict[str, Any], start: str) -> str:
    """The verdict on the one claim that begins so."""
    of_all = as_of_all("vehicles-ctm2", result)
    [found] = [claim.verdict for claim in of_all if claim.claim.startswith(start)]
    return found


def test_ctm2_refutes_what_does_not_hold(turning: tuple[Path, dict[str, Any]]) -> None:
    """Claims with margins wide enough for twelve runs, two for the slow filters."""
    expected = {
        "the topology of the sensor's detections improves": "confirmed",
        "separate sums of x and of y with topology": "refuted",
        "no information is lost": "refuted",
        "with topology, the sensor's pose need not be known; comparison with an estimated pose that is "
        "constant": "refuted",
        "the paper's SME filter, 1000 particles": "refuted",
        "sums of powers and sums of products": "refuted",
        "at least 2 N measurements": "refuted",
    }
    for start, found in expected.items():
        assert verdict(turning[1], start) == found, start


def test_tables_and_metrics_agree(turning: tuple[Path, dict[str, Any]]) -> None:
    """Bounds of the sheet, bytes counted from the log, GOSPA below the error; logs are there."""
    folder, result = turning
    metrics = result["metrics"]
    bounds = pd.read_parquet(folder / "tables" / "bounds.parquet").iloc[0]
    found = bounds[["kalman_exact_m", "topology_bound_m", "free_pose_bound_m", "known_pose_bound_m"]]
    np.testing.assert_allclose(found.astype(float), [1.7404, 1.6653, 1.1616, 0.7984], atol=1e-4)
    sent = {
        label: metrics[f"{label}.sent_bytes_per_step.deterministic"]
        for label in ("kf", "set", "set-topology", "static", "gm-phd")
    }
    assert sent == {"kf": 100, "set": 80, "set-topology": 88, "static": 160, "gm-phd": 80}
    assert metrics["kf.gospa_m.deterministic"] < metrics["kf.total_error_m.deterministic"]
    assert metrics["gm-phd.total_error_m.deterministic"] is None
    assert (folder / "deterministic" / "logs" / "run-0000.mcap").exists()
    assert (folder / "timeline.rrd").stat().st_size > 1000


def test_scaling_tells_methods_apart(tmp_path: Path) -> None:
    """Every method goes as far as it should, in its own place; time and error are there for all."""
    settings = {"duration_s": 2.0, "options": {"vehicles": [2, 7, 10]}}
    result = run("vehicles-scaling", tmp_path / "result", settings, 1)
    table = pd.read_parquet(tmp_path / "result" / "tables" / "scaling.parquet")
    assert len(table) == 8 * 3 - 1  # the collapse over all maps ends at seven vehicles
    assert np.all(table["step_ms"] > 0.0)
    assert set(table[table["place"] == "together"]["estimator"]) == {"set", "particles-set"}
    assert result["metrics"]["hungarian.position_rmse_m.10-vehicles"] < 1.5
