"""What derivatives of the graph cost beside Jacobians by hand, and modes beside one motion.

The loops of the filters alone, on columns that are ready; CPU time of all cores together, medians of
turns. Run it with `make bench`, or `python -m tests.bench methods`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.parameters import build
from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.estimators.landmarks import ROBOT
from fuselog.replay.families.vehicles.vehicle_model import VEHICLE
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import bind_model, combined
from fuselog.replay.inference.model.model import Model, Switching
from tests.bench.loops import Call, calls_of
from tests.bench.reference.landmarks import fill_motion_jacobians, fill_sensor_jacobian
from tests.bench.timing import cpu_seconds

Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Microseconds per step with derivatives of the graph and by hand, with modes and without."""
    return [
        *derivatives({"duration_s": 300.0}, 1),
        *derivatives({"duration_s": 20.0}, 1000),
        *interacting(),
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
    """The extended Kalman filter of a robot, with derivatives of the graph and by hand."""
    sources = record_ensemble("landmarks", parameters, 1, runs)
    ways: dict[str, Callable[[], Any]] = {}
    for name, model in {"graph": ROBOT, "by hand": by_hand(ROBOT)}.items():
        [ways[name]] = calls_of(bind_robot(model, sources), sources)
    means = {name: way() for name, way in ways.items()}
    apart = np.max(np.abs(means["graph"] - means["by hand"]))
    assert apart < 1e-9, f"derivatives of the graph and by hand are {apart} apart"
    us = {name: 1e6 * s / len(means[name]) for name, s in cpu_seconds(ways).items()}
    what = (
        f"EKF, derivatives of the graph; Jacobians by hand, {'one log' if runs == 1 else f'{runs} runs'}"
    )
    return [
        (what, *(f"{each:.3g} us" for each in us.values()), f"{us['graph'] / us['by hand']:.2f} times")
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
