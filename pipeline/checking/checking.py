"""Checks of logs and results against a golden."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuselog.pipeline.altering.sources import NOTE, alter
from fuselog.pipeline.checking.discrepancies import Discrepancy, discrepancies, first_of
from fuselog.pipeline.checking.golden import Replayed, Tolerances, make
from fuselog.pipeline.checking.stored import SUFFIX, Golden, read, write
from fuselog.pipeline.logs.cataloguing import logs_meant
from fuselog.pipeline.output.outputs import Kind, check_files
from fuselog.pipeline.output.results import RESULT_FILE, read_result
from fuselog.pipeline.runs.ensemble import Settings
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.foreign.naming import of_file

Runs = Mapping[str, LogSource | MemorySource]


@dataclass(frozen=True)
class Checked:
    """The result of comparing a replay with its golden.

    Attributes:
        fields: number of compared fields of the golden's streams and metrics, by run and topic.
        found: the differences from the golden.
        sentences: description of the earliest difference.
    """

    fields: Mapping[tuple[str, str], int]
    found: Sequence[Discrepancy]
    sentences: Sequence[str]


def check(runs: Runs, golden: Golden, estimators: Settings | None = None) -> Checked:
    """Replay runs with a golden's settings, and compare field by field.

    Args:
        runs: the runs, by their names in the golden.
        golden: the golden, as returned by `read`.
        estimators: settings of the estimators to replay instead of the golden's.

    Raises BadInput if the runs are not those of the golden, or no estimator supports them.
    """
    stored = golden["settings"]
    if not estimators and not stored["estimators"]:
        raise BadInput("the golden names no estimators; give the estimators that produced it")
    replayed = make(
        runs,
        of_file(stored["estimators"]) if estimators is None else estimators,
        late=stored["late"],
        arrival_order=stored["arrival_order"],
        columns=stored["columns"],
    )
    return compared(golden, replayed)


def compared(golden: Golden, replayed: Replayed) -> Checked:
    """Compare a replay, or estimates from another source, with a golden."""
    found = list(discrepancies(golden, replayed))
    fields = {("", "metrics"): len(golden["metrics"])} if golden["metrics"] else {}
    for name, run in golden["runs"].items():
        fields |= {(name, topic): 4 + len(each["columns"]) for topic, each in run["streams"].items()}
    return Checked(fields, found, first_of(found, replayed, golden) if found else [])


def runs_of(path: Path, where: str | None = None) -> Runs:
    """Return the runs of a log, of a folder or catalog of logs, or of the logs in a result folder.

    Raises BadInput if there are no logs, or if two logs have the same name.
    """
    applied: dict[str, Any] = {}
    if (path / RESULT_FILE).is_file():
        settings = read_result(path).settings
        given, applied = settings.get("logs", {}), settings.get(NOTE) or {}
        stated = given.get("files", []) if isinstance(given, dict) else given
        files = [located(each) for each in stated] or sorted((path / "logs").glob("*.mcap"))
    else:
        files = list(logs_meant([path], where).logs)
    if not files:
        raise BadInput(f"{path}: has no logs to replay; give a log, or a result that keeps its logs")
    runs = {file.name: alter(LogSource(open_log(file)), applied) for file in files}
    if len(runs) < len(files):
        raise BadInput(f"{path}: two of its logs have the same name; check them one by one")
    return runs


def update(
    path: Path,
    place: Path,
    settings: Mapping[str, Any],
    *,
    estimators: Settings,
    columns: Sequence[str] = (),
    tolerances: Tolerances | None = None,
    where: str | None = None,
) -> Golden:
    """Write the golden of the runs at `path` to the file `place`.

    Missing settings are taken from the existing golden, or otherwise from the result.
    """
    check_files([(place, GOLDEN)], {"log": [path]})
    before = read(place) if place.exists() else None
    stated: dict[str, Any] = {} if before is None else dict(before["settings"])
    if not stated and (path / RESULT_FILE).is_file():
        stated = read_result(path).settings
    chosen = estimators or of_file(stated.get("estimators", {}))
    if not chosen:
        raise BadInput(f"{path}: name the estimators of the new golden, such as -e ekf")
    kept = None if before is None else before["tolerances"]
    golden = make(
        runs_of(path, where),
        chosen,
        late=settings.get("late") or stated.get("late"),
        arrival_order=bool(settings.get("arrival_order") or stated.get("arrival_order")),
        columns=columns or stated.get("columns") or ("*",),
        tolerances=tolerances or kept,
    ).golden
    write(place, golden)
    return golden


def _is_golden(path: Path) -> bool:
    try:
        read(path)
    except BadInput as error:
        return "wrote it (format" in str(error)  # a golden of another version
    return True


GOLDEN = Kind(Path(SUFFIX).suffix or ".xz", "a golden of fuselog check", _is_golden)
