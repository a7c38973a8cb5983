"""What an estimator costs in one checkout of fuselog: its first use, and its loops.

`python -P tests/bench/meter.py SCENARIO PARAMETERS RUNS ESTIMATOR` prints CPU seconds. It measures
the checkout that PYTHONPATH names, so that today's is measured beside an earlier one: back to 8bc94bb,
from before modules moved into rooms of rooms. Names of estimators and models stand for what that
checkout registers, whichever is installed.
"""

import copy
import json
import sys
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

from fuselog.recorders import registry
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import bind_model, combined
from tests.bench import loops
from tests.bench.loops import Call, calls_of

if TYPE_CHECKING:
    from fuselog.replay.engine.replaying.estimator import Bound
    from fuselog.replay.engine.streams.sources import MemorySource

OWN = "a user's own model"


def main(scenario: str, parameters: Mapping[str, Any], runs: int, estimator: str) -> dict[str, float]:
    """CPU seconds of a first use beyond a second one, and of the loops for each of their events."""
    register(Path.cwd())
    sources = recorded(scenario, parameters, runs)
    taken = []
    for _ in range(2):
        begin = process_time()
        calls = calls_of(bound(scenario, estimator, sources), sources)
        taken.append(process_time() - begin)
    assert calls, "no filter is made of a model"
    events = sum(len(getattr(call.before[0], "events", call.before[0]).time_ns) for call in calls)
    least, begin = float("inf"), process_time()
    while process_time() < begin + 1.0:
        least = min(least, sum(loop_seconds(call) for call in calls))
    return {"first_use": taken[0] - taken[1], "event": least / events}


def register(checkout: Path) -> None:
    """Have names stand for what the checkout's own pyproject.toml says."""
    stated = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))
    found = EntryPoints(
        EntryPoint(name, value, group)
        for group, entries in stated["project"]["entry-points"].items()
        for name, value in entries.items()
    )
    vars(registry)["entry_points"] = found.select


def either(name: str, *modules: str) -> Any:
    """What a checkout has by this name, in the first of these modules that it has."""
    for module in modules:
        with suppress(ModuleNotFoundError, AttributeError):
            return getattr(import_module(module), name)
    raise AssertionError(f"none of {', '.join(modules)} has {name}")


def recorded(scenario: str, parameters: Mapping[str, Any], runs: int) -> "list[MemorySource]":
    """Runs of the scenario, or logs for the user's model."""
    if scenario != OWN:
        places = "fuselog.pipeline.runs.recorded", "fuselog.pipeline.runs.ensemble", "pipeline.ensemble"
        return either("record_ensemble", *places)(scenario, parameters, 1, runs)
    from tests.replay.inference.vehicle_a import simulate, source

    return [source(simulate(run)[0]) for run in range(runs)]


def bound(scenario: str, estimator: str, sources: "list[MemorySource]") -> "list[Bound]":
    """The estimator, of whichever registered model the log has, or of the user's."""
    if scenario != OWN:
        places = "fuselog.replay.engine.replaying.estimator", "fuselog.replay.engine.estimator"
        return either("bind", *places)(estimator, sources, {})
    from tests.replay.inference.vehicle_a import VEHICLE_A as MODEL

    method = METHODS[estimator]
    parameters = combined(MODEL, method)()
    return bind_model(estimator, sources[0].topics, parameters, model=MODEL, method=method)


def loop_seconds(call: Call) -> float:
    """CPU seconds of one more call of a loop, into the arrays that it filled before."""
    *columns, carried = call.before
    results = tuple(type(each)(each.end.copy(), *each[1:]) for each in call.results)
    if hasattr(loops, "handed_over"):  # earlier loops take them apart
        results = loops.handed_over(*results)
    arguments = (*columns, copy.deepcopy(carried), *results)
    begin = process_time()
    call.loop(call.runs, *arguments, scratch=call.scratch)
    return process_time() - begin


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]), sys.argv[4])))
