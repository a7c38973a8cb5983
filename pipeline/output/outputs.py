"""Protection of existing files: commands change or delete only files that fuselog wrote for them.

An existing file is replaced only if its content shows that the same command wrote it. An output is
never an input, another output or a symbolic link; paths are compared after they are resolved.
"""

import json
import os
import warnings
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

from fuselog.pipeline.output.results import RESULT_FILE, read_result, require_ours
from fuselog.recorders.atomic import settled
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, open_log
from fuselog.recorders.parsing import parse_json
from fuselog.recorders.remote.paths import RemotePath

MOST_SETTINGS = 3  # largest number of settings that a sentence names
# Notes of a log's run on how it was cut, merged or relabelled, and by which command last.
CHANGES, CHANGED_BY = "changes", "changed by"


class Kind(NamedTuple):
    """A kind of file that a command writes: suffix, description, and a test that recognises it."""

    suffix: str
    what: str
    is_written: Callable[[Path], bool]


def check_files(outputs: Sequence[tuple[Path, Kind]], inputs: Mapping[str, Iterable[Path]]) -> None:
    """Raise BadInput if a command may not write one of its outputs.

    Args:
        outputs: the files to write.
        inputs: the files to read, by their role in messages: `{"log": [...]}`.
    """
    taken = {_identity(path): f"{role} {path}" for role, paths in inputs.items() for path in paths}
    for named, kind in outputs:
        path = settled(named)
        if path.suffix.lower() != kind.suffix:
            raise BadInput(f"{path}: the output is {kind.what}; give a name that ends in {kind.suffix}")
        _refuse_link(path)
        if _identity(path) in taken:
            raise BadInput(f"{path}: would replace the {taken[_identity(path)]}; give another name")
        if _is_of_result(path):
            raise BadInput(f"{path}: is part of the result in that folder; give another name")
        if path.exists() and not (path.is_file() and kind.is_written(path)):
            raise BadInput(
                f"{path}: exists and is not {kind.what}; give another name, or remove the file yourself"
            )
        _refuse_closed(path)
        taken[_identity(path)] = f"output {path}"


def check_folder(folder: Path, inputs: Mapping[str, Iterable[Path]]) -> None:
    """Raise BadInput if a folder that would be replaced is a link or a root, or contains an input.

    Also raises BadInput if the folder could not be created.
    """
    folder = settled(folder)
    if not folder.name:
        raise BadInput(f"{folder}: is the root of a file system; give a folder in it")
    _refuse_link(folder)
    for role, paths in inputs.items():
        for path in paths:
            place = path if isinstance(path, RemotePath) else Path(os.path.realpath(path))
            if _identity(folder) in map(_identity, (place, *place.parents)):
                raise BadInput(f"{folder}: the {role} {path} is in it; give another folder")
    _refuse_closed(folder)


def check_outputs(
    folder: Path | None, timeline: Path | None, inputs: Mapping[str, Iterable[Path]]
) -> None:
    """Raise BadInput if a command may not write its result folder or its timeline.

    The check runs before the work starts, so no work is lost.
    """
    if timeline is not None:
        check_files([(timeline, TIMELINE)], inputs)
    if folder is not None:
        check_folder(folder, {**inputs, "output": list(filter(None, [timeline]))})
        if settled(folder).exists():
            require_ours(settled(folder), folder)


def _refuse_link(path: Path) -> None:
    if path.is_symlink():
        raise BadInput(f"{path}: is a symbolic link; give the path that it leads to, or another name")


def _refuse_closed(path: Path) -> None:
    """Raise BadInput if a path is in a file, or in a folder in which this user may not create files."""
    folder = next(each for each in path.absolute().parents if each.exists())
    if not folder.is_dir():
        raise BadInput(f"{path}: cannot be written, as {folder} is not a folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(
            f"{path}: cannot be written, as you may not write to {folder}; give another place"
        )


def _is_of_result(path: Path) -> bool:
    """Test whether a file is listed by the result folder that contains it."""
    place = Path(os.path.realpath(path))
    for folder in place.parents:
        if (folder / RESULT_FILE).is_file():
            with suppress(BadInput):
                return place.relative_to(folder).as_posix() in read_result(folder).files
    return False


def _identity(path: Path) -> Hashable:
    """Return a key that is the same for all names of a file, even before the file exists."""
    if isinstance(path, RemotePath):
        return str(path)  # its state would need a copy
    try:
        state = path.stat()
    except OSError:
        return os.path.realpath(path.parent), path.name
    return state.st_dev, state.st_ino


def run_written(path: Path) -> RunMetadata | None:
    """Return the run of an existing log that fuselog wrote, or None."""
    return _run_of(path) if path.is_file() else None


def replaced(path: Path, before: RunMetadata | None, now: RunMetadata | None) -> str:
    """Describe how the settings of a replaced log differ from the new ones; return "" if they agree."""
    if before is None or now is None:
        return ""
    old, new = _settings_of(before), _settings_of(now)
    names = [name for name in dict.fromkeys([*old, *new]) if old.get(name) != new.get(name)]
    facts = [f"{name} = {_shown(old, name)}, now {_shown(new, name)}" for name in names[:MOST_SETTINGS]]
    more = f"; and {len(names) - MOST_SETTINGS} more" if len(names) > MOST_SETTINGS else ""
    return f"{path}: replaced a log with other settings: {'; '.join(facts)}{more}" if facts else ""


def _settings_of(run: RunMetadata) -> dict[str, str]:
    """Return the settings of a log's run or of its estimators, as JSON by name."""
    found: dict[str, Any] = {"scenario": run.scenario, "seed": run.seed, "run": run.run}
    found |= run.parameters
    if _is_estimates(run):
        own = parse_json(run.notes["estimators"])
        found |= {**run.notes, "estimators": list(own), **{name: of for name, of in own.items() if of}}
    return {name: json.dumps(value) for name, value in found.items()}


def _shown(settings: Mapping[str, str], name: str) -> str:
    return shorten(settings.get(name, "not set"), 60)


def _run_of(path: Path, *, is_changed: bool = False) -> RunMetadata | None:
    """Return the run of a log that fuselog wrote (or edited, if `is_changed`); otherwise return None."""
    with suppress(BadInput):
        run = open_log(path).run if _is_log(path) else None
        return run if run is not None and (CHANGES in run.notes) == is_changed else None
    return None


def _is_log(path: Path) -> bool:
    """Test whether a file is a complete log that fuselog wrote."""
    from mcap.reader import make_reader

    from fuselog.recorders.log.container.writing import LIBRARY

    try:
        open_log(path)
        with path.open("rb") as file:
            return make_reader(file).get_header().library == LIBRARY
    except (BadInput, OSError):
        return False


def _is_estimates(run: RunMetadata) -> bool:
    return {"log", "estimators"} <= run.notes.keys()


def _is_recorded(path: Path) -> bool:
    run = _run_of(path)
    return run is not None and run.seed is not None and not _is_estimates(run)


def _holds_estimates(path: Path) -> bool:
    run = _run_of(path)
    return run is not None and _is_estimates(run)


def changed(command: str) -> Kind:
    """Describe the kind of log that a command on logs, such as cut or merge, writes."""

    def is_changed(path: Path) -> bool:
        run = _run_of(path, is_changed=True)
        return run is not None and run.notes.get(CHANGED_BY) == command

    return Kind(".mcap", f"a log that fuselog {command} wrote", is_changed)


def imported(source: str) -> Kind:
    """Describe the kind of log that an importer writes."""

    def is_imported(path: Path) -> bool:
        run = _run_of(path)
        return run is not None and run.seed is None and run.scenario == source and not _is_estimates(run)

    return Kind(".mcap", f"a log that fuselog imported from {source} data", is_imported)


def _is_timeline(path: Path) -> bool:
    from rerun.chunk import RrdReader

    from fuselog.replay.timeline.sinks import rerun_path

    with warnings.catch_warnings(action="ignore"):  # warnings about truncated files
        try:
            stores = RrdReader(rerun_path(path)).recordings()
        except (BadInput, OSError, RuntimeError, ValueError):
            return False
    return bool(stores) and all(store.application_id.startswith("fuselog") for store in stores)


def _is_picture(path: Path) -> bool:
    from PIL import Image

    from fuselog.replay.timeline.viewer import SOFTWARE

    try:
        with Image.open(path) as image:
            return image.info.get("Software") == SOFTWARE
    except (OSError, SyntaxError, ValueError):
        return False


def _is_report(path: Path) -> bool:
    from fuselog.pipeline.output.report import is_report

    return is_report(path)


# Users edit mappings, so they are never replaced.
MAPPING = Kind(".toml", "a mapping that may be replaced", lambda _: False)
LOG = Kind(".mcap", "a log that fuselog wrote", _is_log)
RECORDED = Kind(".mcap", "a log that fuselog recorded", _is_recorded)
ESTIMATES = Kind(".mcap", "an estimates log that fuselog wrote", _holds_estimates)
TIMELINE = Kind(".rrd", "a timeline that fuselog wrote", _is_timeline)
PICTURE = Kind(".png", "a screenshot that fuselog took", _is_picture)
REPORT = Kind(".html", "a report that fuselog wrote", _is_report)
