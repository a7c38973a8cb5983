"""Functions of commands that process each log of a selection by itself."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fuselog.pipeline.api.over_logs import Replaying, run_over_logs, show_over_logs
from fuselog.pipeline.logs.cataloguing import Selection, select
from fuselog.pipeline.output.terminal import progress
from fuselog.pipeline.runs.executors import PoolFactory, pool_for, states_of
from fuselog.pipeline.runs.settings import settings_of_estimators, sigmas_of, split_texts
from fuselog.recorders.errors import BadInput
from fuselog.replay.foreign.naming import program_files


class Chosen(NamedTuple):
    """A selection of logs, the workers that process it, and the options that state it."""

    selection: Selection
    open_pool: PoolFactory
    stated: dict[str, Any]


def _chosen(options: Mapping[str, Any]) -> Chosen:
    """Select logs by the options that `selecting` returns."""
    selection = select(options["paths"], options["where"], options["group"])
    stated = {"selection": [str(path) for path in options["paths"]]}
    stated |= {name: options[name] for name in ("where", "group") if options[name] is not None}
    return Chosen(
        selection, pool_for(options["workers"], options["scheduler"], len(selection.logs)), stated
    )


def replay_selection(
    selection: Mapping[str, Any],
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
        raise BadInput(f"--start-from {origins[0]}: only truth applies to the logs of a selection")
    chosen = _chosen(selection)
    alterations, own = split_texts(settings)
    estimators = settings_of_estimators(names, own, settings_file, model=model, every_s=every_s)
    options |= {"start_from": origins, "start_sigma": sigmas_of(sigmas, "--start-sigma")}
    options["set"] = alterations
    place = Path("out/replay") if out is None else out
    if place.suffix == ".mcap":
        raise BadInput(f"--out {out}: a selection has a result folder; give a folder")
    programs = states_of(program_files(estimators))
    task = Replaying(estimators, options, recover, place.absolute(), programs)
    stated = {**chosen.stated, "estimators": estimators, "options": options}
    found = run_over_logs(task, chosen.selection, place, "replay", stated, chosen.open_pool, progress)
    return show_over_logs(found, as_json=as_json)
