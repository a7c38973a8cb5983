"""Every shipped experiment that needs no data of others runs, and its result is reported and viewed."""

import re
from collections.abc import Callable
from contextlib import chdir
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fuselog.pipeline.calibrating import study as calibration
from fuselog.pipeline.calibrating.manoeuvres import drive
from fuselog.pipeline.output.results import read_result
from fuselog.pipeline.runs.inputs import shipped
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.sensing import study as sensing
from tests.claims.few_runs import opposite
from tests.claims.pages import as_shipped
from tests.pipeline.conftest import assert_whole

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]

Fuselog = Callable[..., Any]

# the smallest form of each: its options of `run`, then what --set sets
SMALLEST: dict[str, tuple[str, ...]] = {
    "acoustic-sequence": ("--runs 2", "shots=2", "mixture.kind=particles:20"),
    "calibration": ("--runs 1", "options.seeds=[3000]", "options.motions=[]"),
    "diagnosis": ("--runs 1", 'options.faults=["landmarks-bias"]', "options.battery_runs=0"),
    "ellipsoid": ("--runs 1", "options.seeds=[5000]"),
    "false-causes": ("--runs 1", "options.to_fix=[1.0]", "options.to_compass=[0.0]"),
    "faults-together": ("--runs 1", "options.pairs=1", "options.triples=1"),
    "imu-grades": ("--runs 1", "duration_s=22", "gnss.outages_s=[[10, 21]]", "unit.rate_hz=20"),
    "landmarks": ("--runs 1", "duration_s=2"),
    "los-moving": ("--runs 1", "duration_s=1.1"),
    "los-two-sensors": ("--runs 2", "passes=1"),
    "manoeuvres": ("--runs 1", "duration_s=2"),
    "navigation-heading": ("--runs 1", "duration_s=11", "unit.rate_hz=20"),
    "navigation-simulated": ("--runs 1", "duration_s=11", "unit.rate_hz=20"),
    "navigation-unknown-heading": ("--runs 1", "duration_s=11", "unit.rate_hz=20"),
    "sensor-noise": ("--runs 1", "options.seeds=[1000]"),
    "tuning": ("--runs 1", "options.durations_s=[5.0]"),
    "vehicles-ctm4": ("--runs 1", "duration_s=1", "options.few_runs=0"),
    "vehicles-cv": ("--runs 1", "duration_s=1", "options.few_runs=0"),
    "warehouse-uwb": ("--runs 1", "duration_s=2"),
}
# what tests of studies run; their results are reported and viewed by `kept_numbers`
STUDIED = {
    "acoustic": "test_angle_studies",
    "bingham-2d": "families/directional/test_bingham_study",
    "bingham-4d": "families/directional/test_bingham_study",
    "biometrics-sequential-simulated": "families/biometrics/test_biometrics_sequential_study",
    "biometrics-simulated": "families/biometrics/test_biometrics_study",
    "crossing": "families/tracking/test_tracking_study",
    "extended-target": "families/sampling/test_linearization_studies",
    "ispace": "families/networks/test_network_studies",
    "ispace-stress": "families/networks/test_stress_studies",
    "lcd-sampling": "families/sampling/test_linearization_studies",
    "los-three-sensors": "test_angle_studies",
    "lrkf-dimension": "families/sampling/test_lrkf_dimension_study",
    "reactor": "families/sampling/test_linearization_studies",
    "relative-bearings": "families/networks/test_network_studies",
    "set-filter": "families/sets/test_set_filter_study",
    "torus-filter": "families/directional/test_torus_studies",
    "torus-propagation": "families/directional/test_torus_studies",
    "vehicles-ctm2": "families/vehicles/test_vehicles_studies",
    "vehicles-scaling": "families/vehicles/test_vehicles_studies",
}
# studies of numbers, without a log to draw
WITHOUT_TIMELINE = {
    "calibration",
    "diagnosis",
    "ellipsoid",
    "false-causes",
    "faults-together",
    "sensor-noise",
    "tuning",
}

DRAW = Runner.draw


def draw_first_case(runner: Runner, sources: Any, outputs: Any, folder: str = "") -> None:
    """Draw the timeline of an experiment, and none of its further cases."""
    if not folder:
        DRAW(runner, sources, outputs)


def test_each_that_ships_its_data_has_a_smallest_form_or_a_study() -> None:
    """Others import data, and `test_report` makes pages of their kept results."""
    assert {*SMALLEST, *STUDIED} == {
        name for name in shipped("experiments") if not as_shipped(name).import_
    }
    for name, file in STUDIED.items():
        text = (Path(__file__).parent / f"{file}.py").read_text(encoding="utf-8")
        assert "run_experiment" in text
        assert re.search(rf'(load_experiment|run)\(\s*"{name}"', text), name


@pytest.mark.parametrize("name", SMALLEST)
def test_its_smallest_form_is_run_reported_and_viewed(
    name: str, tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of faults together the first cause is sought; `test_battery.py` has several at once.

    Cars drive for a quarter of the time; `test_calibrating.py` has a whole drive. A sensor unit rests
    for an eighth of it. Of several cases the timeline of the first is drawn; tests of studies draw those
    of all.
    """
    monkeypatch.setattr("fuselog.pipeline.diagnosing.battery.together.MOST_SENTENCES", 1)
    monkeypatch.setattr(calibration, "drive", partial(drive, duration_s=30.0))
    monkeypatch.setattr(sensing, "SIZE", 8192)
    monkeypatch.setattr(Runner, "draw", draw_first_case)
    runs, *settings = SMALLEST[name]
    smaller = [*runs.split(), *(part for each in settings for part in ("--set", each))]
    with chdir(tmp_path):
        for command in (
            ["run", name, *smaller, "--logs", "1", "--out", "result"],
            ["report", "result", "--out", "page.html"],
        ):
            said = fuselog(*command)
            assert said.code == 0, said.err
        viewed = fuselog("view", "result", "--save", "saved.rrd")
        assert viewed.code == 2 * (name in WITHOUT_TIMELINE), viewed.err
        assert viewed.code or Path("saved.rrd").stat().st_size > 1000
        result = read_result(Path("result"))
        page = Path("page.html").read_text()
    assert_whole(result, page)
    assert opposite(name, result.settings, result.claims) == []
