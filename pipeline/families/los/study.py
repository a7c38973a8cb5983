"""Study of bias estimation from lines of sight, tables I-VIII and figures of Belfadel et al. 2014.

Every scenario is recorded with and without biases under several conditions. The paper does not state the
conditions of its tables, so each condition is evaluated separately.
"""

import hashlib
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.families.los.cases import (
    ALONE,
    BLIND,
    JOINT,
    Case,
    LosOptions,
    Printed,
    bias_names,
    observabilities,
    one_bias_known,
    run_case,
)
from fuselog.pipeline.families.los.figures import figures
from fuselog.pipeline.families.los.printed import (
    metrics_beside_print,
    metrics_of_geometry,
    metrics_of_print,
    steepest_deg,
)
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.studies.toolkit.repetitions import require_spread, root_mean_square
from fuselog.recorders.families.los.models import ANGLES


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: LosOptions = setting.options
    require_spread(experiment.runs)
    cases = [
        run_case(experiment, setting, number, name, condition)
        for condition in options.conditions
        for number, name in enumerate(options.scenarios, start=1)
    ]
    outcome = Outcome(figures={**figures(cases, experiment.runs)})
    outcome.tables = {
        "sensors": _table_of_sensors(cases, options.paper),
        "positions": _table_of_positions(cases, options.paper),
        "biases": _table_of_biases(cases, options.paper),
        "nees": _table_of_nees(cases),
        "dilution": _table_of_dilution(cases),
        "observability": _table_of_observability(cases),
    }
    if len(cases[0].scene.position_m) == 2:
        outcome.tables["one-bias-known"] = _table_of_one_bias_known(cases)
    for case in cases:
        outcome.metrics |= _metrics(case) | metrics_beside_print(case, options.paper)
    for name, condition in options.conditions.items():
        outcome.metrics[f"condition.bias_deg.{name}"] = condition.bias_deg
        outcome.metrics[f"condition.sigma_mrad.{name}"] = 1e3 * condition.sigma_rad
    first = [case for case in cases if case.condition == cases[0].condition]
    for case in first:
        outcome.metrics |= metrics_of_geometry(case, options.paper)
    outcome.metrics |= metrics_of_print(options.paper)
    outcome.input_sha256 = hashlib.sha256("".join(c.input_sha256 for c in cases).encode()).hexdigest()
    return outcome


def _table_of_sensors(cases: list[Case], paper: Printed) -> pd.DataFrame:
    """Tabulate the sensors of tables I and V, as printed and as x, y (up), z."""
    rows = [
        (paper.table_of_sensors, case.number, sensor + 1, *printed, *ours)
        for case in cases
        if case.condition == cases[0].condition
        for sensor, (printed, ours) in enumerate(
            zip(paper.sensor_position_m[case.number - 1], case.scene.position_m.tolist(), strict=True)
        )
    ]
    places = [f"{who}_{axis}_m" for who in ("paper", "ours") for axis in ("x", "y", "z")]
    return pd.DataFrame(rows, columns=["table", "scenario", "sensor", *places])


def _table_of_positions(cases: list[Case], paper: Printed) -> pd.DataFrame:
    """Tabulate the RMSE of each target by scenario and scheme, tables II and VI."""
    rows = []
    for case in cases:
        for scheme in (ALONE, BLIND, JOINT):
            printed = paper.position_rmse_m.get(scheme, [])
            for target, ours in enumerate(case.position_rmse_m(scheme)):
                known = printed and case.number == paper.position_scenario
                rows.append(
                    (
                        paper.table_of_positions,
                        case.condition,
                        case.number,
                        scheme,
                        target + 1,
                        printed[target] if known else np.nan,
                        ours,
                    )
                )
    columns = ["table", "condition", "scenario", "scheme", "target", "paper_rmse_m", "ours_rmse_m"]
    return pd.DataFrame(rows, columns=columns)


def _table_of_biases(cases: list[Case], paper: Printed) -> pd.DataFrame:
    """Tabulate RMSE, sigma_CRLB, and the first repetition's mean error, tables III, IV, VII, VIII."""
    parts = []
    for case in cases:
        row = case.number - 1
        error = case.bias_error_mrad
        runs = error.shape[1]
        parts.append(
            pd.DataFrame(
                {
                    "condition": case.condition,
                    "scenario": case.number,
                    "bias": bias_names(case),
                    "paper_rmse_mrad": paper.bias_rmse_mrad[row],
                    "ours_rmse_mrad": root_mean_square(error, (0, 1)),
                    "paper_sigma_mrad": paper.bias_sigma_mrad[row],
                    "ours_sigma_mrad": case.sigma_mrad,
                    "paper_mean_mrad": paper.bias_mean_mrad[row],
                    "ours_mean_mrad": np.nanmean(error[0], axis=0),
                    "paper_bound_mrad": 2.0 * np.array(paper.bias_sigma_mrad[row]) / np.sqrt(paper.runs),
                    "ours_bound_mrad": 2.0 * case.sigma_mrad / np.sqrt(runs),
                    "ours_nees": case.component_nees,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def _table_of_nees(cases: list[Case]) -> pd.DataFrame:
    """Tabulate NEES, one row per repetition, figures 7 and 16."""
    parts = [
        pd.DataFrame(
            {
                "condition": case.condition,
                "scenario": case.number,
                "repetition": np.arange(len(case.nees)) + 1,
                "nees_at_truth": np.nanmean(case.nees, axis=1),
                "nees_at_estimate": np.nanmean(case.nees_at_estimate, axis=1),
            }
        )
        for case in cases
    ]
    return pd.concat(parts, ignore_index=True)


def _table_of_dilution(cases: list[Case]) -> pd.DataFrame:
    """Tabulate GDOP of every target and sensor, figures 9 and 18."""
    rows = [
        (case.condition, case.number, target + 1, sensor + 1, value)
        for case in cases
        for (target, sensor), value in np.ndenumerate(case.dilution())
    ]
    return pd.DataFrame(rows, columns=["condition", "scenario", "target", "sensor", "gdop"])


def _table_of_observability(cases: list[Case]) -> pd.DataFrame:
    """Tabulate ranks for scheme 3: with all biases, other numbers of targets, or sensors in a line."""
    rows = []
    for case in cases:
        if case.condition != cases[0].condition:
            continue
        for what, found in observabilities(case).items():
            rows.append((case.number, what, found.rank, found.parameters, found.sentence))
    return pd.DataFrame(rows, columns=["scenario", "what", "rank", "parameters", "sentence"])


def _table_of_one_bias_known(cases: list[Case]) -> pd.DataFrame:
    """Tabulate standard deviations of all biases (columns) in mrad, if one of them (row) is known."""
    parts = []
    for case in cases:
        if case.condition == cases[0].condition:
            sensors = range(1, len(case.scene.position_m) + 1)
            names = [f"{angle}{sensor}" for sensor in sensors for angle in ANGLES]
            table = pd.DataFrame(one_bias_known(case), columns=[f"sigma_{name}_mrad" for name in names])
            table.insert(0, "known", names)
            table.insert(0, "scenario", case.number)
            parts.append(table)
    return pd.concat(parts, ignore_index=True)


def _metrics(case: Case) -> dict[str, Any]:
    name = f"{case.condition}-{case.number}"
    values: dict[str, Any] = {
        f"{JOINT}.nees_at_truth.{name}": float(np.nanmean(case.nees)),
        f"{JOINT}.nees_at_estimate.{name}": float(np.nanmean(case.nees_at_estimate)),
        f"{JOINT}.bias_rmse_mrad.{name}": root_mean_square(case.bias_error_mrad, (0, 1)).tolist(),
        f"{JOINT}.bias_sigma_mrad.{name}": case.sigma_mrad.tolist(),
        f"{JOINT}.component_nees.{name}": case.component_nees.tolist(),
        f"{JOINT}.parameters.{name}": float(len(case.truth)),
        f"{JOINT}.repetitions.{name}": float(len(case.nees)),
        f"scene.steepest_deg.{name}": steepest_deg(case),
    }
    for scheme in (ALONE, BLIND, JOINT):
        values[f"{scheme}.position_rmse_m.{name}"] = case.position_rmse_m(scheme).tolist()
        values[f"{scheme}.converged_share.{name}"] = case.converged[scheme]
        values[f"{scheme}.most_iterations.{name}"] = float(case.iterations[scheme])
    return values


LOS = Study(
    "positions and attitude biases from lines of sight, compared with the paper's tables",
    study,
    LosOptions,
)
