"""What an estimator costs in one checkout of fuselog: its first use, and its loops.

`python -P tests/bench/meter.py SCENARIO PARAMETERS RUNS ESTIMATOR` prints CPU seconds. It measures
the checkout that PYTHONPATH names, so that today's is measured beside an earlier one: what it imports is
in both.
"""

import copy
import json
import sys
from collections.abc import Mapping
from time import process_time
from typing import Any

from pipeline.runs.recorded import record_ensemble
from replay.engine.replaying.estimator import Bound, bind
from replay.engine.streams.sources import MemorySource
from replay.inference.all_methods import METHODS
from replay.inference.estimators import bind_model, combined
from tests.bench.loops import Call, calls_of, handed_over

OWN = "a user's own model"


def main(scenario: str, parameters: Mapping[str, Any], runs: int, estimator: str) -> dict[str, float]:
    """CPU seconds of a first use beyond a second one, and of the loops for each of their events."""
    sources = recorded(scenario, parameters, runs)
    taken = []
    for _ in range(2):
        begin = process_time()
        calls = calls_of(bound(scenario, estimator, sources), sources)
        taken.append(process_time() - begin)
    assert calls, "no filter is made of a model"
    events = sum(call.events for call in calls)
    least, begin = float("inf"), process_time()
    while process_time() < begin + 1.0:
        least = min(least, sum(loop_seconds(call) for call in calls))
    return {"first_use": taken[0] - taken[1], "event": least / events}


def recorded(scenario: str, parameters: Mapping[str, Any], runs: int) -> list[MemorySource]:
    """Runs of the scenario, or logs for the user's model."""
    if scenario != OWN:
        return record_ensemble(scenario, parameters, 1, runs)
    from tests.replay.inference.vehicle_a import simulate, source

    return [source(simulate(run)[0]) for run in range(runs)]


def bound(scenario: str, estimator: str, sources: list[MemorySource]) -> list[Bound]:
    """The estimator, of whichever registered model the log has, or of the user's."""
    if scenario != OWN:
        return bind(estimator, sources, {})
    from tests.replay.inference.vehicle_a import VEHICLE_A as MODEL

    method = METHODS[estimator]
    parameters = combined(MODEL, method)()
    return bind_model(estimator, sources[0].topics, parameters, model=MODEL, method=method)


def loop_seconds(call: Call) -> float:
    """CPU seconds of one more call of a loop, into the arrays that it filled before."""
    *columns, carried = call.before
    results = (type(each)(each.end.copy(), *each[1:]) for each in call.results)
    arguments = (*columns, copy.deepcopy(carried), *handed_over(*results))
    begin = process_time()
    call.loop(call.runs, *arguments, scratch=call.scratch)
    return process_time() - begin


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]), sys.argv[4])))
