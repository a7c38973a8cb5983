"""The command `fuselog noise`, which prints the noise of sensors and writes the result folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.terminal import print_json, print_table, say, status
from fuselog.pipeline.sensing.foreign_files import explained
from fuselog.pipeline.sensing.noise import noise
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource


def show_noise(
    log: Path,
    topics: Sequence[str],
    sheet: Mapping[str, str],
    *,
    taus: Sequence[float],
    out: Path | None,
    recover: bool,
    as_json: bool,
) -> None:
    """Print a table of noise values with intervals and sentences, or explain a file of another tool."""
    sentences = explained(log)
    if sentences:
        if out is not None or topics or sheet or taus:
            raise BadInput(
                f"{log}: this file has another tool's numbers and no samples; give it without options"
            )
        if as_json:
            print_json({"path": str(log), "notes": sentences})
        else:
            say(*sentences)
        return
    check_outputs(out, None, {"log": [log]})
    with status() as show:
        show("fitting the noise of each column")
        found = noise(LogSource(open_log(log, recover=recover)), topics, sheet=sheet, taus=taus)
    written = [str(found.save(out).folder)] if out is not None else []
    table = found.table
    if as_json:
        numbers = table.to_dict("records")
        curves = found.curves.to_dict("list")
        print_json(
            {
                "log": str(log),
                "numbers": numbers,
                "curves": curves,
                "notes": found.notes,
                "written": written,
            }
        )
        return
    print_table(("column", "term", "value", "95 % from", "to"), table.to_numpy().tolist())
    say(*found.notes, *written)
