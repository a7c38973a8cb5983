"""Files of a dataset: made in parallel, kept next to the result or folder, and saved.

    PATH.segments/
        fuselog.json            shows that fuselog wrote the folder
        all runs/KEY/           the list of runs, the layer of properties of each, and the table's layout
        NAME/KEY/               the other layers of a segment, and its layout

A key is a hash of everything that determines the files, so that nothing outdated is shown.
"""

import json
import shutil
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from glob import glob
from pathlib import Path
from shlex import quote
from time import monotonic, sleep
from typing import Any, NamedTuple
from urllib.parse import quote as file_name
from urllib.parse import unquote

from pydantic import TypeAdapter

from fuselog.pipeline.output import RESULT_FILE
from fuselog.pipeline.presenting.runs import LAYOUT, Runs, Segment, files_of, hash_of, results_of
from fuselog.pipeline.runs.executors import PoolFactory, version_of_code
from fuselog.recorders.atomic import clear_leftovers, whole_file, whole_folder
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parsing import parse_json
from fuselog.replay.timeline.catalog import (
    BASE,
    read_chunks,
    write_chunks,
    write_properties,
    write_table_layout,
)

MARKER = "fuselog.json"
LIST = "all runs"  # no segment has this name, because `file_name` replaces spaces
# Time in which terminated workers end.
ENDING_S = 5.0
TABLE, RUNS = "table.rbl", "runs.json"
_READER = TypeAdapter(Runs)


def runs_at(paths: Sequence[Path], gap_limit_s: float, *, recover: bool = False) -> Runs | None:
    """Return the runs at paths, from an earlier list if it is valid, else from the results or logs.

    Args:
        paths: results, folders of logs, or logs and estimates logs; see `list_runs`. A comparison is
            replaced by the results that it compared.
        gap_limit_s: longest gap over which the truth of logs is interpolated.
        recover: whether to read the intact part of damaged logs.

    Raises BadInput if a result that a comparison compared is gone; see `list_runs`.
    """
    listed = list({each.resolve(): each for path in paths for each in results_of(path)}.values())
    missing = next((result for result in listed if not result.exists()), None)
    if missing is not None:
        raise BadInput(f"{paths[0]}: compared {missing}, which is gone; run fuselog compare again")
    given = files_of(listed)
    for file in _place_of(paths[0]).glob(f"{LIST}/*/{RUNS}"):
        with suppress(OSError, ValueError):  # an older fuselog wrote it
            kept = _READER.validate_json(file.read_bytes())
            has_own_gap = all(each.name == RESULT_FILE for each in given)  # in its settings
            is_of_paths = kept.given == given and (has_own_gap or kept.gap_limit_s == gap_limit_s)
            is_allowed = recover or not any(each.damage for each in kept.segments)
            if is_of_paths and is_allowed and kept.key == file.parent.name:
                return kept._replace(path=paths[0])
    from fuselog.pipeline.presenting.segments import list_runs  # slow to import

    found = list_runs(listed, gap_limit_s, recover=recover)
    return found and found._replace(path=paths[0])


def _place_of(path: Path) -> Path:
    place = path.resolve()
    return place.with_name(f"{place.name}.segments")


class Made(NamedTuple):
    """A drawn segment: the folder of its layers, and warnings about differences from the result."""

    segment: Segment
    folder: Path
    warnings: list[str]

    @property
    def layers(self) -> list[tuple[Path, str]]:
        """Return the files of the layers with their names, beginning with the recorded streams."""
        files = [self.folder / f"{BASE}.rrd", *self.folder.glob("*.rrd")]
        return [(path, unquote(path.stem)) for path in dict.fromkeys(files)]


class Kept:
    """The folder of a dataset's files next to a result or a folder of logs.

    Args:
        runs: the runs.

    Raises BadInput if the folder exists and is not fuselog's.
    """

    def __init__(self, runs: Runs) -> None:
        self._runs = runs
        self.folder = _place_of(runs.path)
        require_ours(self.folder, "move it away")
        with whole_file(self.folder / MARKER) as new:
            new.write_text(json.dumps({"of": runs.path.resolve().name}) + "\n", encoding="utf-8")
        self._clear()

    def properties(self) -> Path:
        """Return the folder with the properties of all segments (a layer); make it if it is missing."""
        runs = self._runs
        place = self.folder / LIST / runs.key
        if not place.is_dir():
            with whole_folder(place, _refuse) as new:
                for segment in runs.segments:
                    path = new / f"{file_name(segment.name)}.rrd"
                    write_properties(path, segment.name, segment.properties, _text(segment, runs))
                write_table_layout(new / TABLE, runs.columns)
                (new / RUNS).write_text(json.dumps(runs._asdict(), default=_plain), encoding="utf-8")
            _remove_others(place)
        return place

    def made(self) -> list[Made]:
        """Return all segments that are drawn and up to date."""
        names = {path.name for path in self.folder.iterdir()}
        drawn = [each for each in self._runs.segments if file_name(each.name) in names]
        return [Made(each, place, []) for each in drawn if (place := self._place(each)).is_dir()]

    def make(self, segments: Sequence[Segment], open_pool: PoolFactory) -> Generator[Made]:
        """Draw segments in parallel, and yield each when finished; only those in progress are in memory.

        If the drawing is interrupted, unfinished files are removed.
        """
        waiting = list(reversed(segments))
        pending: dict[Future[list[str]], Segment] = {}
        try:
            with open_pool() as pool:
                while waiting or pending:
                    while waiting and len(pending) < pool.workers:
                        segment = waiting.pop()
                        place = self._place(segment)
                        drawing = pool.executor.submit(_draw, segment, self._runs.gap_limit_s, place)
                        pending[drawing] = segment
                    for done in wait(pending, return_when=FIRST_COMPLETED).done:
                        segment = pending.pop(done)
                        place = self._place(segment)
                        warnings = done.result()
                        _remove_others(place)
                        yield Made(segment, place, warnings)
        finally:
            end_s = monotonic() + ENDING_S
            while self._clear() and monotonic() < end_s:  # workers that were terminated still end
                sleep(0.05)

    def _clear(self) -> bool:
        """Remove what interrupted drawings left; return whether another drawing is still active."""
        is_active = False
        for part in glob("*/.*.part", root_dir=self.folder):  # noqa: PTH207  # others may remove some
            place = self.folder / Path(part).parent / Path(part).name.split(".")[1]
            with suppress(FileNotFoundError):
                is_active |= clear_leftovers(place)
            with suppress(OSError):
                place.parent.rmdir()
        return is_active

    def _place(self, segment: Segment) -> Path:
        parts = [part.contents for part in segment.parts]
        key = hash_of([parts, self._runs.gap_limit_s, version_of_code()])
        return self.folder / file_name(segment.name) / key

    def save(self, folder: Path, made: Sequence[Made]) -> None:
        """Write the dataset to a folder, one file for each segment, for `rerun server -d FOLDER`."""
        drawn = {each.segment.name: each for each in made}
        properties = self.properties()
        with whole_folder(folder, lambda found: require_ours(found, "give another folder")) as new:
            for segment in self._runs.segments:
                file = f"{file_name(segment.name)}.rrd"
                if segment.name not in drawn:
                    shutil.copyfile(properties / file, new / file)
                    continue
                layers = [properties / file, *(path for path, _ in drawn[segment.name].layers)]
                chunks = [chunk for path in layers for chunk in read_chunks(path)]
                write_chunks(new / file, segment.name, chunks)
            for each in made[:1]:
                shutil.copyfile(each.folder / LAYOUT, new / LAYOUT)
            names = sorted(path.name for path in new.iterdir())
            marker = json.dumps({"of": self._runs.path.name, "files": names})
            (new / MARKER).write_text(marker + "\n", encoding="utf-8")


def _draw(segment: Segment, gap_limit_s: float, place: Path) -> list[str]:
    """Draw a segment into a new folder; see `draw`."""
    from fuselog.pipeline.presenting.drawing import draw  # slow to import

    with whole_folder(place, _refuse) as new:
        return draw(segment, gap_limit_s, new)


def _text(segment: Segment, runs: Runs) -> str:
    """Describe a run in Markdown, with the command that draws it."""
    run = segment.properties["run"]
    facts = ", ".join(f"{name} {value}" for name, value in run.items())
    command = f"fuselog view {quote(str(runs.path.resolve()))} --runs {quote(segment.name)}"
    about = f"**{segment.name}** of {len(runs.segments)} ({facts}), sorted {runs.order}."
    return f"{about}\n\nIf nothing is drawn below, this command adds it: `{command}`"


def require_ours(folder: Path, remedy: str) -> None:
    """Raise BadInput unless a folder is missing, is empty, or was written by this module."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    marker = folder / MARKER
    if not marker.is_file():
        raise BadInput(f"{folder}: exists and is not a dataset that fuselog wrote; {remedy}")
    try:
        listed = parse_json(marker.read_text(encoding="utf-8")).get("files")
    except (OSError, ValueError, AttributeError):
        raise BadInput(f"{marker}: cannot be read; {remedy}") from None
    added = sorted({path.name for path in folder.iterdir()} - {*(listed or ()), MARKER})
    if listed is not None and added:
        raise BadInput(f"{folder / added[0]}: was not written by fuselog; {remedy}")


def _refuse(place: Path) -> None:
    """Raise BadInput, because a folder that is to be made exists already."""
    raise BadInput(f"{place}: another fuselog command wrote it meanwhile; run this command again")


def _plain(value: Any) -> Any:
    """Convert a path, a segment or a part to values that JSON can represent."""
    return str(value) if isinstance(value, Path) else vars(value)


def _remove_others(place: Path) -> None:
    """Remove outdated versions of a folder, which have other keys."""
    for other in place.parent.iterdir():
        if other.is_dir() and not other.name.startswith(".") and other != place:
            shutil.rmtree(other)
