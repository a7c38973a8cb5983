"""Output of `fuselog calibrate` and `fuselog ellipsoid`."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fuselog.pipeline.calibrating.calibrating import calibrate
from fuselog.pipeline.calibrating.ellipsoid import ellipsoid
from fuselog.pipeline.logs.cataloguing import logs_meant
from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.terminal import print_json, print_table, say
from fuselog.pipeline.tuning.command import tune_logs
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource


def calibrate_logs(
    logs: Sequence[Path], *, fixed: Sequence[str], next_motion: bool, **options: Any
) -> None:
    """Calibrate sensors; the arguments are those of `calibrate` and `tune_logs`."""
    tune_logs(logs, search=partial(calibrate, fixed=fixed, next_motion=next_motion), **options)


def show_ellipsoid(
    logs: Sequence[Path],
    field: str,
    *,
    length: float | None,
    out: Path | None,
    recover: bool,
    as_json: bool,
) -> None:
    """Fit an ellipsoid, and print its parameters with intervals, followed by notes."""
    paths = logs_meant(logs).logs
    check_outputs(out, None, {"log": paths})
    sources = [LogSource(open_log(path, recover=recover)) for path in paths]
    found = ellipsoid(sources, field, length=length)
    written = [str(found.save(out).folder)] if out is not None else []
    table = found.table.replace({np.nan: None})
    if as_json:
        print_json(
            {
                "logs": [str(path) for path in paths],
                "parameters": table.to_dict("records"),
                "settings": found.settings,
                "notes": found.notes,
                "written": written,
            }
        )
        return
    print_table(("parameter", "value", "95 % from", "to"), table.to_numpy().tolist())
    say(*found.notes, *written)
