"""What a section of the report opens with, and a summary's first lines."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.report.kinds import opening
from fuselog.pipeline.output.results import Result
from fuselog.replay.judging.diagnostics import LEAST_SHARE

TWO = {"a.position_rmse_m": 0.5, "b.position_rmse_m": 0.25, "a.nees": 9.0}
BOUNDS = {"b.nees": (2.0, 4.0)}


def verdict(result: Result) -> tuple[str, str]:
    """What was tried, and what came of it."""
    begun = opening(result, {})
    return begun.tried, " ".join(begun.story.verdict)


def what_was_run() -> Iterator[str]:
    """What was run."""
    names = {letter: {} for letter in "abcdefgh"}
    for settings in (
        {"estimators": dict(list(names.items())[:6]), "record": {"scenario": "s"}, "runs": 4, "seed": 7},
        {"estimators": names, "import": {"source": "mrclam"}, "runs": 1, "seed": 7},
        {"logs": ["x", "y"], "estimators": {"a": {}}},
        {},
    ):
        yield verdict(_result({}, settings=settings))[0]


def claims() -> Iterator[str]:
    """Which claims hold."""
    long = "the filter with all sensors is better than every other one of them"
    made = [
        Claim("A is 1", "1", "1", "confirmed"),
        Claim(long, "2", "3", "refuted"),
        Claim("C is 3", "3", "", "not reproducible"),
        Claim("D is 4", "4", "3 to 5", "inconclusive"),
        Claim("E is 5", "5", "6", "refuted"),
        Claim("F is 6", "6", "7", "refuted"),
        Claim("G is 7", "7", "8", "no verdict"),
    ]
    for count in range(1, len(made) + 1):
        yield verdict(_result({}, made[:count]))[1]


def best() -> Iterator[str]:
    """Which estimator is best, and whether it is consistent: of four runs, and of one."""
    for runs in (4, 1):
        for nees in (1.9, 3.0, 4.1):
            yield _best({**TWO, "b.nees": nees, "b.nis_per_component": 1.01}, runs)
    yield _best({"b.orientation_rmse_deg": 1.0, "a.orientation_rmse_deg": 2.0, "a.speed_rmse_mps": 0.1})
    yield _best({"b.position_rmse_m": 0.25})
    yield _best({})
    lacking = {"a.position_rmse_m.x": 0.3, "b.position_rmse_m.x": 0.1, "a.position_rmse_m.y": 0.4}
    yield _best(lacking)
    cases = {**lacking, "b.position_rmse_m.y": 0.2, "b.nees.x": 3.0, "b.nees.y": 5.0}
    yield _best({**cases, "b.failed_runs.x": 2.0, "b.estimated_share.x": 0.5})
    for share in (LEAST_SHARE, 0.999 * LEAST_SHARE):
        yield _best({**cases, "b.estimated_share.x": share, "b.estimated_share.y": 1.0})
    yield _best({**cases, "b.failed_runs.x": 0.0, "b.estimated_share.x": 1.0}, 1)


def _best(metrics: Mapping[str, Any], runs: int = 4) -> str:
    bounds = {
        **BOUNDS,
        "b.nees.x": (2.0, 4.0),
        "b.nees.y": (2.0, 4.0),
        "b.nis_per_component": (0.9, 1.1),
    }
    settings = {"estimators": {"a": {}, "b": {}}, "runs": runs}
    known = {key: ends for key, ends in bounds.items() if key in metrics}
    return verdict(_result(metrics, settings=settings, bounds=known))[1]


def _result(
    metrics: Mapping[str, Any],
    claims: Sequence[Claim] = (),
    settings: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
) -> Result:
    return Result(
        experiment="x",
        fuselog="1",
        settings=dict(settings or {}),
        input_sha256="",
        metrics=dict(metrics),
        claims=list(claims),
        bounds=dict(bounds or {}),
    )


REPORTED = (what_was_run, claims, best)
