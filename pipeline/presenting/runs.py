"""Runs as segments of a dataset: what is known about each, and what its drawing is made from.

This module imports nothing slow, so that runs that were listed before are read and shown quickly.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from fuselog.pipeline.output import RESULT_FILE
from fuselog.pipeline.runs.executors import states_of, version_of_code
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parsing import parse_json

Value = float | int | str
Properties = dict[str, dict[str, Value]]
WORST = 20
# The property with the time of an estimator's largest NEES or, without NEES, largest error.
WORST_AT = "worst_at_s"
# The file of the layout of a drawn run.
LAYOUT = "layout.rbl"
WITHOUT_RUNS = (
    "{}: has no row for each run; give results of fuselog run or sweep, such as those of a comparison, "
    "or logs, or leave out --runs and --port"
)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files that describe the runs at paths: result.json of each result, or logs."""
    found: list[Path] = []
    for path in map(Path.absolute, paths):
        is_result = (path / RESULT_FILE).is_file()
        logs = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        found += [path / RESULT_FILE] if is_result else logs
    return found


def results_of(path: Path) -> list[Path]:
    """Return the results that a comparison compared, if the path is its result; otherwise the path."""
    try:
        result = parse_json((path / RESULT_FILE).read_text(encoding="utf-8"))
        return [Path(each) for each in result["settings"]["candidates"]]
    except (OSError, ValueError, KeyError, TypeError):
        return [path]


def hash_of(contents: Any) -> str:
    """Return a short hash of something that JSON can represent."""
    return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Part:
    """The estimates of one run: a log of them, or the result whose settings replay the run again.

    Attributes:
        title: name of this version, if the run has several versions.
        log: the log of the run, if there is one.
        estimates: the log of the estimates, if they were kept.
        result: folder of the result that replays the run, if its estimates were not kept.
        run: the number of the run in the result.
        point: the number of the point, if the result is a sweep.
        settings: hash of the settings that replay the run.
        recover: whether the intact part of damaged logs is read.
    """

    title: str = ""
    log: Path | None = None
    estimates: Path | None = None
    result: Path | None = None
    run: int = 0
    point: int | None = None
    settings: str = ""
    recover: bool = False

    @property
    def files(self) -> list[Path]:
        """Return the logs from which the run is drawn."""
        return [path for path in (self.log, self.estimates) if path is not None]

    @property
    def contents(self) -> list[Any]:
        """Return everything that determines the drawing, except the code."""
        files = [[str(path) for path in self.files], states_of(self.files)]
        return [self.title, *files, self.run, self.settings, self.recover]


@dataclass(frozen=True)
class Segment:
    """One run in a dataset.

    Attributes:
        name: the run's name, from which file names are made.
        of: what was recorded: its log, or a hash of the scenario's settings, seed and number.
        parts: the versions of the run's estimates, the current one first.
        properties: what is known about the run, and about each estimator.
    """

    name: str
    of: str
    parts: tuple[Part, ...]
    properties: Properties

    @property
    def damage(self) -> str:
        """Return what could not be read of the logs; empty if they are intact."""
        return str(self.properties["run"].get("damage", ""))

    def group(self, label: str, case: str) -> str:
        """Return the name of the properties of an estimator, which may have several cases."""
        own = group_of(label, case)
        return own if own in self.properties else label


def group_of(label: str, case: str) -> str:
    """Return the name of the properties of one case of an estimator."""
    return " ".join(filter(None, (label, case)))


class Runs(NamedTuple):
    """The runs of results or of logs.

    Attributes:
        path: the path that was given first, next to which drawings are kept.
        segments: the runs, the worst first.
        order: description of the order of the runs.
        columns: groups and names of the properties that a table shows first.
        gap_limit_s: longest gap over which the truth is interpolated.
        given: the files that were listed; see `files_of`.
    """

    path: Path
    segments: list[Segment]
    order: str
    columns: list[tuple[str, str]]
    gap_limit_s: float
    given: Sequence[Path] = ()

    @property
    def key(self) -> str:
        """Return a hash of everything that determines the list."""
        parts = [part for segment in self.segments for part in segment.parts]
        files = [*self.given, *dict.fromkeys(path for part in parts for path in part.files)]
        results = [
            hashlib.sha256(file.read_bytes()).hexdigest()
            for file in self.given
            if file.name == RESULT_FILE and file.is_file()
        ]
        states = states_of(files)
        return hash_of([[*map(str, files)], states, results, self.gap_limit_s, version_of_code()])

    def chosen(self, text: str) -> list[Segment]:
        """Return the runs of `worst:N`, `all`, or of numbers or names separated by commas.

        Raises BadInput if there is no such run.
        """
        if text == "all":
            return self.segments
        word, _, count = text.partition(":")
        if word == "worst" and (not count or (count.isdecimal() and int(count))):
            return self.segments[: int(count or WORST)]
        by_name = {each.name: each for each in self.segments}
        found: dict[str, Segment] = {}
        for name in text.split(","):
            number = f"run-{int(name):04d}" if name.isdecimal() else name
            own = [each for each in by_name if each == number or each.startswith(f"{name}-")]
            if not own:
                first, last = min(by_name), max(by_name)
                raise BadInput(
                    f"--runs {text}: {self.path} has no run {name}; its {len(by_name)} runs are "
                    f"{first} to {last}; to select several, give worst:N or all"
                )
            found |= {each: by_name[each] for each in own}
        return list(found.values())
