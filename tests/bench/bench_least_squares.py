"""The batched least squares against scipy.optimize.least_squares called run by run.

Three optical sensors, three targets, 18 parameters (`data/scenarios/optical-three-sensors-*.toml`), at 3
deg and 0.300 mrad. Both sides start from the same ray intersection, call the same measurement model,
and must find the same estimates to 1e-8. Ours also gives covariance and rank; theirs does not.
"""

import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from fuselog.recorders.families.los.models import line_of_sight
from fuselog.replay.families.los import localization as optical
from fuselog.replay.families.los.localization import Scene
from tests.bench.timing import seconds

SCENARIOS = Path(__file__).parents[2] / "data" / "scenarios"
SIGMA_RAD = 0.300e-3
RUNS = 1000
SCIPY_RUNS = 20
REPEATS = 5

Row = tuple[str, float, float, float]


def ensemble(scenario: int) -> tuple[Scene, np.ndarray]:
    """A scenario and its noisy lines of sight (runs, targets, sensors, 2)."""
    text = (SCENARIOS / f"optical-three-sensors-{scenario}.toml").read_text()
    given = tomllib.loads(text)["parameters"]
    sensors = np.array(given["sensor_position_m"])
    scene = Scene(sensors, np.zeros((3, 3)), np.full((3, 2), SIGMA_RAD), np.full((3, 3), np.nan))
    truth = np.concatenate([np.ravel(given["target_position_m"]), np.full(9, np.radians(3.0))])
    clean = optical.predict(scene, truth[None])
    noise = np.random.default_rng(scenario).normal(size=(RUNS, *clean.shape[1:]))
    return scene, clean + SIGMA_RAD * noise


def residual(parameters: np.ndarray, scene: Scene, measured: np.ndarray) -> np.ndarray:
    """What scipy minimises for one run: the model alone, without our machinery."""
    target = parameters[:9].reshape(3, 3).T[:, :, None]
    attitude = parameters[9:].reshape(3, 3).T[:, None]
    predicted = line_of_sight(target, scene.position_m.T[:, None], attitude)
    return (np.stack(predicted, axis=-1) - measured).ravel() / SIGMA_RAD


def jacobian(parameters: np.ndarray, scene: Scene, measured: np.ndarray) -> np.ndarray:
    """Our analytic one, for one run."""
    return optical.linearize(scene, measured[None], parameters[None]).jacobian[0] / SIGMA_RAD


def main() -> list[Row]:
    """Rows of (what, ours, reference, reference / ours); times are in seconds."""
    ensembles = [ensemble(scenario) for scenario in range(1, 6)]
    whole = min(
        seconds(lambda: [optical.estimate(scene, measured) for scene, measured in ensembles])
        for _ in range(REPEATS)
    )
    return [
        ("1000 runs x 5 scenarios, against the 5 s allowed", whole, 5.0, 5.0 / whole),
        *(compare(name, options, *ensembles[0]) for name, options in REFERENCES.items()),
    ]


def compare(name: str, options: dict[str, Any], scene: Scene, measured: np.ndarray) -> Row:
    """Time per run of both, measured in turns; their estimates must agree."""
    starts = optical.starting_point(scene, measured)
    search = partial(least_squares, residual, **options)

    def theirs() -> list[np.ndarray]:
        return [search(starts[run], args=(scene, measured[run])).x for run in range(SCIPY_RUNS)]

    ours = optical.estimate(scene, measured)
    np.testing.assert_allclose(theirs(), ours.parameters[:SCIPY_RUNS], rtol=1e-8)
    turns = [
        (seconds(lambda: optical.estimate(scene, measured)) / RUNS, seconds(theirs) / SCIPY_RUNS)
        for _ in range(REPEATS)
    ]
    mine, reference = np.min(turns, axis=0)
    return f"one run, scipy {name}", mine, reference, reference / mine


REFERENCES: dict[str, dict[str, Any]] = {
    "as it comes": {},
    "with tight tolerances": {"x_scale": "jac", "xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14},
    "with our Jacobian": {"x_scale": "jac", "jac": jacobian},
    "(MINPACK) with our Jacobian": {"x_scale": "jac", "method": "lm", "jac": jacobian},
}


if __name__ == "__main__":
    for what, mine, reference, ratio in main():
        print(f"{what:<50} {mine:.3g} s  {reference:.3g} s  {ratio:.1f}x")
