"""Inputs of an experiment: a scenario, real data, or logs."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from io import BufferedIOBase
from pathlib import Path
from typing import Any, cast

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import Parameters, describe
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.registry import available, load


class Record(Parameters):
    """A simulation to record.

    Attributes:
        scenario: a scenario by name or TOML file.
        parameters: parameter values that differ from the defaults, by name.
    """

    scenario: str
    parameters: dict[str, Any] = {}


class Import(Parameters):
    """An import of data, whose path is given with --data.

    Attributes:
        source: name of the importer.
        parameters: parameter values that differ from the defaults, by name.
    """

    source: str
    parameters: dict[str, Any] = {}


class Logs(Parameters):
    """The logs to replay, one run per log.

    Attributes:
        files: files or patterns such as `drive-*.mcap`, relative to the folder of the experiment's file;
            estimates logs are ignored if a pattern has several matches.
        catalog: a catalog with more logs, relative to the same folder.
        where: a condition on the columns of the catalog.
        unreadable: why logs of the selection cannot be read, by path.
    """

    files: list[str] = []
    catalog: str | None = None
    where: str | None = None
    unreadable: dict[str, str] | None = None


class Recording(Parameters):
    """A recording to which claims refer, identified by the content of its files.

    Attributes:
        files: pattern of its files, such as `*_detections.json` or `path_9/*.csv`; other files are
            ignored.
        sha256: hash of all files together; see `digest_of`.
    """

    files: str
    sha256: str = ""

    def digest_of(self, files: Sequence[Path]) -> str:
        """Hash the decompressed files of this recording with SHA-256; return "" if it has no files."""
        digests = sorted(_digest(path) for path in files if path.match(self.files))
        return hashlib.sha256("".join(digests).encode()).hexdigest() if digests else ""


def _digest(path: Path) -> str:
    from fuselog.recorders.importers.tables.files import (  # Arrow is slow to import
        DAMAGED,
        open_decompressed,
    )

    try:
        with open_decompressed(path) as file:
            return hashlib.file_digest(cast(BufferedIOBase, file), "sha256").hexdigest()
    except DAMAGED as error:
        raise BadInput(f"{path}: cannot be read ({error}); give the complete file") from None


def holding(recordings: Mapping[str, Recording], files: Sequence[Path], where: str) -> dict[str, bool]:
    """Test for each recording, by name, whether these files belong to it.

    Raises BadInput, naming `where`, if a recording has no hash.
    """
    digests = {name: recording.digest_of(files) for name, recording in recordings.items()}
    for name, digest in digests.items():
        if not recordings[name].sha256:
            raise BadInput(
                f"{where}: recordings.{name} has no sha256; that of these files is '{digest}'"
            )
    return {name: recording.sha256 == digests[name] for name, recording in recordings.items()}


SHIPPED = resources.files("fuselog_data")
KEPT = SHIPPED / "lists.json"  # see `fuselog.pipeline.api.lists`


def shipped(kind: str) -> dict[str, Path]:
    """Find the TOML files of a kind ("experiments", "scenarios") that ship with fuselog, by name."""
    with resources.as_file(SHIPPED / kind) as folder:
        return {path.stem: path for path in sorted(folder.rglob("*.toml"), key=lambda path: path.name)}


def defaults_of(recorder: str) -> dict[str, Any]:
    """Return a recorder's default parameters by full name; raise BadInput if it cannot be loaded."""
    from fuselog.recorders.recording import Recorder

    described = describe(load("recorders", recorder, Recorder).parameters)
    return {each.name: each.default for each in described}


@cache
def kept_lists() -> dict[str, dict[str, Any]]:
    """Read what is kept of our own modules and files, by list and place."""
    kept: dict[str, dict[str, Any]] = json.loads(KEPT.read_text(encoding="utf-8"))
    return kept


def kept_defaults(recorder: str) -> dict[str, Any]:
    """Do the same as `defaults_of`, for our own recorders without importing them."""
    place = available("recorders").get(recorder)
    kept = kept_lists()["defaults"]
    if place is None or place.value not in kept:
        return defaults_of(recorder)
    return dict(kept[place.value])


def load_scenario(name: str) -> tuple[str, dict[str, Any], str]:
    """Find a scenario by its registered name, shipped file or TOML file: recorder, parameters, label.

    A scenario file has `recorder` and a table `parameters`.
    """
    files, recorders = shipped("scenarios"), available("recorders")
    if name in recorders:
        return name, {}, name
    if not name.endswith(".toml") and name not in files:
        known = [*recorders, *files]
        raise BadInput(f"no scenario '{name}', and it is not a .toml file; {choices(name, known)}")
    path = files.get(name, Path(name))
    values = read_toml(path)
    recorder, parameters = values.get("recorder"), values.get("parameters", {})
    if not isinstance(recorder, str) or not isinstance(parameters, dict):
        raise BadInput(
            f'{path}: a scenario file needs recorder = "NAME" and a [parameters] table; add them'
        )
    return recorder, parameters, path.stem
