"""The results of an experiment and their folder, with tables, figures, claims and result.json.

A result folder is built next to its final path and moved there when it is complete. result.json lists
its files, and a folder with other files is never replaced.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args
from urllib.parse import quote

from pydantic import SerializerFunctionWrapHandler, model_serializer

from fuselog.pipeline.output import RESULT_FILE as RESULT_FILE
from fuselog.pipeline.output.alarms import Alarm, Cause, Stressing
from fuselog.pipeline.output.charts import Chart, draw, show_names_as_they_are
from fuselog.pipeline.output.claims import Claim, known
from fuselog.recorders.atomic import whole_file, whole_folder
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput, check_format
from fuselog.recorders.parameters import Parameters, build
from fuselog.recorders.parsing import parse_json
from fuselog.replay.judging.intervals import FEWEST_RUNS, Interval, mean_interval

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Longer tables are written only as Parquet, because they are too long to read as text.
CSV_ROWS = 20_000
# Increased when result.json changes incompatibly; a file without it has format 1.
FORMAT = 1
# The table of runs, in a result's folder.
RUNS = Path("tables", "runs.parquet")
# File of the estimators' run times, which differ in every run, so result.json has no hash of it.
TIMINGS = "timings.json"
Bounds = tuple[float, float]
MetricValue = float | list[float] | list[float | None] | None
# The commands that make results; the report's opening depends on them.
Kind = Literal[
    "run",
    "sweep",
    "compare",
    "tune",
    "diagnose",
    "replay",
    "evaluate",
    "noise",
    "ellipsoid",
    "lint",
    "check",
]


@dataclass
class Outcome:
    """The findings of a study.

    Attributes:
        metrics: values by `estimator.quantity_unit[.case]`.
        claims: the statements of the paper, with our verdicts.
        tables: tables by name.
        figures: charts, or other pictures, by name.
        input_sha256: a hash of the input data.
        parameters: parameters of all estimators by label, including defaults.
        bounds: the 95 % range of a metric if the estimator is consistent.
        intervals: the 95 % interval of the true metric, from the variation over runs.
        alarms: warnings about the metrics.
        causes: why an estimator is inconsistent, if it was diagnosed.
        stress: the effect of changes that should not matter, if it was tested.
        timings: run time in s and number of messages of each estimator.
        kind: the command that made the result.
    """

    metrics: dict[str, MetricValue] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)
    tables: dict[str, "pd.DataFrame"] = field(default_factory=dict)
    figures: dict[str, "Chart | Figure"] = field(default_factory=dict)
    input_sha256: str = ""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    bounds: dict[str, Bounds] = field(default_factory=dict)
    intervals: dict[str, Bounds] = field(default_factory=dict)
    alarms: list[Finding] = field(default_factory=list)
    causes: list[Cause] = field(default_factory=list)
    stress: list[Stressing] = field(default_factory=list)
    timings: dict[str, dict[str, float]] = field(default_factory=dict)
    kind: Kind = "run"

    def measure(self, key: str, number: Interval) -> None:
        """Store the value of an Interval `number` as the metric `key`, and its ends as an interval."""
        self.metrics[key], self.intervals[key] = float(number.value), (number.low, number.high)


class Result(Parameters):
    """The content of result.json.

    `files` lists the files in the folder with their SHA-256. The hash of result.json itself is computed
    from its text without this entry. Files that depend on the clock have no hash: timelines, whose rows
    Rerun numbers by time, and `TIMINGS`. `bounds` are the 95 % ranges of metrics of a consistent
    estimator, and `intervals` are the 95 % intervals of the true metrics. `alarms` are warnings about
    the metrics, the worst first. `causes` explain why estimators are inconsistent, if they were
    diagnosed. `stress` is the effect of changes that should not matter; it is left out of the text if it
    was not tested. `kind` is the command that made the result; older results do not state it.
    """

    format: int = FORMAT
    experiment: str
    fuselog: str
    settings: dict[str, Any]
    input_sha256: str
    metrics: dict[str, MetricValue]
    claims: list[Claim]
    files: dict[str, str | None] = {}
    bounds: dict[str, Bounds] = {}
    intervals: dict[str, tuple[float | None, float | None]] = {}
    alarms: list[Alarm] = []
    causes: list[Cause] = []
    stress: list[Stressing] = []
    kind: Kind | None = None

    @model_serializer(mode="wrap")
    def _as_it_is_written(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        written: dict[str, Any] = write(self)
        return {
            name: value for name, value in written.items() if value or name not in ("stress", "kind")
        }

    @property
    def made_by(self) -> Kind:
        """Return the command that made the result; for older results, infer it."""
        if self.kind is not None:
            return self.kind
        if "sides" in self.settings:
            return "compare"
        if "sweep" in self.settings:
            return "sweep"
        return next((kind for kind in get_args(Kind) if kind == self.experiment), "run")

    @property
    def contents(self) -> list[str]:
        """Return the top-level folders and files of the result's folder."""
        return [*dict.fromkeys(Path(name).parts[0] for name in self.files)]


def split_metric(key: str) -> tuple[str, str, str]:
    """Split a metric key `estimator.quantity_unit[.case]` into estimator, quantity and case.

    A key without a dot is a quantity without an estimator, as for a trajectory file.
    """
    if "." not in key:
        return "", key, ""
    estimator, _, rest = key.partition(".")
    quantity, _, case = rest.partition(".")
    return estimator, quantity, case


def in_order(metrics: Mapping[str, MetricValue], estimators: Iterable[str]) -> dict[str, MetricValue]:
    """Sort metrics by these estimators, in this order; other metrics follow in their old order."""
    place = {label: index for index, label in enumerate(estimators)}
    keys = sorted(metrics, key=lambda key: place.get(split_metric(key)[0], len(place)))
    return {key: metrics[key] for key in keys}


class Measured(NamedTuple):
    """A metric's value, or a word instead of it, and its 95 % range if the estimator is consistent."""

    value: MetricValue | str = None
    bounds: Bounds | None = None

    @property
    def place(self) -> Literal["below", "within", "above", ""]:
        """Return the position of the value relative to its bounds; return "" if either is missing."""
        if self.bounds is None or not isinstance(self.value, int | float):
            return ""
        low, high = self.bounds
        return "below" if self.value < low else "above" if self.value > high else "within"


@dataclass(frozen=True)
class MetricTable:
    """The metrics of one case, by quantity and then by estimator, always in the same order."""

    case: str
    estimators: list[str]
    quantities: dict[str, dict[str, Measured]]


def read_table(path: Path) -> "pd.DataFrame":
    """Read a table from a result's folder; raise BadInput if it is damaged.

    Arrow itself cannot open files whose names the locale's encoding cannot represent.
    """
    import pandas as pd

    try:
        with path.open("rb") as file:
            return pd.read_parquet(file)
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: the table is damaged ({error}); run the experiment again") from error


def metric_tables(
    metrics: Mapping[str, MetricValue],
    bounds: Mapping[str, Bounds],
    runs: "pd.DataFrame | None" = None,
) -> list[MetricTable]:
    """Group metrics by case, and add the interval of the mean NEES if there is a table of runs."""
    over_runs = {} if runs is None else _nees_over_runs(runs)
    estimators = list(dict.fromkeys(split_metric(key)[0] for key in metrics))
    cases: dict[str, dict[str, dict[str, Measured]]] = {}
    for key, value in metrics.items():
        estimator, quantity, case = split_metric(key)
        measured = Measured(value, bounds.get(key))
        quantities = cases.setdefault(case, {})
        quantities.setdefault(quantity, {})[estimator] = measured
        if quantity == "nees" and (estimator, case) in over_runs:
            interval = Measured(over_runs[estimator, case])
            quantities.setdefault("nees_mean_over_runs", {})[estimator] = interval
    return [MetricTable(case, estimators, quantities) for case, quantities in sorted(cases.items())]


def _nees_over_runs(runs: "pd.DataFrame") -> dict[tuple[str, str], str]:
    """Compute the mean of the runs' NEES with its 95 % interval, by estimator and case.

    There is no interval for fewer than `FEWEST_RUNS` runs. A table of runs may lack the NEES.
    """
    if not {"estimator", "case", "nees"} <= {*runs}:
        return {}
    intervals = {}
    for (estimator, case), rows in runs.groupby(["estimator", "case"]):
        nees = rows["nees"].dropna()
        if len(nees) >= FEWEST_RUNS:
            components = rows.filter(regex="^rmse_").notna().any().sum()
            intervals[str(estimator), str(case)] = f"{mean_interval(nees)}, aim {components}"
    return intervals


def result_folder(folder: Path) -> AbstractContextManager[Path]:
    """Open a temporary folder next to `folder`, which replaces an earlier result after success.

    Raises BadInput if `folder` exists and is not a result of fuselog, if another process is filling it,
    or if it cannot be written.
    """
    return whole_folder(folder, lambda found: require_ours(found, folder))


def require_ours(found: Path, place: Path) -> None:
    """Raise BadInput unless a folder contains an unchanged result of fuselog and nothing else."""
    try:
        result = read_result(found)
    except BadInput:
        raise BadInput(
            f"{place}: exists and is not a result of fuselog; give another folder with --out"
        ) from None
    values = parse_json((found / RESULT_FILE).read_text(encoding="utf-8"))
    if _digest(values) != result.files.get(RESULT_FILE):
        raise BadInput(
            f"{place / RESULT_FILE}: was changed after fuselog wrote it, or was written by an older "
            "version; give another folder with --out"
        )
    expected = {Path(name): digest for name, digest in result.files.items()}
    parents = {parent for name in expected for parent in name.parents}
    for path in sorted(found.rglob("*")):
        name = path.relative_to(found)
        if path.is_symlink() or not (path.is_file() if name in expected else name in parents):
            what = "was not written by fuselog"
        elif (
            name in expected
            and name != Path(RESULT_FILE)
            and expected[name] not in (None, hash_of(path))
        ):
            what = "was changed after fuselog wrote it"
        else:
            continue
        raise BadInput(f"{place / name}: {what}; move it away, or give another folder with --out")


def _sealed(result: Result) -> Result:
    """Add the SHA-256 of the result's text to the list of its files."""
    digest = _digest(result.model_dump(mode="json"))
    return result.model_copy(update={"files": {**result.files, RESULT_FILE: digest}})


def _digest(values: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of a result's text without its own hash."""
    files = {name: digest for name, digest in values["files"].items() if name != RESULT_FILE}
    return hashlib.sha256(_text({**values, "files": files}).encode()).hexdigest()


def _text(values: Mapping[str, Any]) -> str:
    return json.dumps(values, indent=2, allow_nan=False) + "\n"


def _is_by_clock(path: Path) -> bool:
    return path.suffix == ".rrd" or path.name == TIMINGS


def hash_of(path: Path) -> str:
    """Compute the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def import_writers() -> None:
    """Import the libraries with which results are summarised, written and printed.

    This takes seconds, so it is done while workers compute.
    """
    for name in (
        *("llvmlite.binding", "scipy.special", "pandas", "pyarrow.pandas_compat"),
        *("pyarrow.csv", "pyarrow.parquet"),
        *("matplotlib.backends.backend_svg", "matplotlib.figure", "matplotlib.mathtext"),
    ):
        import_module(name)


def write_outcome(
    folder: Path, experiment: str, settings: Mapping[str, Any], outcome: Outcome
) -> Result:
    """Write tables (Parquet, short ones also CSV), figures (SVG, charts also JSON) and result.json.

    Returns the content of result.json.
    """
    # imported here, because lists and --help do not need them
    import matplotlib as mpl
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    for name, table in outcome.tables.items():
        (folder / "tables").mkdir(exist_ok=True)
        columns = pyarrow.Table.from_pandas(table, preserve_index=False)
        with (folder / "tables" / f"{name}.parquet").open("wb") as file:
            pyarrow.parquet.write_table(columns, file)
        if len(table) <= CSV_ROWS:
            with (folder / "tables" / f"{name}.csv").open("wb") as file:
                pyarrow.csv.write_csv(columns, file)
    for name, figure in outcome.figures.items():
        (folder / "figures").mkdir(exist_ok=True)
        path = folder / "figures" / f"{quote(name, safe=' ')}.svg"  # topics have slashes
        if isinstance(figure, Chart):
            path.with_suffix(".json").write_text(figure.model_dump_json() + "\n", encoding="utf-8")
            figure = draw(figure)
        with mpl.rc_context({"svg.hashsalt": "fuselog"}):
            show_names_as_they_are(figure)
            canvas: Any = FigureCanvasSVG(figure)
            canvas.print_svg(path, metadata={"Date": None})  # savefig draws a figure with a layout twice
    if outcome.timings:
        (folder / TIMINGS).write_text(json.dumps(outcome.timings, indent=2) + "\n", encoding="utf-8")
    written = sorted(path for path in folder.rglob("*") if path.is_file())
    result = _sealed(
        Result(
            experiment=experiment,
            fuselog=version("fuselog"),
            settings=dict(settings),
            input_sha256=outcome.input_sha256,
            metrics=in_order(plain(outcome.metrics), settings.get("estimators", ())),
            bounds={key: bounds for key, bounds in outcome.bounds.items() if key in outcome.metrics},
            intervals={
                key: (_number(low), _number(high)) for key, (low, high) in outcome.intervals.items()
            },
            claims=[known(claim) for claim in outcome.claims],
            alarms=outcome.alarms,
            causes=outcome.causes,
            stress=outcome.stress,
            kind=outcome.kind,
            files={
                path.relative_to(folder).as_posix(): None if _is_by_clock(path) else hash_of(path)
                for path in written
            },
        )
    )
    (folder / RESULT_FILE).write_text(_text(result.model_dump(mode="json")), encoding="utf-8")
    return result


def keep(
    folder: Path, result: Result, **found: Sequence[Cause] | Sequence[Stressing] | Sequence[Claim]
) -> Result:
    """Add later findings (`causes`, or `stress` and `claims`) to a result's folder."""
    sealed = _sealed(result.model_copy(update={name: [*each] for name, each in found.items()}))
    with whole_file(folder / RESULT_FILE) as new:
        new.write_text(_text(sealed.model_dump(mode="json")), encoding="utf-8")
    return sealed


def read_result(folder: Path) -> Result:
    """Read the result.json of a result folder.

    Raises BadInput if the file is missing, damaged or in another format.
    """
    path = folder / RESULT_FILE
    try:
        values = parse_json(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise BadInput(f"{folder}: has no {RESULT_FILE}; give a folder that fuselog run wrote") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); run the experiment again") from None
    if not isinstance(values, dict):
        raise BadInput(f"{path}: is not a result of fuselog run; run the experiment again")
    check_format(path, values.get("format", 1), FORMAT)
    return build(Result, values, str(path))


def plain(metrics: Mapping[str, MetricValue]) -> dict[str, MetricValue]:
    """Convert metrics for JSON: NaN and infinity become null."""
    return {
        key: [_number(entry) for entry in value] if isinstance(value, list) else _number(value)
        for key, value in metrics.items()
    }


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None
