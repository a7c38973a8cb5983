"""Names where the runs of an experiment come from: a scenario, real data, or logs."""

from importlib import resources
from pathlib import Path
from typing import Any

from recorders.errors import BadInput, choices
from recorders.parameters import Parameters
from recorders.parsing import read_toml
from recorders.registry import available


class Record(Parameters):
    """What to simulate.

    Attributes:
        scenario: a scenario by name or TOML file.
        parameters: what differs from its defaults, by name.
    """

    scenario: str
    parameters: dict[str, Any] = {}


class Import(Parameters):
    """What to import; the data's place comes from --data.

    Attributes:
        source: name of the importer.
        parameters: what differs from its defaults, by name.
    """

    source: str
    parameters: dict[str, Any] = {}


class Logs(Parameters):
    """Logs to replay, one run each.

    Attributes:
        files: files or patterns such as `drive-*.mcap`, from the folder of the experiment's file on;
            estimates that lie beside the logs are left out.
    """

    files: list[str] = []


SHIPPED = resources.files("fuselog_data")


def shipped(kind: str) -> dict[str, Path]:
    """The TOML files of a kind ("experiments", "scenarios") that ship with fuselog, by name."""
    with resources.as_file(SHIPPED / kind) as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_scenario(name: str) -> tuple[str, dict[str, Any], str]:
    """A scenario by its registered name, its shipped file or a TOML file: recorder, parameters, label.

    A scenario file has `recorder` and a table `parameters`.
    """
    files, recorders = shipped("scenarios"), available("recorders")
    if name in recorders:
        return name, {}, name
    if not name.endswith(".toml") and name not in files:
        known = [*recorders, *files]
        raise BadInput(f"no scenario '{name}', nor is it a .toml file; {choices(name, known)}")
    path = files.get(name, Path(name))
    values = read_toml(path)
    recorder, parameters = values.get("recorder"), values.get("parameters", {})
    if not isinstance(recorder, str) or not isinstance(parameters, dict):
        raise BadInput(
            f'{path}: a scenario file needs recorder = "NAME" and a [parameters] table; add them'
        )
    return recorder, parameters, path.stem
