"""Every model that deploys, with a short log of it."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import fuselog as fl
from fuselog.recorders.registry import available
from tests.deployed.own_models import own_models
from tests.pipeline import estimator_cases as cases
from tests.replay.estimators.test_attitude import carried


class Tried(NamedTuple):
    """Holds a model, a log of it, and settings beside the method."""

    model: str
    log: Path
    kind: Any
    settings: Mapping[str, Any]


def robot_log(folder: Path) -> Path:
    """Record a robot that sees ranges, bearings and fixes."""
    scenario, recorded, _ = cases.MODELS["robot"].usual
    log = folder / "robot.mcap"
    fl.write(log, fl.record(scenario, seed=7, **recorded))
    return log


def models(folder: Path) -> Iterator[Tried]:
    """Record a short log for every model."""
    for name in available("models"):
        log = folder / f"{name}.mcap"
        if name == "orientation":  # no scenario has a magnetometer
            fl.write(log, [carried()[0]])
        else:
            scenario, recorded, _ = cases.MODELS[name].usual
            fl.write(log, fl.record(scenario, seed=7, **recorded))
        mode = {"mode": "drive"} if name == "vehicle" else {}
        yield Tried(name, log, None, {"model": name, **mode})
    for name, model, log, settings in own_models(folder):
        yield Tried(name, log, model, settings)


def deployed(tried: Tried, method: str, folder: Path, *, single: bool = False) -> Path:
    """Deploy a model by a method."""
    kind = method if tried.kind is None else fl.modelled(tried.kind, method)
    place = folder / re.sub(r"\W", "_", f"{tried.model}_{method}_{single}")
    return fl.deploy(tried.log, {"filter": {"kind": kind, **tried.settings}}, place, single=single)
