"""Functions of commands that process each log of a selection by itself."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.linting import Linting, alterations_for_lint
from fuselog.pipeline.api.over_logs import LOG, Replaying, campaign_of, show_over_logs
from fuselog.pipeline.runs.executors import states_of
from fuselog.pipeline.runs.settings import settings_of_estimators, sigmas_of, split_texts
from fuselog.pipeline.selecting.selection import SelectionOptions
from fuselog.recorders.errors import BadInput
from fuselog.replay.foreign.naming import program_files


def replay_selection(
    selection: SelectionOptions,
    names: Sequence[str],
    *,
    out: Path | None,
    model: str | None,
    every_s: float | None,
    origins: Sequence[str],
    sigmas: Sequence[str],
    recover: bool,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    **options: Any,
) -> bool:
    """Replay each log of a selection; return whether every estimator completed at least one log."""
    refused = {"--save": "save", "--connect": "connect", "--foxglove": "foxglove"}
    refused["--parameters"] = "tells_parameters"
    for option, name in refused.items():
        if options.pop(name):
            raise BadInput(f"{option}: applies to logs that are replayed together; leave it out here")
    if {*origins} - {"truth"}:
        raise BadInput(f"--start-from {origins[0]}: a selection of logs can only start from truth")
    alterations, own = split_texts(settings)
    estimators = settings_of_estimators(names, own, settings_file, model=model, every_s=every_s)
    options |= {"start_from": origins, "start_sigma": sigmas_of(sigmas, "--start-sigma")}
    options["set"] = alterations
    place = Path("out/replay") if out is None else out
    if place.suffix == ".mcap":
        raise BadInput(f"--out {out}: a selection of logs writes a result folder; give a folder")
    programs = states_of(program_files(estimators))
    task = Replaying(estimators, options, recover, place.absolute(), programs)
    stated = {"estimators": estimators, "options": options}
    found = campaign_of(selection, place).run(task, "replay", stated)
    return show_over_logs(found, as_json=as_json)


def lint_selection(
    selection: SelectionOptions,
    *,
    out: Path | None,
    recover: bool,
    as_json: bool,
    settings: Sequence[str],
) -> bool:
    """Check each log of a selection for errors; return whether all can be read and have only hints."""
    alterations = alterations_for_lint(settings)
    campaign = campaign_of(selection, out or Path("out/lint"))
    found = campaign.run(Linting(alterations, recover), "lint", {"set": alterations})
    show_over_logs(found, as_json=as_json, opens=("lint", LOG))
    return bool(found.table["problem"].isna().all() and not found.table["faults"].any())
