"""Values that cannot be, in every scenario's streams, and pages of what could not be computed."""

import math
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.output.report import empty_cells, write_report
from fuselog.pipeline.output.results import Outcome, write_outcome
from fuselog.pipeline.output.terminal import format_value
from fuselog.recorders.log import write_log
from tests.faults.planted import NOT_A_NUMBER, QUICK, Planted, complaints, in_order, recorded
from tests.pipeline.conftest import Said

SAMPLE = in_order(np.random.default_rng(4))


@pytest.mark.paper
def test_no_value_that_cannot_be_makes_a_command_stumble() -> None:
    """One kind of value in each field of every schema; each kind and each scenario is somewhere.

    `info`, whose checks are those of `lint`, gets each kind and each scenario.
    """
    schemas = {(schema_of(each), each.field): each for each in reversed(SAMPLE)}
    first = [*schemas.values(), *SAMPLE]
    kinds = {each.kind: each for each in reversed(first)}
    scenarios = {each.scenario: each for each in reversed(first)}
    assert len(schemas) > 50
    chosen = dict.fromkeys(schemas.values(), QUICK[1:])
    chosen |= dict.fromkeys((*kinds.values(), *scenarios.values()), QUICK)
    assert [wrong for each, lines in chosen.items() for wrong in complaints(each, lines)] == []


def schema_of(planted: Planted) -> str:
    return recorded(planted.scenario)[0][planted.topic].schema.full_name


@pytest.mark.paper
@pytest.mark.parametrize(
    ("planted", "command"),
    [
        (Planted("landmarks", "/landmarks", "", "none"), "view LOG --save NEW.rrd"),
        (Planted("manoeuvres", "/vehicle1/fix", "position_m", "nan"), "view LOG --save NEW.rrd"),
        (Planted("optical-los", "/sensor1/attitude", "", "none"), "view LOG --save NEW.rrd"),
        (Planted("torus-headings", "/headings", "", "none"), "view LOG --save NEW.rrd"),
        (Planted("crossing", "/radar/detection", "position_m", "inf"), "view LOG --save NEW.rrd"),
        (Planted("vehicles", "/vehicle1/truth", "", "one"), "view LOG --save NEW.rrd"),
        (Planted("manoeuvres", "/vehicle1/truth", "", "none"), "diagnose LOG -e ekf"),
        (Planted("vehicles", "/network/detection", "", "one"), "diagnose LOG -e ESTIMATOR"),
        (Planted("landmarks", "/robot1/odometry", "", "years"), "diagnose LOG -e ekf"),
        (Planted("landmarks", "/robot1/truth", "state", "1e200"), "run LOG -e ekf --out NEW/result"),
    ],
)
def test_what_is_missing_or_left_out_is_drawn_and_diagnosed(planted: Planted, command: str) -> None:
    assert complaints(planted, [command]) == []


def test_what_is_left_out_is_said_and_spoils_no_figure(
    fuselog: Callable[..., Said], tmp_path: Path
) -> None:
    """A range, a truth and a landmark that cannot be, and odometry whose clock begins at 0."""
    run = fl.record("landmarks", seed=7, duration_s=4.0)

    def changed(topic: str, field: str, row: int, value: float) -> Any:
        column = run.streams[topic][field].copy()
        column[row] = value
        return replace(run.streams[topic], columns={**run.streams[topic].columns, field: column})

    streams = {
        **run.streams,
        "/robot1/range_bearing": changed("/robot1/range_bearing", "range_m", 5, np.inf),
        "/robot1/truth": changed("/robot1/truth", "state", 40, 1e160),
        "/landmarks": changed("/landmarks", "position_m", 3, 1e308),
    }
    write_log(tmp_path / "whole.mcap", run.streams.values(), run.run)
    write_log(tmp_path / "bad.mcap", streams.values(), run.run)
    said = {}
    for name in ("whole", "bad"):
        log, out = tmp_path / f"{name}.mcap", tmp_path / f"{name}.est.mcap"
        said[name] = fuselog("replay", log, "-e", "ekf", "-o", out, "--json").json
    losses = " ".join(said["bad"]["losses"])
    for words in (
        "/robot1/range_bearing: 1 message is left out: range_m is infinite",
        "/robot1/truth: 1 message is left out: state x_m is 1e+160, but can be at most 1e+12",
        "/landmarks: 1 message is left out: position_m is 1e+308, but can be at most 1e+12",
    ):
        assert words.split(": ", 1)[0] in losses
        assert words.split(": ", 1)[1] in losses
    drawn = fuselog("view", tmp_path / "bad.mcap", "--save", tmp_path / "bad.rrd").out
    assert "/robot1/range_bearing: 1 message is left out: range_m is infinite" in " ".join(drawn.split())
    told = fuselog("diagnose", tmp_path / "bad.mcap", "-e", "ekf", "--json").json["notes"]
    assert "/robot1/range_bearing: 1 message is left out: range_m is infinite" in told
    metrics, whole = said["bad"]["metrics"], said["whole"]["metrics"]
    assert metrics["ekf.estimates_without_truth.robot1"] == 0
    for name in ("position_rmse_m", "nees"):
        assert metrics[f"ekf.{name}.robot1"] == pytest.approx(whole[f"ekf.{name}.robot1"], rel=0.5)


@pytest.mark.paper
def test_no_warning_of_numpy_reaches_standard_error(tmp_path: Path) -> None:
    rows = [f"{k} {1e200 * k} 0 0 0 0 1e200 1e200\n" for k in range(9)]
    (tmp_path / "line.tum").write_text("".join(rows))
    with pytest.raises(fl.BadInput, match="not of unit length"):  # a warning is an error here
        fl.read_trajectory(tmp_path / "line.tum")
    program = Path(sys.executable).with_name("fuselog")
    command = [program, "evaluate", "line.tum", "--truth", "line.tum"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Warning" not in ended.stderr
    assert ended.returncode in (0, 2)
    assert len(ended.stderr.splitlines()) == (ended.returncode == 2)


def test_no_warning_of_numpy_reaches_who_calls_from_python() -> None:
    log = fl.record("landmarks", seed=3, duration_s=10.0, fix={"rate_hz": 5.0})
    wheels = log.streams["/robot1/odometry"]
    speed = wheels["forward_mps"].copy()
    speed[20] = 1e200
    wheels = replace(wheels, columns={**wheels.columns, "forward_mps": speed})
    log = replace(log, streams={**log.streams, "/robot1/odometry": wheels})
    with warnings.catch_warnings(record=True) as caught:
        warnings.resetwarnings()  # those of Python as it begins would show a warning
        fl.tune(log, "ekf", "sigma_range_m")
    assert [str(each.message) for each in caught] == []


class Cells(HTMLParser):
    """Collects the texts of a page's table cells."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[str] = []
        self._is_cell = False

    def handle_starttag(self, tag: str, attrs: Any) -> None:  # noqa: ARG002
        """Begin a cell, or go on with one."""
        self._is_cell = tag in ("td", "th") or (self._is_cell and tag in ("b", "small"))
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_data(self, data: str) -> None:
        """Take the text of a cell."""
        if self._is_cell:
            self.cells[-1] += data


def test_a_page_has_neither_nan_nor_inf_and_says_why_cells_are_empty(tmp_path: Path) -> None:
    table = pd.DataFrame(
        {
            "case": ["a", "b", "c"],
            "error_m": [0.5, math.nan, math.inf],
            "count": pd.array([1, None, 3], dtype="Int64"),
        }
    )
    metrics = {"ekf.position_rmse_m": math.nan, "ekf.nees": math.inf, "ekf.failed_runs": 1}
    (tmp_path / "result").mkdir()
    write_outcome(
        tmp_path / "result", "landmarks", {}, Outcome(metrics=metrics, tables={"errors": table})
    )
    write_report([tmp_path / "result"], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    parser = Cells()
    parser.feed(page)
    assert "0.5" in parser.cells
    assert [cell for cell in parser.cells if NOT_A_NUMBER.search(cell)] == []
    assert not re.search(r'data-value="-?(nan|inf)"', page)
    for note in empty_cells(table):
        assert note in page
    assert empty_cells(table) == [
        "2 cells without a value: no input data.",
        "1 cell without a value: the result is infinite.",
    ]
    assert format_value([1.0, math.nan]) == "1 \u2013"


def test_no_stored_result_or_page_of_the_documents_has_nan_or_inf() -> None:
    """Claims and metrics that are kept, and the tables that are made of them."""
    folder = Path("docs", "families")
    for path in (*folder.glob("results/*.json"), *folder.glob("*.md")):
        lines = path.read_text(encoding="utf-8").splitlines()
        table = [line for line in lines if path.suffix == ".json" or line.startswith("|")]
        assert [
            line for line in table if re.search(r"(?<![\w-])(nan|NaN|inf|Infinity)(?![\w-])", line)
        ] == []
