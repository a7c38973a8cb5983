"""The first view of every simulated scenario: one sees what happens, who is where, and who is right."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fuselog.recorders.recording import Simulator, record_run
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.show import show
from tests.replay.timeline.reading import check_first_view, picture_of


class First(NamedTuple):
    """A small run of a scenario and who estimates it."""

    parameters: Mapping[str, Any]
    estimators: Mapping[str, Mapping[str, Any]]


FIRST = {
    "acoustic-shots": First({}, {"shooter:bearings-only": {}, "shooter:native-measurements": {}}),
    "axis": First({"steps": 5}, {"bingham-axis": {}, "kalman-axis": {}}),
    "batch-reactor": First({"steps": 10}, {"ekf": {}}),
    "biometric-scores": First({"users": 20}, {"score-rule": {"subsets": ["face", "all"]}}),
    "car": First({"duration_s": 20.0}, {"ekf": {}, "ukf": {}}),
    "crossing": First({"duration_s": 20.0}, {"tracker:jipda": {}}),
    "extended-target": First({"points": 10}, {"analytic": {}}),
    "ispace": First({"steps": 10}, {"network:naive": {}, "network:ci-trace": {}}),
    "landmarks": First({"duration_s": 2.0}, {"ekf": {}, "ukf": {}}),
    "manoeuvres": First({"duration_s": 20.0}, {"ekf": {}, "imm": {}}),
    "moving-los": First({"duration_s": 4.0}, {"ekf": {}}),
    "navigation": First({"duration_s": 11.0}, {"ekf": {}, "smoother:ekf": {}}),
    "optical-los": First({}, {"los-biases": {}, "los-positions": {}}),
    "orientation": First({"steps": 5}, {"kalman-orientation": {}}),
    "ranging": First({"duration_s": 2.0}, {"ekf": {"model": "ranging-pose"}}),
    "relative-bearings": First({}, {"set-membership": {}}),
    "shot-sequence": First({"shots": 4}, {"ekf": {}}),
    "sound-source": First({}, {"ekf": {}}),
    "torus-headings": First({"steps": 5}, {"torus": {}, "ukf-torus": {}}),
    "vehicles": First({"duration_s": 5.0}, {"vehicles:hungarian-topology": {}, "gm-phd": {}}),
}


def test_every_simulated_scenario_has_a_first_view() -> None:
    scenarios = {each: load("recorders", each) for each in available("recorders")}
    assert set(FIRST) == {name for name, each in scenarios.items() if isinstance(each, Simulator)}


@pytest.mark.paper
@pytest.mark.parametrize("scenario", FIRST)
def test_the_first_view_shows_all_at_a_size_that_can_be_read(scenario: str, tmp_path: Path) -> None:
    first = FIRST[scenario]
    source = memory_source(*record_run(scenario, dict(first.parameters), 7))
    bound = [each for name, own in first.estimators.items() for each in bind(name, [source], dict(own))]
    outputs = collect(replay([source], bound))
    errors = [each for each in Judge([source], {}, gap_limit_s=2.0).add(outputs).errors if each]
    show(source, outputs, errors, save=tmp_path / "run.rrd")
    check_first_view(picture_of(tmp_path / "run.rrd"))
