"""Files of a dataset: made in parallel, kept next to the result or folder, and saved.

    PATH.segments/
        fuselog.json            shows that fuselog wrote the folder
        properties/KEY/         the layer of properties of every segment, and the layout of the table
        NAME/KEY/               the other layers of a segment, and its layout

A key is a hash of everything that determines the files, so that nothing outdated is shown.
"""

import hashlib
import json
import math
import shutil
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from pathlib import Path
from shlex import quote
from time import monotonic, sleep
from typing import NamedTuple
from urllib.parse import quote as file_name
from urllib.parse import unquote

from rerun.chunk import Chunk

from fuselog.pipeline.presenting.segments import SAME, Runs, Segment
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.executors import PoolFactory, version_of_code
from fuselog.recorders.atomic import clear_leftovers, whole_file, whole_folder
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parsing import parse_json
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.catalog import (
    BASE,
    PROPERTIES,
    read_chunks,
    write_chunks,
    write_properties,
    write_table_layout,
)
from fuselog.replay.timeline.drawing.canvas import escaped

MARKER = "fuselog.json"
# Time in which terminated workers end.
ENDING_S = 5.0
LAYOUT, TABLE = "layout.rbl", "table.rbl"
APPLICATION = "fuselog"


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
        place = runs.path.resolve()
        self.folder = place.with_name(f"{place.name}.segments")
        _require_ours(self.folder, "move it away")
        with whole_file(self.folder / MARKER) as new:
            new.write_text(json.dumps({"of": place.name}) + "\n", encoding="utf-8")
        self._clear()

    def properties(self) -> Path:
        """Return the folder of the layer of properties of all segments; make it if it is not there."""
        runs = self._runs
        known = [[each.name, each.properties] for each in runs.segments]
        contents = json.dumps([known, runs.columns, version_of_code()], sort_keys=True)
        key = hashlib.sha256(contents.encode()).hexdigest()[:16]
        place = self.folder / PROPERTIES / key
        if not place.is_dir():
            with whole_folder(place, _refuse) as new:
                for segment in runs.segments:
                    path = new / f"{file_name(segment.name)}.rrd"
                    text = _text(segment, runs)
                    write_properties(path, APPLICATION, segment.name, segment.properties, text)
                write_table_layout(new / TABLE, APPLICATION, runs.columns)
            _remove_others(place)
        return place

    def made(self) -> list[Made]:
        """Return all segments that are drawn and up to date."""
        names = {path.name for path in self.folder.iterdir()}
        drawn = [each for each in self._runs.segments if file_name(each.name) in names]
        return [Made(each, place, []) for each in drawn if (place := self._place(each)).is_dir()]

    def make(self, segments: Sequence[Segment], open_pool: PoolFactory) -> Generator[Made]:
        """Draw segments in parallel, yield each when it is finished; memory holds those in progress.

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
                        drawing = pool.executor.submit(draw, segment, self._runs.gap_limit_s, place)
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
        """Remove what interrupted drawings left; return whether one is still active."""
        left = {part.parent / part.name.split(".")[1] for part in self.folder.glob("*/.*.part")}
        active = [place for place in left if clear_leftovers(place)]
        for folder in {place.parent for place in left}:
            with suppress(OSError):
                folder.rmdir()
        return bool(active)

    def _place(self, segment: Segment) -> Path:
        key = hashlib.sha256(f"{segment.key} {self._runs.gap_limit_s}".encode()).hexdigest()[:16]
        return self.folder / file_name(segment.name) / key

    def save(self, folder: Path, made: Sequence[Made]) -> None:
        """Write the dataset to a folder, one file for each segment, for `rerun server -d FOLDER`."""
        drawn = {each.segment.name: each for each in made}
        properties = self.properties()
        with whole_folder(folder, lambda found: _require_ours(found, "give another folder")) as new:
            for segment in self._runs.segments:
                file = f"{file_name(segment.name)}.rrd"
                if segment.name not in drawn:
                    shutil.copyfile(properties / file, new / file)
                    continue
                layers = [properties / file, *(path for path, _ in drawn[segment.name].layers)]
                chunks = [chunk for path in layers for chunk in read_chunks(path)]
                write_chunks(new / file, APPLICATION, segment.name, chunks)
            for each in made[:1]:
                shutil.copyfile(each.folder / LAYOUT, new / LAYOUT)
            names = sorted(path.name for path in new.iterdir())
            marker = json.dumps({"of": self._runs.path.name, "files": names})
            (new / MARKER).write_text(marker + "\n", encoding="utf-8")


def draw(segment: Segment, gap_limit_s: float, place: Path) -> list[str]:
    """Draw a segment into the folder `place`: a file for each layer, and the layout.

    Returns sentences on errors that differ from those of the result, since the code has changed.
    """
    from fuselog.replay.timeline.show import Drawing  # slow to import

    source, estimates, versions = segment.load()
    with whole_folder(place, _refuse) as new:
        whole = new / "whole.rrd"
        with Drawing(source.whole(), identity=segment.name, save=whole, layout=new / LAYOUT) as drawing:
            judge = judge_logs([estimates], [source], {}, gap_limit_s=gap_limit_s, drawing=drawing)
        layers: dict[str, list[Chunk]] = {BASE: [], **{label: [] for label in versions}}
        names = {escaped(label): label for label in versions}
        for chunk in read_chunks(whole):
            parts = chunk.entity_path.split("/")[2:]  # without the root, such as `plots`
            layers[next((names[each] for each in parts if each in names), BASE)].append(chunk)
        whole.unlink()
        for label, chunks in layers.items():
            write_chunks(new / f"{file_name(label)}.rrd", APPLICATION, segment.name, chunks)
    return differing(segment, judge)


def differing(segment: Segment, judge: Judge) -> list[str]:
    """Describe the first error of a replay that differs from what the result states, if any does."""
    if segment.parts[0].runner is None:
        return []
    for row in judge.runs_table.to_dict("records"):
        label, case = str(row["estimator"]), str(row["case"])
        stated = segment.properties.get(label) or segment.properties.get(f"{label} {case}") or {}
        for key, value in stated.items():
            now = row.get(key)
            if not isinstance(value, float) or now is None:
                continue
            if not math.isclose(value, float(now), rel_tol=SAME, abs_tol=1e-12):
                return [
                    f"{segment.name}: drawn now, {key} of {label} is {now:.6g}, where the result has "
                    f"{value:.6g}; the code has changed since"
                ]
    return []


def _text(segment: Segment, runs: Runs) -> str:
    """Describe a run in Markdown, with the command that draws it."""
    run = segment.properties["run"]
    facts = ", ".join(f"{name} {value}" for name, value in run.items())
    command = f"fuselog view {quote(str(runs.path))} --runs {quote(segment.name)}"
    about = f"**{segment.name}** of {len(runs.segments)} ({facts}), sorted {runs.order}."
    return f"{about}\n\nIf nothing is drawn below, this command adds it: `{command}`"


def _require_ours(folder: Path, remedy: str) -> None:
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
    raise BadInput(f"{place}: another fuselog command wrote it meanwhile; run this command again")


def _remove_others(place: Path) -> None:
    """Remove outdated versions of a folder, which have other keys."""
    for other in place.parent.iterdir():
        if other.is_dir() and not other.name.startswith(".") and other != place:
            shutil.rmtree(other)
