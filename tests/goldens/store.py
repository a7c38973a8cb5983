"""Our own goldens: where they are kept, what may differ in them, and how a recipe becomes one."""

import tempfile
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from fuselog.pipeline.checking.golden import Replayed, Tolerance, Tolerances, golden_of, make
from fuselog.pipeline.checking.stored import SUFFIX, Golden
from fuselog.pipeline.runs.experiment import run_experiment
from tests.goldens.recipes import RECIPES, first_log

FOLDER = Path(__file__).parent / "stored"
MOST_CHECKED = 10_000  # rows of a stream: two bytes each, which do not pack
SINGULAR = "its covariances come near to singular: what rounding does grows as large as the estimate"
# By "GOLDEN TOPIC COLUMN", with wildcards: "landmarks* /estimates/ekf/* covariance". Empty but for
# other CPUs, as tried with the newer instructions switched off.
ALLOWED = {
    "vehicles-* /estimates/powers/*": Tolerance(np.inf, SINGULAR, elsewhere=True),
    "vehicles-* /estimates/products/*": Tolerance(np.inf, SINGULAR, elsewhere=True),
    "lcd-sampling metric lcd.unlike_ukf.*-corrected": Tolerance(
        np.inf, "the two sets are one: what is left is where the search stopped", elsewhere=True
    ),
    "los-* /estimates/* cost": Tolerance(
        np.inf, "as many unknowns as measurements: what is left is rounding", elsewhere=True
    ),
}


def allowed(name: str) -> Tolerances:
    """What may differ in a golden, by `TOPIC COLUMN`."""
    known = [(*pattern.split(" ", 1), tolerance) for pattern, tolerance in ALLOWED.items()]
    return {where: tolerance for golden, where, tolerance in known if fnmatch(name, golden)}


def replayed(name: str, places: Mapping[str, Path]) -> Replayed:
    """Replay a recipe's log, under the recipe's name; where there is none, run its experiment."""
    recipe = RECIPES[name]
    if recipe.has_log:
        return make(
            {name: first_log(recipe, places)},
            recipe.settings,
            late=recipe.late or None,
            arrival_order=bool(recipe.late),
            tolerances=allowed(name),
        )
    with tempfile.TemporaryDirectory() as folder:
        place, data = Path(folder) / "out", places.get(recipe.importer)
        result = run_experiment(recipe.experiment, recipe.loaded, place, data=data)
    return Replayed(golden_of(metrics=result.metrics, tolerances=allowed(name)), {})


def kept(golden: Golden) -> Golden:
    """A golden as it is kept: without the checksums of rows so many that they outweigh all the rest."""
    for run in golden["runs"].values():
        for stream in run["streams"].values():
            if stream["rows"] > MOST_CHECKED:
                stream["checksums"] = ""
    return golden


def path_of(name: str) -> Path:
    """Where a golden is kept."""
    return FOLDER / f"{name}{SUFFIX}"
