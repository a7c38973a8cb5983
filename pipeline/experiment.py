"""Experiments: scenario (or real data) x estimators x metrics, one TOML file each."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PositiveFloat, PositiveInt

from pipeline.ensemble import Progress, no_progress
from pipeline.results import Outcome, result_folder, write_outcome
from recorders.errors import BadInput
from recorders.parameters import Parameters, build, merge
from recorders.registry import load

SHIPPED = resources.files("fuselog_data")


class Record(Parameters):
    """What to simulate."""

    scenario: str
    parameters: dict[str, Any] = {}


class Import(Parameters):
    """What to import; the data's place comes from --data."""

    source: str
    parameters: dict[str, Any] = {}


class Experiment(Parameters):
    """One experiment as its TOML file says it.

    `estimators` maps a label to parameters; a parameter `kind` names the estimator where the label is
    not its name. `options` are the study's own.
    """

    title: str
    study: str = "localization"
    seed: Annotated[int, Field(ge=0)] = 0
    runs: PositiveInt = 1
    record: Record | None = None
    import_: Import | None = Field(None, alias="import")
    estimators: dict[str, dict[str, Any]] = {}
    gap_limit_s: PositiveFloat = 0.2
    options: dict[str, Any] = {}


@dataclass(frozen=True)
class Setting:
    """Where and how an experiment runs."""

    folder: Path
    data: Path | None = None
    logs: int = 20
    progress: Progress = no_progress


# A study does an experiment's work: writes its logs and timeline into the setting's folder, and returns
# what it found with a hash of its input data.
Study = Callable[[Experiment, Setting], tuple[Outcome, str]]


def shipped(kind: str) -> dict[str, Path]:
    """The TOML files of a kind ("experiments", "scenarios") that ship with fuselog, by name."""
    with resources.as_file(SHIPPED / kind) as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file's values; raises BadInput where it is missing or malformed."""
    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInput(f"{path}: is not readable as TOML ({error})") from None


def load_experiment(
    name: str, settings: Mapping[str, Any], over: Mapping[str, Any]
) -> tuple[str, Experiment]:
    """An experiment by its shipped name or its TOML file, with settings and then `over` over it.

    A setting goes to the estimator or the part of the experiment that its first word names, else to the
    scenario's or importer's parameters: `ekf.gate_probability=1`, `gap_limit_s=1`, `robots=2`.
    """
    if name.endswith(".toml"):
        path = Path(name)
    else:
        known = shipped("experiments")
        if name not in known:
            raise BadInput(f"no experiment '{name}'; there are: {', '.join(known)}, or give a .toml")
        path = known[name]
    values = read_toml(path)
    return path.stem, build(Experiment, {**_apply(values, settings), **over}, str(path))


def load_scenario(name: str) -> tuple[str, dict[str, Any], str]:
    """A scenario by its registered name, its shipped file or a TOML file: recorder, parameters, label.

    A scenario file has `recorder` and a table `parameters`.
    """
    known = shipped("scenarios")
    if not name.endswith(".toml") and name not in known:
        return name, {}, name
    path = known.get(name, Path(name))
    values = read_toml(path)
    recorder, parameters = values.get("recorder"), values.get("parameters", {})
    if not isinstance(recorder, str) or not isinstance(parameters, dict):
        raise BadInput(f'{path}: a scenario file has recorder = "NAME" and a [parameters] table')
    return recorder, parameters, path.stem


def _apply(values: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    own = {"title", "study", "gap_limit_s", "options", "estimators"}
    part = "import" if "import" in values else "record"
    over: dict[str, Any] = {}
    for key, value in settings.items():
        if key in own:
            over = merge(over, {key: value})
        elif key in values.get("estimators", {}):
            over = merge(over, {"estimators": {key: value}})
        else:
            over = merge(over, {part: {"parameters": {key: value}}})
    return merge(values, over)


def run_experiment(
    name: str,
    experiment: Experiment,
    folder: Path,
    *,
    data: Path | None = None,
    logs: int = 20,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Run an experiment into its folder, which appears whole or not at all; returns result.json."""
    if experiment.import_ is not None and data is None:
        raise BadInput(f"experiment {name} needs real data: give its folder with --data")
    study: Study = load("studies", experiment.study)
    with result_folder(folder) as part:
        outcome, input_hash = study(experiment, Setting(part, data, logs, progress))
        settings = experiment.model_dump(mode="json", by_alias=True, exclude_none=True)
        if data is not None:
            settings["data"] = str(data)
        return write_outcome(part, name, settings, outcome, input_hash)
