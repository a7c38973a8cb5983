"""The command `fuselog view`: runs as a dataset in Rerun, or one log or run as a timeline."""

import os
from collections.abc import Generator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path
from shlex import quote

from fuselog.pipeline.output import RESULT_FILE
from fuselog.pipeline.output.terminal import progress, say, status, warn
from fuselog.pipeline.presenting.making import TABLE, Kept, Made, require_ours, runs_at
from fuselog.pipeline.presenting.options import Options
from fuselog.pipeline.presenting.runs import LAYOUT, WITHOUT_RUNS, Runs, Segment
from fuselog.pipeline.runs.executors import inline_pool, processes
from fuselog.recorders.errors import BadInput
from fuselog.replay.timeline.catalog import EXTRA, PROPERTIES, Dataset, has_catalog, serve_dataset
from fuselog.replay.timeline.viewer import Listener, screenshot, serving, showing

# Fewer runs are drawn sooner by this process than by others, which have to start.
PAYING_SEGMENTS = 6


def view_path(paths: Sequence[Path], options: Options) -> None:
    """Open paths in the viewer, take a screenshot of them, or write or stream a timeline.

    Several runs are shown as a dataset, unless the options are about one run.
    """
    runs, segment = _runs_to_show(paths, options), None
    if runs is not None:
        for damage in filter(None, (each.damage for each in runs.segments)):
            warn(damage)
        chosen = runs.chosen(options.runs or "worst")
        if not options.is_of_one and (options.screenshot is None or len(chosen) > 1):
            if options.save is not None:
                _save_dataset(runs, chosen, options.save)
            if options.save is None or options.screenshot is not None or options.web:
                _show_dataset(runs, chosen, options)
            return
        if len(chosen) != 1:
            raise BadInput(
                f"{runs.path}: --at, --start, --end, --focus, --connect and --save FILE.rrd are about "
                "one run; choose it with --runs NUMBER"
            )
        if options.port is not None:
            raise BadInput(f"--port {options.port}: a single run needs no dataset server; leave it out")
        segment, options = chosen[0], replace(options, gap_limit_s=runs.gap_limit_s)
    from fuselog.pipeline.presenting.timeline import view_timeline  # slow to import

    view_timeline(paths[0], segment, options)


def _runs_to_show(paths: Sequence[Path], options: Options) -> Runs | None:
    """Return the runs of results or folders, or None if there is only a timeline to show.

    Raises BadInput if several runs are requested but the paths do not contain several.
    """
    path = paths[0]
    is_asked = options.runs is not None or len(paths) > 1 or options.port is not None
    is_result = (path / RESULT_FILE).is_file()
    is_shown_first = is_result and (options.is_of_one or options.screenshot is not None)
    if not is_asked and (is_shown_first or not path.is_dir()):
        return None
    try:
        found = runs_at(paths, options.gap_limit_s, recover=options.recover)
    except BadInput as error:
        if is_asked or not is_result:
            raise
        warn(f"{error}; showing the first run")
        return None
    if found is None and is_asked:
        raise BadInput(WITHOUT_RUNS.format(path))
    if found is None or is_asked or not is_result:
        return found
    if len(found.segments) > 1 and not has_catalog():
        warn(f"{EXTRA}; showing the first run")
        return None
    return found if len(found.segments) > 1 else None


def _save_dataset(runs: Runs, chosen: Sequence[Segment], folder: Path) -> None:
    """Write the runs as a dataset to a folder, with the streams and estimates of the chosen runs."""
    from fuselog.pipeline.output.outputs import check_folder  # slow to import

    check_folder(folder, {"input": [runs.path]})
    require_ours(folder, "give another folder")
    kept = Kept(runs)
    for _ in _draw(kept, chosen):
        pass
    made = kept.made()
    kept.save(folder, made)
    say(f"{folder}: {len(runs.segments)} runs, {runs.order}; {len(made)} with streams and estimates")
    say(f"to serve it: rerun server --host 127.0.0.1 -d {quote(str(folder))}")


def _show_dataset(runs: Runs, chosen: Sequence[Segment], options: Options) -> None:
    """Show the runs in the viewer or in a browser until it is closed, or take a picture of the table.

    The table is shown first; chosen runs are added as they are drawn.
    """
    if options.screenshot is not None:
        from fuselog.pipeline.output.outputs import PICTURE, check_files  # slow to import

        check_files([(options.screenshot, PICTURE)], {"input": [runs.path]})
    kept = Kept(runs)
    with serve_dataset(runs.path.resolve().name, options.port) as dataset:
        with status() as told:
            told(f"listing {len(runs.segments)} runs")
            place = kept.properties()
            dataset.add([(path, PROPERTIES) for path in sorted(place.glob("*.rrd"))])
            dataset.lay_out(place / TABLE, table=True)
            made = kept.made()
            dataset.add([layer for each in made for layer in each.layers])
            drawn = [each for each in made if each.segment in chosen] or made
            for each in drawn[:1]:
                dataset.lay_out(each.folder / LAYOUT)
        say(f"{runs.path}: {len(runs.segments)} runs, {runs.order}; {dataset.url}")
        if options.screenshot is not None:
            with status() as told:
                for complaint in screenshot(dataset.url, options.screenshot, progress=told):
                    warn(complaint)
            say(str(options.screenshot))
            return
        if len(chosen) == 1:  # it is what is opened, so it has to be there
            _add(dataset, kept, chosen, None)
        address = dataset.url_of(chosen[0].name) if len(chosen) == 1 else dataset.url
        with _viewer(runs, address, web=options.web) as listener:
            _add(dataset, kept, chosen, listener)
            listener.process.wait()


def _viewer(runs: Runs, address: str, *, web: bool) -> AbstractContextManager[Listener]:
    if not web:
        return showing(address)

    def announce(page: str) -> None:
        say(f"viewing {runs.path} at {page}; press Ctrl-C to end")

    return serving(announce, address=address)


def _add(dataset: Dataset, kept: Kept, chosen: Sequence[Segment], listener: Listener | None) -> None:
    """Draw the chosen runs and add them to a dataset, until its viewer is closed."""
    with closing(_draw(kept, chosen)) as drawing:
        for each in drawing:
            dataset.add(each.layers)
            if not dataset.has_layout or listener is None:
                dataset.lay_out(each.folder / LAYOUT)
            if listener is not None and listener.process.poll() is not None:
                return


def _draw(kept: Kept, chosen: Sequence[Segment]) -> Generator[Made]:
    """Draw the chosen runs that are not drawn yet, and warn of differences from the result."""
    drawn = {each.segment.name for each in kept.made()}
    missing = [segment for segment in chosen if segment.name not in drawn]
    if not missing:
        return
    open_pool = inline_pool if len(missing) < PAYING_SEGMENTS else processes(os.cpu_count() or 1)
    with closing(kept.make(missing, open_pool)) as making:
        for each in progress(making, "drawing runs", len(missing)):
            for warning in each.warnings:
                warn(warning)
            yield each
