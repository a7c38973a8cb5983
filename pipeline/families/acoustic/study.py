"""Study of shooter localization: figures 3-23 of Osborne et al. 2014 with our numbers."""

import hashlib
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import skew

from fuselog.pipeline.families.acoustic.cases import (
    CROSS,
    LOCAL,
    NATIVE,
    AcousticOptions,
    Case,
    Maps,
    area_ratios,
    hearing,
    range_errors_m,
    run_case,
)
from fuselog.pipeline.families.acoustic.figures import figures
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.studies.toolkit.repetitions import require_spread
from fuselog.replay.judging.consistency.consistency import component_error_squared, ellipse_area
from fuselog.replay.judging.errors.evaluation import chi_square_interval


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: AcousticOptions = setting.options
    require_spread(experiment.runs)
    pairs = [
        (number, multiplier)
        for number in range(1, len(options.scenarios) + 1)
        for multiplier in options.multipliers
    ]
    cases = [
        run_case(experiment, setting, *pair)
        for pair in setting.progress(pairs, "scenarios and noises", len(pairs))
    ]
    outcome = Outcome(figures=figures(cases, options, experiment.runs))
    outcome.tables = {
        "sweep": _table_of_sweep(cases, experiment.runs),
        "components": _table_of_components(cases),
        "ellipses": _table_of_ellipses(cases),
        "range-errors": _table_of_range_errors(cases),
        "maps": _table_of_maps(options.maps),
    }
    for number in range(1, len(options.scenarios) + 1):
        outcome.metrics |= _metrics([case for case in cases if case.number == number])
    outcome.metrics |= _metrics_of_maps(outcome.tables["maps"])
    hashes = "".join(case.input_sha256 for case in cases)
    outcome.input_sha256 = hashlib.sha256(hashes.encode()).hexdigest()
    return outcome


def _table_of_sweep(cases: list[Case], runs: int) -> pd.DataFrame:
    """Tabulate NEES, RMSE, CRLB and outliers of every mode by noise level, figures 15-21."""
    low, high = chi_square_interval(2, runs)
    rows = [
        (
            case.number,
            case.multiplier,
            label,
            mode.mean_nees,
            float(np.nanmedian(mode.nees)),
            low,
            high,
            mode.rmse_m,
            mode.bound_m,
            mode.far_per_1000,
            mode.converged,
        )
        for case in cases
        for label, mode in case.modes.items()
    ]
    columns = [
        "scenario",
        "multiplier",
        "mode",
        "nees",
        "median_nees",
        "nees_low",
        "nees_high",
        "rmse_m",
        "bound_m",
    ]
    return pd.DataFrame(rows, columns=[*columns, "far_per_1000", "converged_share"])


def _nominal(cases: list[Case]) -> list[Case]:
    return [case for case in cases if case.multiplier == 1.0]


def _table_of_components(cases: list[Case]) -> pd.DataFrame:
    """Tabulate RMSE against sigma_CRLB, mean error and NEES of each parameter at the paper's noise."""
    parts = []
    for case in _nominal(cases):
        for label, mode in case.modes.items():
            error = mode.error.reshape(-1, len(mode.components))
            sigma = np.sqrt(np.diagonal(mode.bound))
            parts.append(
                pd.DataFrame(
                    {
                        "scenario": case.number,
                        "mode": label,
                        "component": mode.components,
                        "rmse": mode.rmse,
                        "sigma": sigma,
                        "mean_error": np.nanmean(error, axis=0),
                        "mean_error_bound": 2.0 * sigma / np.sqrt(len(error)),
                        "nees": np.nanmean(component_error_squared(error, mode.bound), axis=0),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def _table_of_ellipses(cases: list[Case]) -> pd.DataFrame:
    """Tabulate the areas of the 95 % ellipses of the CRLB and of the estimates, figures 6-14."""
    rows = [
        (case.number, label, mode.area_m2, float(ellipse_area(mode.covariance)), mode.bound_m)
        for case in _nominal(cases)
        for label, mode in case.modes.items()
    ]
    columns = ["scenario", "mode", "bound_area_m2", "estimates_area_m2", "bound_m"]
    return pd.DataFrame(rows, columns=columns)


def _table_of_range_errors(cases: list[Case]) -> pd.DataFrame:
    """Tabulate the distributions of the local range estimates, figures 3-5."""
    rows = [
        (case.number, sensor, error.mean(), error.std(), sigma, skew(error))
        for case in _nominal(cases)
        for sensor, (error, sigma) in range_errors_m(case).items()
    ]
    columns = ["scenario", "sensor", "mean_m", "deviation_m", "sigma_r_m", "skew"]
    return pd.DataFrame(rows, columns=columns)


def _table_of_maps(maps: Maps) -> pd.DataFrame:
    """Tabulate bearings-only ellipse areas relative to those of another mode, figures 22 and 23."""
    parts = []
    for label, aim in maps.aims.items():
        x, y, ratio = area_ratios(maps, label, aim)
        grid_x, grid_y = np.meshgrid(x, y)
        columns = {"x_m": grid_x.ravel(), "y_m": grid_y.ravel(), "ratio": ratio.ravel()}
        parts.append(pd.DataFrame({"mode": label, "aim_x_m": aim[0], "aim_y_m": aim[1], **columns}))
    return pd.concat(parts, ignore_index=True)


def _metrics(cases: list[Case]) -> dict[str, Any]:
    """Compute a scenario's metrics at the paper's noise, and list some metrics over all noise levels."""
    values: dict[str, Any] = {}
    name = f"scenario-{cases[0].number}"
    for case in _nominal(cases):
        for label, mode in case.modes.items():
            values |= {
                f"{label}.nees.{name}": mode.mean_nees,
                f"{label}.position_rmse_m.{name}": mode.rmse_m,
                f"{label}.position_bound_m.{name}": mode.bound_m,
                f"{label}.ellipse_area_m2.{name}": mode.area_m2,
                f"{label}.ellipse_area_ratio.{name}": mode.area_ratio,
                f"{label}.far_per_1000.{name}": mode.far_per_1000,
                f"{label}.converged_share.{name}": mode.converged,
            }
        errors = [error for error, _ in range_errors_m(case).values()]
        values |= {
            f"shockwave.heard_by.{name}": hearing(case),
            f"range.skew.{name}": [float(skew(error)) for error in errors],
            f"range.mean_error_m.{name}": [float(error.mean()) for error in errors],
        }
        native = case.modes[NATIVE]
        for component, sigma in zip(native.components, np.sqrt(np.diagonal(native.bound)), strict=True):
            if component.startswith("sensor_"):
                gain = 100.0 * (1.0 - float(sigma) / case.parameters.sigma_position_m)
                values[f"{NATIVE}.sensor_gain_percent.{name}-{component}"] = gain
    for label in (CROSS, LOCAL):
        if label in cases[-1].modes:
            far = cases[-1].modes[label].far_per_1000
            values[f"{label}.far_per_1000_at_most_noise.{name}"] = far
    for label in [each for each in cases[0].modes if all(each in case.modes for case in cases)]:
        swept = [case.modes[label] for case in cases]
        values[f"{label}.nees_by_noise.{name}"] = [mode.mean_nees for mode in swept]
        medians = [float(np.nanmedian(mode.nees)) for mode in swept]
        values[f"{label}.median_nees_by_noise.{name}"] = medians
        values[f"{label}.converged_share_by_noise.{name}"] = [mode.converged for mode in swept]
        values[f"{label}.position_rmse_m_by_noise.{name}"] = [mode.rmse_m for mode in swept]
        values[f"{label}.position_bound_m_by_noise.{name}"] = [mode.bound_m for mode in swept]
    return values


def _metrics_of_maps(maps: pd.DataFrame) -> dict[str, Any]:
    """Find the position with the largest ratio of ellipse areas, that ratio, and the median ratio."""
    values: dict[str, Any] = {}
    for label, rows in maps.groupby("mode", sort=False):
        best = rows.iloc[int(np.nanargmax(rows["ratio"]))]
        values |= {
            f"{label}.map_aim_m": [float(best["aim_x_m"]), float(best["aim_y_m"])],
            f"{label}.map_best_place_m": [float(best["x_m"]), float(best["y_m"])],
            f"{label}.map_best_ratio": float(best["ratio"]),
            f"{label}.map_median_ratio": float(rows["ratio"].median()),
        }
    return values


ACOUSTIC = Study("positions of shooters by three kinds of measurements", study, AcousticOptions)
