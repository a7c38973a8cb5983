"""What an experiment yields, and its folder: tables, figures, claims, result.json.

A result folder is built beside its place and moved there when it is whole.
"""

import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from recorders.errors import BadInput

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RESULT_FILE = "result.json"
Verdict = Literal["confirmed", "refuted", "not reproducible"]
MetricValue = float | list[float] | list[float | None] | None


@dataclass(frozen=True)
class Claim:
    """A statement of a paper: what it prints, what we measured, our verdict and its reason."""

    claim: str
    paper: str
    ours: str
    verdict: Verdict
    why: str = ""


def judged(claim: str, paper: str, ours: str, holds: bool, why: str = "") -> Claim:
    """A claim that a measured condition confirms or refutes."""
    return Claim(claim, paper, ours, "confirmed" if holds else "refuted", why)


@dataclass
class Outcome:
    """What a study found. Metric keys are `estimator.quantity_unit[.case]`."""

    metrics: dict[str, MetricValue] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)
    tables: dict[str, "pd.DataFrame"] = field(default_factory=dict)
    figures: dict[str, "Figure"] = field(default_factory=dict)


def split_metric(key: str) -> tuple[str, str, str]:
    """Estimator, quantity and case of a metric key `estimator.quantity_unit[.case]`."""
    estimator, _, rest = key.partition(".")
    quantity, _, case = rest.partition(".")
    return estimator, quantity, case


@dataclass(frozen=True)
class MetricTable:
    """The metrics of one case: a row per quantity, a column per estimator."""

    case: str
    estimators: list[str]
    rows: list[tuple[str, list[MetricValue]]]


def metric_tables(metrics: Mapping[str, MetricValue]) -> list[MetricTable]:
    """The metrics by case."""
    estimators = list(dict.fromkeys(split_metric(key)[0] for key in metrics))
    cases: dict[str, dict[str, dict[str, MetricValue]]] = {}
    for key, value in metrics.items():
        estimator, quantity, case = split_metric(key)
        cases.setdefault(case, {}).setdefault(quantity, {})[estimator] = value
    return [
        MetricTable(
            case,
            estimators,
            [
                (quantity, [values.get(estimator) for estimator in estimators])
                for quantity, values in quantities.items()
            ],
        )
        for case, quantities in sorted(cases.items())
    ]


@contextmanager
def result_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill, beside its place; it replaces an earlier result there when all went well.

    Raises BadInput where something else than a result of ours is in the place.
    """
    if folder.exists() and not (folder / RESULT_FILE).is_file():
        raise BadInput(f"{folder}: exists and is no fuselog result; give another folder with --out")
    part = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
    except OSError as error:
        raise BadInput(f"{folder}: cannot be written ({error.strerror})") from error
    try:
        yield part
        old = folder.with_name(folder.name + ".old")
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            folder.rename(old)
        part.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def write_outcome(
    folder: Path, experiment: str, settings: Mapping[str, Any], outcome: Outcome, input_hash: str
) -> dict[str, Any]:
    """Write tables (Parquet and CSV), figures (SVG) and result.json; returns what result.json says."""
    write_tables(folder / "tables", outcome.tables)
    for name, figure in outcome.figures.items():
        (folder / "figures").mkdir(exist_ok=True)
        figure.savefig(folder / "figures" / f"{name}.svg", metadata={"Date": None})
    result = {
        "experiment": experiment,
        "fuselog": version("fuselog"),
        "settings": dict(settings),
        "input_sha256": input_hash,
        "metrics": {key: _plain(value) for key, value in outcome.metrics.items()},
        "claims": [asdict(claim) for claim in outcome.claims],
    }
    text = json.dumps(result, indent=2, allow_nan=False)
    (folder / RESULT_FILE).write_text(text + "\n")
    return result


def write_tables(folder: Path, tables: Mapping[str, "pd.DataFrame"]) -> None:
    """Write every table as NAME.parquet and NAME.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.to_parquet(folder / f"{name}.parquet", index=False)
        table.to_csv(folder / f"{name}.csv", index=False)


def read_result(folder: Path) -> dict[str, Any]:
    """What result.json of a result folder says; raises BadInput where it is missing or damaged."""
    path = folder / RESULT_FILE
    try:
        result: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError:
        raise BadInput(f"{folder}: no {RESULT_FILE}; give a folder that fuselog run wrote") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); run the experiment again") from None
    if not isinstance(result, dict) or not {"experiment", "metrics", "claims"} <= result.keys():
        raise BadInput(f"{path}: is no result of fuselog run; run the experiment again")
    return result


def _plain(value: MetricValue) -> MetricValue:
    """Numbers as JSON has them: NaN and infinity become null."""
    if isinstance(value, list):
        return [_number(entry) for entry in value]
    return _number(value)


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None
