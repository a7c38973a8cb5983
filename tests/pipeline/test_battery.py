"""The battery of the sheet of sensors, section 3: cars with one fault each, as new users log them."""

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from pipeline.diagnosing.battery import battery
from pipeline.diagnosing.battery.car import FAULTS, drive, faulty, recorded
from pipeline.diagnosing.likelihood import Likelihood, Trial

OPEN = {"kind": "ekf", "gate_probability": 1.0}
SEED = 2000


def test_the_likelihood_with_a_compass_is_that_of_the_sheet() -> None:
    likelihood, base = Likelihood("ekf"), Trial(recorded(drive(1)), OPEN)
    likelihood.begin(base)
    assert likelihood([base]) == pytest.approx([653.081316], abs=1e-3)


@pytest.mark.parametrize(
    ("fault", "has_compass", "has_prior"),
    [
        ("nothing", False, False),
        ("fixes .3 s late", False, False),
        ("turn rate's sign", False, True),
        ("speed x 3.6", False, True),
        ("lever (2, .6) m", False, False),
        ("E, N exchanged", False, True),
        ("degrees as radians", False, True),
        ("gyro bias .0004 t", False, True),
        ("odometry clock 6 % fast", False, True),
        ("fixes 18 s late", False, True),
        ("half of the odometry lost", False, True),
        ("compass + 4.5 deg", True, True),
        ("compass clockwise from north", True, True),
    ],
)
def test_the_fault_is_named_first(fault: str, has_compass: bool, has_prior: bool) -> None:
    found = battery.tried(battery.Cell(fault, has_compass, has_prior), SEED)
    assert found["is_first"], found["first"]
    right = battery.RIGHT[fault]
    if right and right[0].value is not None:
        assert found["value"] == pytest.approx(right[0].value, rel=0.15)


def test_what_a_log_does_not_tell_apart_is_one_cause_with_two_names() -> None:
    """Without a heading a mirrored turn rate and mirrored fixes are the same, in either order."""
    log = recorded(faulty(SEED, "E, N exchanged"), has_compass=False)
    found = fl.diagnose(log, "ekf", set={"gate_probability": 1.0})
    words = found.sentences[0].words
    assert "turn_radps has the wrong sign" in words
    assert "x and y of position_m are exchanged" in words
    assert "which this log does not tell from it" in words
    assert len(found.sentences) == 1
    assert found.tried["gain"].iloc[0] == pytest.approx(found.tried["gain"].iloc[3])
    assert found.sentences[0].setting == "/car/odometry.turn_scale=-1"


def test_the_battery_is_counted_by_cell() -> None:
    """Every cell is counted by itself, and clean logs beside the others."""
    cells = [*battery.cells(), *battery.cells(has_prior=True)]
    assert len(cells) == 2 * (2 * len(FAULTS) - 2)
    rows = pd.DataFrame(
        {
            "cell": cell.name,
            **cell._asdict(),
            "seed": seed,
            "is_first": seed == 1,
            "gain": 1.0,
            "value": 1.0,
        }
        for cell in cells
        for seed in range(2)
    )
    counted = battery.metrics_of(rows)
    assert counted["diagnosis.battery_first.fixes-3-s-late-compass-prior"] == 1.0
    assert counted["diagnosis.battery_first_share"] == counted["diagnosis.battery_nothing_share"] == 0.5
    assert np.isclose(counted["diagnosis.battery_runs"], 2.0)
