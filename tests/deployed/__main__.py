"""Deploys every model by every method that deploys, compiles it, and compares it with the replay."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import fuselog as fl
from recorders.errors import BadInput
from recorders.registry import available
from tests.deployed.building import compiled, furthest
from tests.pipeline import estimator_cases as cases
from tests.replay.estimators.test_attitude import carried

METHODS = ("ekf", "iekf", "ukf", "lrkf:s2kf-25", "sqrt:ekf", "sqrt:ukf")
EQUAL = 1e-12  # how far the C may be from the replay, as a share of numbers that are larger than one


class Pair(NamedTuple):
    """Holds how a pair of model and method went: the furthest from the replay, or why it cannot be."""

    model: str
    method: str
    furthest: float
    why_not: str
    taken_s: float


def logs(folder: Path) -> Iterator[tuple[str, Path]]:
    """Record a short log for every model."""
    for name in available("models"):
        log = folder / f"{name}.mcap"
        if name == "orientation":  # no scenario has a magnetometer
            fl.write(log, [carried()[0]])
        else:
            scenario, recorded, _ = cases.MODELS[name].usual
            fl.write(log, fl.record(scenario, seed=7, **recorded))
        yield name, log


def tried(log: Path, model: str, method: str, folder: Path) -> Pair:
    """Deploy a model by a method, and compare."""
    began = time.perf_counter()
    away, why_not = float("nan"), ""
    try:
        mode = {"mode": "drive"} if model == "vehicle" else {}
        settings = {"filter": {"kind": method, "model": model, **mode}}
        made = fl.deploy(log, settings, folder / f"{model}_{method}")
    except BadInput as error:
        why_not = str(error)
    else:
        away = furthest(compiled(made))
    return Pair(model, method, away, why_not, time.perf_counter() - began)


def main(names: list[str]) -> int:
    """Try all pairs, or those of these models and methods; returns how many differ or do not deploy."""
    wrong = 0
    with TemporaryDirectory() as place:
        folder = Path(place)
        for model, log in logs(folder):
            for method in METHODS:
                if names and not {model, method} & {*names}:
                    continue
                pair = tried(log, model, method, folder)
                wrong += not pair.why_not and not pair.furthest <= EQUAL
                said = pair.why_not or f"furthest {pair.furthest:.1e}"
                print(f"{pair.taken_s:5.1f} s  {model:18}{method:14}{said}", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 1))
