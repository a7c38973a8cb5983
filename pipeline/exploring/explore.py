"""The page with sliders for a filter's parameters: the Python function, and `fuselog explore`."""

import webbrowser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fuselog.pipeline.api.planning import Log, Named
from fuselog.pipeline.exploring.session import open_session
from fuselog.pipeline.output.terminal import say
from fuselog.pipeline.runs.settings import settings_of_estimators, split_texts
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.recorders.processes import in_notebook
from fuselog.replay.engine.streams.sources import LogSource

if TYPE_CHECKING:
    from fuselog.pipeline.exploring.serving import Explorer


def explore(
    log: Log,
    estimators: Named,
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    gap_limit_s: float = 0.2,
    show: bool = True,
) -> "Explorer":
    """Serve a page on which parameters can be dragged while the log is replayed.

    The page is served to this machine only, at an address that cannot be guessed. In a notebook, a cell
    whose last line calls this function shows the page.

    Args:
        log: a path, an opened log, or a recording.
        estimators: one or two, in the form that `replay` accepts.
        set: parameters of the filters and alterations of topics, in the form that `replay` accepts.
        gap_limit_s: the longest gap over which the truth is interpolated.
        show: whether to open the page in the browser; this has no effect in a notebook.

    Returns:
        The server of the page: `url` is its address, `wait()` waits until the last page is closed,
        `close()` ends the server.

    Raises BadInput if there are several logs or more than two filters, if a filter cannot follow the
    log, or if the extra `explore` is not installed.
    """
    session = open_session(log, estimators, set=set, gap_limit_s=gap_limit_s)
    try:
        from fuselog.pipeline.exploring.serving import Explorer
    except ModuleNotFoundError as error:
        if error.name != "bokeh":
            raise
        raise BadInput('explore needs Bokeh: pip install "fuselog[explore]"') from None
    explorer = Explorer(session)
    if show and not in_notebook():
        webbrowser.open(explorer.url)
    return explorer


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
