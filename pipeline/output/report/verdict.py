"""The two lines that a section of the report opens with: what was run, and what came of it."""

import math
from collections import Counter
from textwrap import shorten

from pipeline.output.claims import NO_VERDICT
from pipeline.output.results import MetricTable, Result, metric_tables
from pipeline.output.terminal import format_value
from replay.judging.diagnostics import LEAST_SHARE

# More estimators than these are counted, and more claims than these are in the table below alone.
MOST_NAMED = 6
MOST_CLAIMS = 2
LONGEST_CLAIM = 45
# What a mean NEES says, by where it lies.
MEANING = {
    "above": "its covariances are too small",
    "below": "its covariances are too large",
    "within": "it is consistent",
}


def verdict(result: Result) -> tuple[str, str]:
    """Say what was run; then which claims hold, or which estimator is best and if it is consistent."""
    tables = metric_tables(result.metrics, result.bounds)
    came = _of_claims(result) if result.claims else _best(tables, _runs(result))
    return _what_was_run(result, tables), came


def _runs(result: Result) -> int:
    logs = result.settings.get("logs")
    return len(logs) if isinstance(logs, list) else int(result.settings.get("runs", 1))


def _what_was_run(result: Result, tables: list[MetricTable]) -> str:
    settings = result.settings
    estimators = list(settings.get("estimators") or (tables[0].estimators if tables else []))
    if len(estimators) > MOST_NAMED:
        named = f"{', '.join(estimators[:MOST_NAMED])} and {len(estimators) - MOST_NAMED} more"
    else:
        named = ", ".join(estimators) or result.experiment
    source = settings.get("record", {}).get("scenario") or settings.get("import", {}).get("source")
    runs = _runs(result)
    over = f" over {runs} {'run' if runs == 1 else 'runs'}" + (f" of {source}" if source else "")
    seed = f", seed {settings['seed']}" if "seed" in settings and "import" not in settings else ""
    return f"{named}{over}{seed}."


def _of_claims(result: Result) -> str:
    """How many claims hold and how many do not, and the first of these."""
    counts = Counter(claim.verdict for claim in result.claims)
    sentences = [f"{counts['confirmed']} of {len(result.claims)} claims confirmed"]
    refuted = [claim.claim for claim in result.claims if claim.verdict == "refuted"]
    if refuted:
        named = [f"“{shorten(each, LONGEST_CLAIM, placeholder=' …')}”" for each in refuted[:MOST_CLAIMS]]
        more = f" and {len(refuted) - MOST_CLAIMS} more" if len(refuted) > MOST_CLAIMS else ""
        sentences.append(f"{len(refuted)} refuted: {', '.join(named)}{more}")
    for other in ("not shown", "not reproducible"):
        if counts[other]:
            sentences.append(f"{counts[other]} {other}")
    if counts[NO_VERDICT]:
        sentences.append(f"{counts[NO_VERDICT]} of another recording, without a verdict")
    return "; ".join(sentences) + "."


def _best(tables: list[MetricTable], runs: int) -> str:
    """The estimator of the least error over all cases, and whether NEES calls it consistent."""
    quantity = _main_quantity(tables)
    errors = {
        estimator: math.sqrt(sum(error**2 for error in of) / len(of))
        for estimator in (tables[0].estimators if tables else [])
        if (of := _values(tables, estimator, quantity)) is not None
        and _values(tables, estimator, "over_ensemble") is None  # a bound, which estimates nothing
    }
    if not errors:
        return "No errors against a truth, and no claims."
    best = min(errors, key=lambda estimator: errors[estimator])
    least = f"{best} has the least {quantity}, {format_value(errors[best])}"
    alone = f"{quantity} of {best} is {format_value(errors[best])}"
    return "; ".join([least if len(errors) > 1 else alone, *_doubts(tables, best, runs)]) + "."


def _main_quantity(tables: list[MetricTable]) -> str:
    """What estimators are compared by: position, else orientation, else the first RMSE there is."""
    there = [quantity for table in tables for quantity in table.quantities if "rmse" in quantity]
    preferred = [each for each in ("position_rmse_m", "orientation_rmse_deg") if each in there]
    return next(iter([*preferred, *there]), "")


def _values(tables: list[MetricTable], estimator: str, quantity: str) -> list[float] | None:
    """An estimator's values over the cases; None where it lacks one that another estimator has."""
    of = [table.quantities[quantity] for table in tables if quantity in table.quantities]
    values = [each[estimator].value if estimator in each else None for each in of]
    numbers = [value for value in values if isinstance(value, int | float)]
    return numbers if numbers and len(numbers) == len(values) else None


def _doubts(tables: list[MetricTable], estimator: str, runs: int) -> list[str]:
    """Whether an estimator is consistent, and what it did not estimate.

    The interval of a single run's NEES is that of one step. Errors of other steps hang together with it,
    so that a run within it is not shown to be inconsistent, and no more; innovations say more.
    """
    sentences = []
    judged = [
        measured
        for table in tables
        if (measured := table.quantities.get("nees", {}).get(estimator)) and measured.place
    ]
    if len(judged) == 1:
        [measured] = judged
        low, high = map(format_value, measured.bounds or ())
        where = f"lies {measured.place} the 95 % interval {low} to {high}"
        alone = runs == 1 and measured.place == "within"
        meaning = "one run does not show it to be inconsistent" if alone else MEANING[measured.place]
        sentences.append(f"its NEES of {format_value(measured.value)} {where}: {meaning}")
        sentences += _innovations(tables, estimator) if alone else []
    elif judged:
        consistent = sum(measured.place == "within" for measured in judged)
        is_so = "one run does not show it to be inconsistent" if runs == 1 else "it is consistent"
        sentences.append(f"by NEES {is_so} in {consistent} of {len(judged)} cases")
    failed = sum(_values(tables, estimator, "failed_runs") or [])
    if failed:
        sentences.append(f"{failed:g} of its runs failed")
    share = min(_values(tables, estimator, "estimated_share") or [1.0])
    if share < LEAST_SHARE:
        sentences.append(f"it estimated {100 * share:.1f} % of the span")
    return sentences


def _innovations(tables: list[MetricTable], estimator: str) -> list[str]:
    """What NIS says, which is of all innovations; nothing where there is none."""
    return [
        f"its NIS of {format_value(nis.value)} per component, which says more, lies {nis.place} "
        f"{format_value(nis.bounds[0])} to {format_value(nis.bounds[1])}"
        for table in tables
        if (nis := table.quantities.get("nis_per_component", {}).get(estimator)) and nis.bounds
    ]
