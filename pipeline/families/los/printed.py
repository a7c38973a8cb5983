"""Comparison of results for lines of sight with those printed in Belfadel et al. 2014."""

from typing import Any

import numpy as np

from fuselog.pipeline.families.los.cases import (
    JOINT,
    Case,
    Printed,
    observabilities,
    one_bias_known,
)
from fuselog.pipeline.studies.toolkit.repetitions import Floats, root_mean_square, worst_deviation
from fuselog.recorders.families.los.models import ANGLES
from fuselog.replay.families.los import localization as optical

# The paper's rule: the RMSE of 100 runs differs from the CRLB sigma by less than this share.
RULE = 0.15


def metrics_of_print(paper: Printed) -> dict[str, Any]:
    """Count the printed biases, and those whose RMSE or mean error satisfies the paper's own rules."""
    sigma, rmse = np.array(paper.bias_sigma_mrad), np.array(paper.bias_rmse_mrad)
    small = np.abs(np.array(paper.bias_mean_mrad)) < 2.0 * sigma / np.sqrt(paper.runs)
    return {
        "printed.pairs": float(sigma.size),
        "printed.pairs_within_rule": float((np.abs(rmse / sigma - 1.0) < RULE).sum()),
        "printed.means_within_bound": float(small.sum()),
    }


def metrics_beside_print(case: Case, paper: Printed) -> dict[str, Any]:
    """Compare CRLB sigmas, biases' errors and position errors with the printed results and rules."""
    name, error = f"{case.condition}-{case.number}", case.bias_error_mrad
    runs, sigma = error.shape[1], case.sigma_mrad
    rule = RULE * np.sqrt(paper.runs / runs)
    kept = np.abs(root_mean_square(error, 1) / sigma - 1.0) < rule
    small = np.abs(np.nanmean(error, axis=1)) < 2.0 * sigma / np.sqrt(runs)
    values: dict[str, Any] = {
        f"{JOINT}.sigma_by_printed.{name}": (sigma / paper.bias_sigma_mrad[case.number - 1]).tolist(),
        f"{JOINT}.rmse_rule.{name}": float(rule),
        f"{JOINT}.rmse_rule_share.{name}": float(kept.mean()),
        f"{JOINT}.mean_error_rule_share.{name}": float(small.mean()),
    }
    if case.number == paper.position_scenario:
        for scheme, printed in paper.position_rmse_m.items():
            squared = case.position_error_m(scheme).reshape(-1, case.targets) ** 2
            worst, allowed = worst_deviation(np.array(printed), squared, paper.runs)
            values |= {
                f"{scheme}.printed_rmse_m.{name}": printed,
                f"{scheme}.rmse_beside_print_m.{name}": case.position_rmse_m(scheme).tolist(),
                f"{scheme}.printed_off_sigmas.{name}": worst,
                f"{scheme}.allowed_off_sigmas.{name}": allowed,
            }
    if len(case.scene.position_m) > 2:
        values[f"{JOINT}.share_from_print.{name}"] = _share_from_print(case)
    return values


def metrics_of_geometry(case: Case, paper: Printed) -> dict[str, Any]:
    """Return the observability for variations of a scenario, and checks of its sensor positions."""
    number = case.number
    values: dict[str, Any] = {}
    for what, found in observabilities(case).items():
        label = what.replace(" ", "-")
        values[f"{label}.rank.{number}"] = float(found.rank)
        values[f"{label}.unknowns.{number}"] = float(found.parameters)
    printed, ours = np.array(paper.sensor_position_m[number - 1]), case.scene.position_m
    values |= {
        f"sensors.are_as_printed.{number}": float(np.array_equal(printed, ours)),
        f"sensors.are_swapped.{number}": float(np.array_equal(printed[:, [0, 2, 1]], ours)),
        f"sensors.widest_span_deg.{number}": _widest_span_deg(case),
    }
    if len(ours) == 2:
        names = [f"{angle}{sensor}" for sensor in (1, 2) for angle in ANGLES]
        for name, sigmas in zip(names, one_bias_known(case), strict=True):
            values[f"{name}-known.worst_sigma_mrad.{number}"] = float(sigmas.max())
    return values


def steepest_deg(case: Case) -> float:
    """Return the elevation of the steepest line of sight; near 90 deg, azimuth is nearly singular."""
    elevation = np.degrees(optical.predict(case.scene, case.truth[None])[0, :, :, 1])
    return float(elevation.ravel()[np.abs(elevation).argmax()])


def _share_from_print(case: Case, runs: int = 200) -> float:
    """Compute the share of noisy runs whose estimate is also reached from the printed starting point."""
    clean = optical.predict(case.scene, case.truth[None])
    noise = np.random.default_rng(case.number).normal(size=(runs, *clean.shape[1:]))
    measured = clean + case.scene.sigma_rad * noise
    right = optical.estimate(case.scene, measured)
    found = optical.estimate(case.scene, measured, optical.printed_starting_point(case.scene, measured))
    off = np.abs(found.parameters / right.parameters - 1.0).max(axis=1)
    return float((found.converged & (off < 1e-3)).mean())


def _widest_span_deg(case: Case) -> float:
    """Compute the largest angle between two targets, as seen by a sensor."""
    offset = np.array(case.parameters.target_position_m) - case.scene.position_m[:, None]
    unit: Floats = offset / np.linalg.norm(offset, axis=2, keepdims=True)
    cosine = np.einsum("sik,sjk->sij", unit, unit)
    return float(np.degrees(np.arccos(cosine.clip(-1.0, 1.0)).max()))
