"""The command `fuselog view` for several runs: a dataset in Rerun, or one of its runs as a timeline."""

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing
from pathlib import Path
from shlex import quote

from fuselog.pipeline.output.outputs import PICTURE, check_files, check_folder
from fuselog.pipeline.output.terminal import progress, say, status, warn
from fuselog.pipeline.presenting.making import LAYOUT, TABLE, Kept, Made
from fuselog.pipeline.presenting.segments import Runs, Segment
from fuselog.pipeline.runs.executors import PoolFactory, inline_pool, processes
from fuselog.replay.timeline.catalog import PROPERTIES, Dataset, serve_dataset
from fuselog.replay.timeline.viewer import Listener, screenshot, serving, showing

# Fewer runs are drawn sooner by this process than by others, which have to start.
PAYING_SEGMENTS = 3


def save_dataset(runs: Runs, chosen: Sequence[Segment], folder: Path) -> None:
    """Write the runs as a dataset to a folder, with the streams and estimates of the chosen runs."""
    check_folder(folder, {"input": [runs.path]})
    kept = Kept(runs)
    made = _all_made(kept, chosen)
    kept.save(folder, made)
    say(f"{folder}: {len(runs.segments)} runs, {runs.order}; {len(made)} with streams and estimates")
    say(f"to serve it: rerun server --host 127.0.0.1 -d {quote(str(folder))}")


def show_dataset(
    runs: Runs,
    chosen: Sequence[Segment],
    *,
    port: int | None,
    web: bool,
    picture: Path | None,
) -> None:
    """Show the runs in the viewer or in a browser until it is closed, or take a picture of the table.

    The table comes first; chosen runs are added as they are drawn.
    """
    if picture is not None:
        check_files([(picture, PICTURE)], {"input": [runs.path]})
    kept = Kept(runs)
    with serve_dataset(runs.path.resolve().name, port) as dataset:
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
        missing = _missing(chosen, made)
        say(f"{runs.path}: {len(runs.segments)} runs, {runs.order}; {dataset.url}")
        if picture is not None:
            with status() as told:
                for complaint in screenshot(dataset.url, picture, progress=told):
                    warn(complaint)
            say(str(picture))
            return
        if len(chosen) == 1:  # it is what is opened, so it has to be there
            _add(dataset, kept, missing, None)
        address = dataset.url_of(chosen[0].name) if len(chosen) == 1 else dataset.url
        with _viewer(runs, address, web=web) as listener:
            _add(dataset, kept, _missing(chosen, kept.made()), listener)
            listener.process.wait()


def _viewer(runs: Runs, address: str, *, web: bool) -> AbstractContextManager[Listener]:
    if not web:
        return showing(address)

    def announce(page: str) -> None:
        say(f"viewing {runs.path} at {page}; press Ctrl-C to end")

    return serving(announce, address=address)


def _add(dataset: Dataset, kept: Kept, missing: Sequence[Segment], listener: Listener | None) -> None:
    """Draw runs and add them to a dataset, until its viewer is closed."""
    if not missing:
        return
    with closing(kept.make(missing, _pool(missing))) as making:
        for each in progress(making, "drawing runs", len(missing)):
            _tell(each)
            dataset.add(each.layers)
            if not dataset.has_layout or listener is None:
                dataset.lay_out(each.folder / LAYOUT)
            if listener is not None and listener.process.poll() is not None:
                return


def _all_made(kept: Kept, chosen: Sequence[Segment]) -> list[Made]:
    """Draw the chosen runs that are not drawn yet, and return all drawn runs."""
    missing = _missing(chosen, kept.made())
    for each in progress(kept.make(missing, _pool(missing)), "drawing runs", len(missing)):
        _tell(each)
    return kept.made()


def _missing(chosen: Sequence[Segment], made: Sequence[Made]) -> list[Segment]:
    drawn = {each.segment.name for each in made}
    return [segment for segment in chosen if segment.name not in drawn]


def _pool(missing: Sequence[Segment]) -> PoolFactory:
    return inline_pool if len(missing) < PAYING_SEGMENTS else processes(os.cpu_count() or 1)


def _tell(made: Made) -> None:
    for warning in made.warnings:
        warn(warning)
