"""Filters made of models beside programs for the same system that are written by hand in C, in one run.

The programs get columns that are ready, in the order of time, and fill arrays; so does a loop alone.
Plumbing included, a filter starts from columns in memory and ends with output streams. That the
estimates are equal is asserted. Least CPU time of all cores together. Needs a C compiler. Run it with
`make bench`, or `python -m tests.bench c`.
"""

from collections.abc import Callable
from functools import partial
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource
from tests.bench.bench_models import sightings
from tests.bench.columns import Floats, column, offsets, prior, stamps_ns
from tests.bench.loops import calls_of
from tests.bench.meter import loop_seconds
from tests.bench.reference import c, reactor
from tests.bench.reference.gaussian import unscented
from tests.bench.timing import least_seconds

Row = tuple[str, str, str, str]
LOOP, PLUMBING, C = "its loop", "plumbing included", "C"
TOLERANCE = 1e-9


class Case(NamedTuple):
    """One filter: its scenario and output, and how C is called.

    `targets` says how many times what C takes it may at most; `logs` are parameters and numbers of runs.
    """

    name: str
    scenario: str
    estimator: str
    settings: dict[str, Any]
    output: str
    in_c: Callable[[list[MemorySource]], Callable[[], Floats]]
    targets: dict[str, float]
    logs: tuple[tuple[dict[str, Any], int], ...]


def main() -> list[Row]:
    """Every loop and whole replay: microseconds per estimate, and how many times those of C."""
    return [row for case in CASES for parameters in case.logs for row in timed(case, *parameters)]


def timed(case: Case, parameters: dict[str, Any], runs: int) -> list[Row]:
    """A loop alone and with its plumbing, beside C."""
    sources = record_ensemble(case.scenario, parameters, 1, runs)
    in_c, ours = case.in_c(sources), partial(estimated, case, sources)
    calls = calls_of(bind(case.estimator, sources, case.settings), sources)
    wanted = in_c()
    apart = np.max(np.abs(ours() - wanted))
    assert apart < TOLERANCE, f"{case.name}: C and ours are {apart} apart"
    ways = {
        LOOP: lambda: sum(map(loop_seconds, calls)),
        PLUMBING: partial(seconds, ours),
        C: partial(seconds, in_c),
    }
    us = {name: 1e6 * s / len(wanted) for name, s in least_seconds(ways).items()}
    what = f"{case.name}, {'one log' if runs == 1 else f'{runs} runs'} of {len(wanted) // runs} steps"
    return [
        (
            f"{what}, {part}; C, at most {most:g} times",
            f"{us[part]:.3g} us",
            f"{us[C]:.3g} us",
            f"{us[part] / us[C]:.2f} times",
        )
        for part, most in case.targets.items()
    ]


def seconds(work: Callable[[], object]) -> float:
    """CPU seconds of one call."""
    begin = process_time()
    work()
    return process_time() - begin


def estimated(case: Case, sources: list[MemorySource]) -> Floats:
    """Means of all runs end to end."""
    outputs = collect(replay(sources, bind(case.estimator, sources, case.settings)))
    return outputs[f"/estimates/{case.estimator}/{case.output}"]["mean"]


def reactor_in_c(sources: list[MemorySource]) -> Callable[[], Floats]:
    """The unscented Kalman filter of the batch reactor."""
    measured, runs = column(sources, "/pressure", "value")[:, 0].copy(), offsets(sources, "/pressure")
    samples = unscented(2, 0.5)
    return partial(reactor.compiled_c(), measured, samples.points[0], samples.weights[0], runs)


def robot_in_c(sources: list[MemorySource]) -> Callable[[], Floats]:
    """The extended Kalman filter of a robot among landmarks."""
    events, places = sightings(sources)
    seen = np.ascontiguousarray(places[events.target])
    start, covariance = (each.copy() for each in prior(sources, "/robot1/prior", 3))
    start_ns = stamps_ns(sources, "/robot1/prior")
    density, variance = np.array([0.02, 0.01]), np.array([0.1**2, 0.02**2])
    rows = np.count_nonzero(events.is_last)
    assert np.all(events.time_ns >= np.repeat(start_ns, np.diff(events.offsets)))
    inputs = (c.INTEGERS, c.INTEGERS, c.INTEGERS, c.FLOATS, c.FLOATS, c.BOOLEANS, c.FLOATS, c.FLOATS)
    outputs = (c.FLOATS, c.FLOATS, c.INTEGERS, c.FLOATS, c.FLOATS)
    function = c.compiled("robot", "filter_runs", c.INTEGER, *inputs, *outputs)
    means, covariances = np.empty((rows, 3)), np.empty((rows, 3, 3))

    def run() -> Floats:
        function(
            len(sources), events.offsets, events.time_ns, events.sensor, events.value, seen,
            events.is_last, density, variance, start, covariance, start_ns, means, covariances,
        )  # fmt: skip
        return means

    return run


CASES = (
    Case(
        "UKF of the reactor",
        "batch-reactor",
        "lrkf:ukf",
        {},
        "state",
        reactor_in_c,
        {LOOP: 1.8, PLUMBING: 3.0},
        (({"steps": 2000}, 1), ({}, 1000)),
    ),
    Case(
        "EKF of a robot",
        "landmarks",
        "ekf",
        {"gate_probability": 1.0},
        "robot1/pose",
        robot_in_c,
        {LOOP: 1.8},
        (({"duration_s": 300.0}, 1), ({"duration_s": 20.0}, 200)),
    ),
)
