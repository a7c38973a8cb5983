"""Compares the verdicts of shipped experiments, run with fewer runs, with those that are kept."""

from collections.abc import Mapping, Sequence
from typing import Any

from fuselog.pipeline.output.claims import Claim, decide
from fuselog.pipeline.runs.experiment import Study, numbers_of
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from tests.claims import pages

OPPOSITE = {"confirmed", "refuted"}


def opposite(name: str, settings: Mapping[str, Any], claims: Sequence[Claim]) -> list[str]:
    """Claims that an experiment, as it ships except for the number of runs, decides the other way."""
    kept = pages.stored().get(name)
    if kept is None or _without_runs(kept.settings) != _without_runs(settings):
        return []
    if settings["runs"] >= kept.settings["runs"]:
        return []
    assert len(claims) == len(kept.stated_claims), name
    return [
        f"{claim.claim}: {claim.verdict} of {settings['runs']} runs, {of_all['verdict']} of all"
        for claim, of_all in zip(claims, kept.stated_claims, strict=True)
        if {claim.verdict, of_all["verdict"]} == OPPOSITE
    ]


def as_of_all(name: str, result: Mapping[str, Any]) -> list[Claim]:
    """The claims of a shipped experiment by what few runs found, as if these were all of its runs."""
    experiment = pages.as_shipped(name)
    options = build(load("studies", experiment.study, Study).options, experiment.options, name)
    numbers = numbers_of(experiment, options)
    return decide(experiment.claims, result["metrics"], result["intervals"], numbers)


def _without_runs(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: of for name, of in settings.items() if name not in ("runs", "parameters", "data")}
