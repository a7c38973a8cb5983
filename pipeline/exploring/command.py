"""The command `fuselog explore`, which serves the page until it is closed."""

from collections.abc import Sequence
from pathlib import Path

from fuselog.pipeline.exploring.explore import explore
from fuselog.pipeline.output.terminal import say
from fuselog.pipeline.runs.settings import settings_of_estimators, split_texts
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource


def explore_log(
    log: Path,
    names: Sequence[str],
    *,
    model: str | None,
    no_browser: bool,
    recover: bool,
    gap_limit_s: float,
    settings_file: Path | None,
    settings: Sequence[str],
) -> None:
    """Serve the page, print its address, and wait until it is closed."""
    alterations, own = split_texts(settings)
    chosen = settings_of_estimators(names, own, settings_file, model=model)
    source = LogSource(open_log(log, recover=recover))
    explorer = explore(source, chosen, set=alterations, gap_limit_s=gap_limit_s, show=not no_browser)
    say(f"exploring {log} at {explorer.url}; close the page or press Ctrl-C to end")
    explorer.wait()
