"""Sums of passes, orders of failures, limits of settings: boundaries that only a direct look shows."""

from collections.abc import Callable
from pathlib import Path
from threading import current_thread, main_thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.report.kinds import _forest
from fuselog.pipeline.runs.ensemble import RUNS_AT_ONCE, Pass, cut_in_parts, in_background
from fuselog.recorders.errors import BadInput
from fuselog.recorders.simulators import landmarks
from fuselog.recorders.simulators.landmarks_parameters import LandmarksParameters
from fuselog.replay.engine.replaying.late import Late, parse_late
from fuselog.replay.engine.replaying.usage import Usage
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.results import failures_by_run


def _pass(**used: int) -> Pass:
    judge: Any = SimpleNamespace(merge=lambda _: None)
    return Pass(judge, {}, usages={name: Usage(name, used=count) for name, count in used.items()})


def test_what_became_of_messages_is_the_sum_over_passes() -> None:
    first = _pass(ekf=1, ukf=5)
    first.merge(_pass(ekf=2, iekf=7))
    assert {name: usage.used for name, usage in first.usages.items()} == {"ekf": 3, "ukf": 5, "iekf": 7}


@pytest.mark.parametrize("blocks", [1, 2, 3, 4])
def test_a_part_says_whether_it_is_all_the_runs(blocks: int) -> None:
    count = blocks * RUNS_AT_ONCE
    parts = list(cut_in_parts([SimpleNamespace()] * count, []))  # type: ignore[list-item]
    assert [each.first_run for each in parts] == list(range(0, count, RUNS_AT_ONCE))
    assert [each.is_all for each in parts] == [blocks == 1] * blocks


@pytest.mark.parametrize("cores", [1, 2])
def test_blocks_are_judged_in_order_on_the_cores_that_there_are(
    cores: int, on_cores: Callable[[int], None]
) -> None:
    """An error in the judge reaches the caller, also for the last block."""
    on_cores(cores)
    done: list[int] = []

    def judge(block: int) -> None:
        assert (current_thread() is main_thread()) == (cores == 1)
        done.append(10 // block)

    with in_background(judge) as hand_over:
        for block in (1, 2, 5):
            hand_over(block)
    assert done == [10, 5, 2]
    with pytest.raises(ZeroDivisionError), in_background(judge) as hand_over:
        hand_over(0)


def test_differences_are_in_percent_of_what_their_margin_is_of() -> None:
    """A margin of .1 is 2 % of 5: a difference of .25 with .05 to either side is 4 to 6 %."""
    row = {"first": "ekf", "second": "ukf", "quantity": "position_rmse_m", "case": "robot1"}
    row |= {"low": 0.2, "difference": 0.25, "high": 0.3, "margin": 0.1}
    found = _forest(pd.DataFrame([row]), 0.02)
    assert found is not None
    *_, ends, middle = found.panels[0].series
    assert (ends.x[:2], middle.x) == (pytest.approx([4.0, 6.0]), pytest.approx([5.0]))


def test_cases_are_named_where_there_are_several() -> None:
    row = {"first": "ekf", "second": "ukf", "quantity": "position_rmse_m", "margin": 0.1}
    row |= {"low": -0.2, "difference": -0.1, "high": 0.0}
    for cases in (["robot1"], ["robot1", "robot2"]):
        chart = _forest(pd.DataFrame([{**row, "case": case} for case in cases]), 0.1)
        assert chart is not None
        ticks = (chart.panels[0].y.ticks or {}).values()
        assert [text.partition(", robot")[1] != "" for text in ticks] == [len(cases) > 1] * len(cases)


def test_a_timeline_is_looked_at_beside_a_result_folder(tmp_path: Path) -> None:
    mine = tmp_path / "mine.rrd"
    mine.write_text("not of ours")
    for folder in (None, tmp_path / "out"):
        with pytest.raises(BadInput, match=r"mine\.rrd"):
            check_outputs(folder, mine, {})


def test_steps_are_rounded_not_cut() -> None:
    """0.29 s at 100 Hz are 28.999999999999996 steps."""
    parameters = LandmarksParameters(robots=1, duration_s=0.29, odometry_rate_hz=100.0)
    streams = landmarks.simulate(parameters, np.random.default_rng(1)).streams
    [truth] = [each for each in streams if each.topic == "/robot1/truth"]
    assert len(truth) == 30


def test_zero_seconds_are_a_window() -> None:
    assert parse_late("wait:0", arrival_order=True) == Late("wait", 0)
    with pytest.raises(BadInput, match="give zero or more seconds"):
        parse_late("wait:-0.001", arrival_order=True)


def test_failures_are_those_of_their_runs_in_any_order() -> None:
    found = failures_by_run("/a", {2: Failure(7, "two"), 0: Failure(5, "none")}, 4)
    assert np.diff(found.offsets).tolist() == [1, 0, 1, 0]
    assert found.stream.publish_time_ns.tolist() == [5, 7]
