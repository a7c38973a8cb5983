"""What exact derivatives cost beside Jacobians by hand, modes beside one motion, and a first use.

The loops of the filters alone, on columns that are ready; CPU time of all cores together, medians of
turns. Compiling is measured in a process of its own with an empty cache, loading in a second one. Run it
with `make bench`, or `python -m tests.bench methods`.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from os import environ
from typing import Any

import numpy as np

from pipeline.ensemble import record_ensemble
from recorders.parameters import build
from replay.engine.estimator import Bound, bind
from replay.engine.sources import MemorySource
from replay.estimators.landmarks import ROBOT
from replay.estimators.vehicle_kalman import VEHICLE
from replay.inference.all_methods import METHODS
from replay.inference.estimators import bind_model, combined
from replay.inference.model import Model, Switching
from tests.bench.loops import Call, calls_of, first_use_s
from tests.bench.reference.landmarks import fill_motion_jacobians, fill_sensor_jacobian
from tests.bench.timing import cpu_seconds

Row = tuple[str, str, str, str]
COMPILES_S, LOADS_S = 15.0, 1.0  # what a first and a second use may take
# scenario, its parameters, estimator
USED: tuple[tuple[str, Mapping[str, Any], str], ...] = (
    *(
        ("landmarks", {"duration_s": 2.0}, method)
        for method in ("ekf", "iekf", "ukf", "smoother:iterated")
    ),
    ("batch-reactor", {}, "ekf"),
    ("batch-reactor", {}, "lrkf:ukf"),
    ("batch-reactor", {}, "analytic"),
    ("extended-target", {}, "lrkf:ukf"),
    ("vehicles", {"duration_s": 10.0}, "vehicle-kalman"),
)


def main() -> list[Row]:
    """Microseconds per step with jets and by hand, and CPU seconds of first uses."""
    return [
        *derivatives({"duration_s": 300.0}, 1),
        *derivatives({"duration_s": 20.0}, 1000),
        *interacting(),
        *uses(),
    ]


def by_hand(model: Model) -> Model:
    """The robot among landmarks with Jacobians written by hand; its first sensor is the one used."""

    def motion_jacobians(
        pose: Any, velocity: Any, duration_s: Any, parameters: Any, by_pose: Any, by_velocity: Any
    ) -> None:
        fill_motion_jacobians(pose, velocity, duration_s, by_pose, by_velocity)

    def sight_jacobian(pose: Any, landmark: Any, parameters: Any, by_pose: Any) -> None:
        fill_sensor_jacobian(pose, landmark, by_pose)

    seen = replace(model.sensors[0], jacobian=sight_jacobian)
    motion = replace(model.motion, jacobians=motion_jacobians)
    return replace(model, sensors=(seen,), motion=motion)


def bind_robot(model: Model, sources: list[MemorySource]) -> list[Bound]:
    method = METHODS["ekf"]
    parameters = combined(model, method)(gate_probability=1.0)
    return bind_model("ekf", sources[0].topics, parameters, model=model, method=method)


def derivatives(parameters: Mapping[str, Any], runs: int) -> list[Row]:
    """The extended Kalman filter of a robot, with jets and with Jacobians by hand."""
    sources = record_ensemble("landmarks", parameters, 1, runs)
    ways: dict[str, Callable[[], Any]] = {}
    for name, model in {"jets": ROBOT, "by hand": by_hand(ROBOT)}.items():
        [ways[name]] = calls_of(bind_robot(model, sources), sources)
    means = {name: way() for name, way in ways.items()}
    apart = np.max(np.abs(means["jets"] - means["by hand"]))
    assert apart < 1e-9, f"jets and Jacobians by hand are {apart} apart"
    us = {name: 1e6 * s / len(means[name]) for name, s in cpu_seconds(ways).items()}
    what = f"EKF, jets; Jacobians by hand, {'one log' if runs == 1 else f'{runs} runs'}"
    return [
        (what, *(f"{each:.3g} us" for each in us.values()), f"{us['jets'] / us['by hand']:.2f} times")
    ]


def hardly_ever(parameters: Any) -> Any:
    """Rates between two modes."""
    return 0.1, 0.5


def interacting() -> list[Row]:
    """Filters of a vehicle and of a robot, and interacting multiple models of two such modes."""
    rows = []
    for scenario, model in (("vehicles", VEHICLE), ("landmarks", ROBOT)):
        sources = record_ensemble(scenario, {"duration_s": 100.0}, 1, 100)
        modes = {"one": model.motion, "other": model.motion}
        double = replace(model, modes=modes, switching=Switching(hardly_ever))
        for filtered in ("ekf", "ukf"):
            calls: dict[str, list[Call]] = {}
            for name, settings in ((filtered, {}), ("imm", {"filter": filtered})):
                method = METHODS[name]
                parameters = build(combined(double, method), settings, "bench")
                bound = bind_model(name, sources[0].topics, parameters, model=double, method=method)
                calls[name] = calls_of(bound, sources)
            ways = {name: partial(_repeated, each) for name, each in calls.items()}
            means = {name: way() for name, way in ways.items()}
            np.testing.assert_allclose(means["imm"], means[filtered], rtol=1e-9, atol=1e-9)
            us = {name: 1e6 * s / len(means["imm"]) for name, s in cpu_seconds(ways).items()}
            what = f"imm:{filtered} of two modes of a {scenario.rstrip('s')}; {filtered}; target 3 times"
            ratio = us["imm"] / us[filtered]
            rows.append((what, f"{us['imm']:.3g} us", f"{us[filtered]:.3g} us", f"{ratio:.2f} times"))
    return rows


def _repeated(calls: list[Call]) -> Any:
    return np.concatenate([call() for call in calls])


def uses() -> list[Row]:
    """First and second uses, each in a process of its own."""
    rows = []
    for number, (scenario, _, estimator) in enumerate(USED):
        with tempfile.TemporaryDirectory() as cache:
            taken = [_use_elsewhere(number, cache) for _ in range(2)]
        for verb, s, wanted_s in zip(("compile", "load"), taken, (COMPILES_S, LOADS_S), strict=True):
            what = f"{estimator} of {scenario}: CPU to {verb}; target"
            rows.append((what, f"{s:.2g} s", f"{wanted_s:g} s", f"{s / wanted_s:.2f} times"))
    return rows


def _use_elsewhere(number: int, cache: str) -> float:
    command = [sys.executable, "-m", "tests.bench.bench_methods", str(number)]
    environment = {**environ, "FUSELOG_CACHE": cache}
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout)


def use(number: int) -> float:
    """CPU seconds of this process's first use of a model with a method."""
    scenario, parameters, estimator = USED[number]
    sources = record_ensemble(scenario, parameters, 1, 1)
    return first_use_s(bind(estimator, sources, {}), sources)


if __name__ == "__main__":
    print(use(int(sys.argv[1])))
