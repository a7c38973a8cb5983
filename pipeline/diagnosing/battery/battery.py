"""A benchmark of how often a diagnosis names the planted fault of a car's log first.

Faults of the inertial unit are found without running a filter.
"""

import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.diagnosing.battery.car import (
    FAULTS,
    UNIT_FAULTS,
    faulty,
    recorded,
    recorded_unit,
    ride,
)
from fuselog.pipeline.diagnosing.causes import Cause, seek
from fuselog.pipeline.diagnosing.findings import FIRST, is_told, of_log
from fuselog.pipeline.runs.ensemble import Progress
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.checks.lint import compared

OPEN = {"kind": "ekf", "gate_probability": 1.0}
ODOMETRY, FIX, HEADING = "/car/odometry", "/car/fix", "/car/heading"
UNIT, VELOCITY = "/car/inertial", "/car/velocity"
UNIT_RUNS = 5  # runs of each fault of the unit per run of a cell; they take a tenth of the time


class Right(NamedTuple):
    """The correct diagnosis, with kind, topic, component, and the value if there is one.

    `spreads` are the standard deviations of the reference implementation's values over runs, with and
    without a compass. For noise, the value is the logarithm of a ratio of standard deviations.
    """

    kind: Kind
    topic: str
    part: str = ""
    value: float = np.nan
    spreads: tuple[float, float] = (np.nan, np.nan)


_FACTOR: Kind = "factor or sign"
_BIAS: Kind = "bias or turned frame"
_NOISE: Kind = "measurement noise"
_OF_FIXES = (0.0359, 0.0363)
RIGHT: dict[str, Right] = {
    "fixes .3 s late": Right("delay", FIX, "", 0.3, (0.00685, 0.0113)),
    "turn rate's sign": Right(_FACTOR, ODOMETRY, "turn_radps", -1.0, (0.0056, 0.00616)),
    "speed x 3.6": Right(_FACTOR, ODOMETRY, "forward_mps", 3.6, (0.00394, 0.00438)),
    "speed / 3.6": Right(_FACTOR, ODOMETRY, "forward_mps", 1.0 / 3.6, (0.000301, 0.000335)),
    "speed x .3048": Right(_FACTOR, ODOMETRY, "forward_mps", 0.3048, (0.000335, 0.000381)),
    "lever (2, .6) m": Right("parameter", "lever_x_m", "lever_x_m", 2.0, (0.0592, 0.133)),
    "fix variance x 4": Right(_NOISE, FIX, "", -np.log(2.0), _OF_FIXES),
    "fix variance / 16": Right(_NOISE, FIX, "", np.log(4.0), _OF_FIXES),
    "sd written as variance": Right(_NOISE, FIX, "", -0.5 * np.log(2.0), _OF_FIXES),
    "E, N exchanged": Right("exchanged axes", FIX, "position_m"),
    "degrees as radians": Right(_FACTOR, ODOMETRY, "turn_radps", 180.0 / np.pi, (0.321, 0.353)),
    "gyro bias .02": Right(_BIAS, ODOMETRY, "turn_radps", 0.02, (0.000998, 0.00112)),
    "gyro bias .0004 t": Right("drifting bias", ODOMETRY, "turn_radps", 0.0004, (3.41e-5, 4.49e-5)),
    "odometry clock 6 % fast": Right("clock drift", ODOMETRY, "", 0.06, (0.000133, 0.000175)),
    "fixes 18 s late": Right("delay", FIX, "", 18.0, (0.00741, 0.028)),
    "half of the odometry lost": Right("lost messages", ODOMETRY),
    "gyro density / 5": Right("process noise", "turn_noise_density", "", np.log(5.0), (0.1885, 0.2255)),
    "compass + 4.5 deg": Right(_BIAS, HEADING, "heading_rad", np.radians(4.5), (0.00165, np.nan)),
    "compass clockwise from north": Right("convention", HEADING, "heading_rad"),
}
# Expected finding for each fault of the unit: kind, topic and number.
UNIT_RIGHT: dict[str, tuple[Kind, str, float] | None] = {
    "nothing": None,
    "accelerometer in g": ("gravity", UNIT, 1.0 / 9.80665),
    "gravity's sign": ("gravity", UNIT, -1.0),
    "turn rate's sign": ("sign", UNIT, -1.0),
    "degrees": ("unit", UNIT, 180.0 / np.pi),
    "mounted 90 deg": ("mounting", UNIT, np.pi / 2.0),
    "mounted 180 deg": ("mounting", UNIT, np.pi),
    "unit late .3 s": ("delay", UNIT, 0.3),
    "E, N exchanged": ("sign", VELOCITY, -1.0),
}

# Pairs of faults in which each fault hides the size of the other.
PAIRS = (
    ("speed x 3.6", "fixes 18 s late"),
    ("E, N exchanged", "speed / 3.6"),
    ("turn rate's sign", "fix variance / 16"),
    ("degrees as radians", "lever (2, .6) m"),
    ("speed x .3048", "compass clockwise from north"),
    ("compass + 4.5 deg", "fixes .3 s late"),
)


class Cell(NamedTuple):
    """A planted fault, and whether the log has a compass and a prior in addition to wheels and fixes."""

    fault: str
    has_compass: bool
    has_prior: bool

    @property
    def name(self) -> str:
        """Return the names of the fault and of the additional sensors."""
        more = [*["compass"] * self.has_compass, *["prior"] * self.has_prior]
        return ", ".join([self.fault, *more])


def cells(*, has_prior: bool = False) -> Iterator[Cell]:
    """Yield a cell with a compass for every fault, and one without it unless the compass is at fault."""
    for has_compass in (True, False):
        for fault in FAULTS:
            if has_compass or not fault.startswith("compass"):
                yield Cell(fault, has_compass, has_prior)


def tried(cell: Cell, seed: int, most: int = 1) -> dict[str, Any]:
    """Plant a fault and search for at most `most` causes."""
    log = recorded(faulty(seed, cell.fault), has_compass=cell.has_compass, has_prior=cell.has_prior)
    seen = [each for each in of_log(log, list(log.streams)) if is_told(each)]
    found = seek(log, "ekf", OPEN, most)
    causes = [list(named_by(cause)) for cause in found.causes]
    known = {one.topic for each in causes for one in each}
    lost = [[Right(each.kind, each.where)] for each in seen if each.kind in FIRST]
    others = [each for each in seen if each.kind not in FIRST and each.where not in known]
    named = [*lost, *causes, *([Right(each.kind, each.where)] for each in others)]
    right = RIGHT.get(cell.fault)
    wanted = right[:3] if right else None
    places = [any(one[:3] == wanted for one in each) for each in named]
    value, gain, within = np.nan, np.nan, np.nan
    for cause in found.causes[:1] if any(places) else ():
        value = next((one.value for one in named_by(cause) if one[:3] == wanted), np.nan)
        gain = cause.gain
    remedies = [cause.hypothesis.remedy(cause.value) for cause in found.causes[:1]]
    if right and np.isfinite(right.value):
        spread = right.spreads[0 if cell.has_compass else 1]
        within = float(abs(value - right.value) < 4.0 * spread)
    return {
        **cell._asdict(),
        "cell": cell.name,
        "seed": seed,
        "is_first": any(places[:1]) if right else not named,
        "is_in_first_two": any(places[:2]) if right else not named,
        "first": " ".join(filter(None, named[0][0][:3])) if named else "",
        "value": value,
        "is_within": within,
        "gain": gain,
        "setting": " ".join(remedy.setting for remedy in remedies if remedy is not None),
    }


def unit_tried(fault: str, seed: int) -> dict[str, Any]:
    """Plant a fault in the unit's log, and test whether it is found without a filter."""
    found = compared(recorded_unit(UNIT_FAULTS[fault](ride(seed))).streams)
    right = UNIT_RIGHT[fault]
    named = [(each.kind, each.where) for each in found]
    return {
        "fault": fault,
        "seed": seed,
        "findings": len(named),
        "is_first": named[:1] == [right[:2]] if right else not named,
        "first": " ".join(named[0]) if named else "",
        "value": abs(found[0].value) if found else np.nan,  # the sign of half a turn has no meaning
    }


def tried_together(faults: Sequence[str], seed: int, *, has_prior: bool = False) -> dict[str, Any]:
    """Plant several faults in a log with a compass, and test whether the causes name all of them."""
    log = recorded(faulty(seed, *faults), has_prior=has_prior)
    found = seek(log, "ekf", OPEN, 3)
    named = {one[:3] for cause in found.causes for one in named_by(cause)}
    return {
        "faults": " + ".join(faults),
        "has_prior": has_prior,
        "seed": seed,
        "are_named": all(RIGHT[fault][:3] in named for fault in faults),
        "first": " ".join(filter(None, next(named_by(found.causes[0]))[:3])) if found.causes else "",
    }


def named_by(cause: Cause) -> Iterator[Right]:
    """Yield the names of a cause, including alternatives that the log does not distinguish."""
    for each in (cause, *cause.others):
        kind, topic = each.hypothesis.kind, each.hypothesis.topic
        for estimate in each.numbers:
            value = np.log(estimate.value) if kind.endswith(" noise") else estimate.value
            yield Right(kind, topic, estimate.name, value)


def results(
    seeds: Sequence[int], progress: Progress
) -> tuple[dict[str, pd.DataFrame], dict[str, float]]:
    """Compute tables and metrics of all cells with and without a prior, all pairs, and unit faults.

    There are more seeds for the inertial unit than for the other logs.
    """
    rows = []
    for cell in [*cells(), *cells(has_prior=True)]:
        rows += [tried(cell, seed) for seed in progress(seeds, cell.name, len(seeds))]
    together = []
    for pair in PAIRS:
        for seed in progress(seeds, " + ".join(pair), len(seeds)):
            together.append(tried_together(pair, seed, has_prior=True))
    of_unit, unit_seeds = [], range(seeds[0], seeds[0] + UNIT_RUNS * len(seeds))
    for fault in UNIT_FAULTS:
        title = f"inertial unit, {fault}"
        of_unit += [unit_tried(fault, seed) for seed in progress(unit_seeds, title, len(unit_seeds))]
    planted, pairs, unit = pd.DataFrame(rows), pd.DataFrame(together), pd.DataFrame(of_unit)
    tables = {
        "battery": summary(planted),
        "battery_runs": planted,
        "battery_pairs": pairs,
        "battery_unit": unit,
    }
    share = float(pairs["are_named"].mean())
    metrics = {**metrics_of(planted), "diagnosis.battery_pairs_share": share}
    return tables, metrics | unit_metrics(unit)


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Count the runs and the correct diagnoses of each cell, with median gain, mean value and spread."""
    by = rows.groupby("cell", sort=False)
    return by.agg(
        runs=("seed", "size"),
        first=("is_first", "sum"),
        within=("is_within", lambda each: each.sum(min_count=1)),
        gain=("gain", "median"),
        value=("value", "mean"),
        spread=("value", "std"),
    ).reset_index()


def metrics_of(rows: pd.DataFrame) -> dict[str, float]:
    """Count, by cell, the runs whose fault is named first, and those whose value is within 4 sigma."""
    found = {
        f"diagnosis.battery_{quantity}.{case_of(row['cell'])}": float(row[quantity])
        for row in summary(rows).to_dict("records")
        for quantity in ("first", "within")
        if np.isfinite(row[quantity])
    }
    clean = rows["fault"] == "nothing"
    return {
        **found,
        "diagnosis.battery_runs": float(rows.groupby("cell")["seed"].size().max()),
        "diagnosis.battery_first_share": float(rows[~clean]["is_first"].mean()),
        "diagnosis.battery_nothing_share": float(rows[clean]["is_first"].mean()),
        "diagnosis.battery_within_share": float(rows["is_within"].mean()),
    }


def unit_metrics(rows: pd.DataFrame) -> dict[str, float]:
    """Count, by fault, how often the unit's fault is found first, with the value's mean and spread."""
    found = {"diagnosis.unit_runs": float(rows.groupby("fault")["seed"].size().max())}
    for fault, own in rows.groupby("fault", sort=False):
        found[f"diagnosis.unit_first.{case_of(str(fault))}"] = float(own["is_first"].sum())
        if own["value"].notna().any():
            found[f"diagnosis.unit_value.{case_of(str(fault))}"] = float(own["value"].mean())
            found[f"diagnosis.unit_spread.{case_of(str(fault))}"] = float(own["value"].std())
    return found


def case_of(cell: str) -> str:
    """Convert a cell's name to the case of a metric."""
    return re.sub(r"[^a-z0-9]+", "-", cell.lower()).strip("-")
