"""Drawing of one run of a replay in Rerun, to a file, to a live viewer, or to both in one pass."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun.chunk as rc

from fuselog.recorders.errors import BadInput, choices, printable
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.consistency.divergence import Divergence, find_divergence
from fuselog.replay.judging.errors.evaluation import Errors, Floats, errors_at
from fuselog.replay.judging.errors.moments import Moment, Moments, worst_of
from fuselog.replay.timeline.catalog import ABOUT
from fuselog.replay.timeline.drawing.canvas import (
    DRAWN_ROWS,
    PALETTE,
    Board,
    Canvas,
    Scene,
    Timeline,
    Times,
    entity_path,
)
from fuselog.replay.timeline.drawing.plots import LINE, draw_curve, plot_view
from fuselog.replay.timeline.drawing.thinning import KEPT_ERRORS, KEPT_ROWS, Sensed, Thin
from fuselog.replay.timeline.generic import TIMELINE as GENERIC
from fuselog.replay.timeline.side_by_side import draw_side_by_side
from fuselog.replay.timeline.sinks import open_recording, write_layout

# Number of output messages to send to a receiver at a time.
LIVE_MESSAGES = 20_000

WORST = "worst"
_ENTITY = "moments"  # of the worst moments, for the cursor of the viewer


class Fan(NamedTuple):
    """Distances between an estimate and one copy of it.

    Attributes:
        estimate: the original estimate; the copies of one estimate share a plot.
        copy: name of the copy.
        time_ns: (n,) stamps.
        sigmas: (n,) distance in standard deviations of the estimate.
    """

    estimate: str
    copy: str
    time_ns: Times
    sigmas: Floats


def draw_fans(canvas: Canvas, layout: Board, fans: Sequence[Fan]) -> rrb.Container:
    """Return the layout, extended by a plot for each estimate that has copies."""
    plots = []
    for estimate in dict.fromkeys(fan.estimate for fan in fans):
        plot = entity_path("plots", "stress", estimate)
        own = [fan for fan in fans if fan.estimate == estimate]
        for fan, colour in zip(own, cycle(PALETTE), strict=False):
            draw_curve(canvas, plot, fan.copy, colour, fan.time_ns, fan.sigmas, LINE)
        plots.append(plot_view(plot, f"{estimate}: distance of each copy", "sigma"))
    return rrb.Vertical(layout, rrb.Tabs(*plots), row_shares=[4.0, 1.0])


class Drawing:
    """Timeline of one run, drawn while the run is replayed.

    A receiver gets every block immediately. A file is drawn at the end of the run from the messages that
    were kept: all messages of a short run, or a selection from a longer run, evenly spaced in time. Use
    the drawing as a context manager, which finishes it at the end unless an exception was raised.

    Args:
        source: the run.
        identity: identifier of the recording; a viewer merges recordings with the same identifier.
        focus: the case that is shown first, such as `robot3`.
        save: the .rrd file to write.
        connect: URL of a receiver, rerun+http://HOST:PORT/proxy.
        at: `worst` or `worst:ESTIMATOR`, which selects a moment; without a focus, the case of this
            moment is shown first.
        sides: estimators whose scenes are shown side by side, with the differences of their errors.
        fans: distances of copies from their estimates.
        layout: file to which the layout of a dataset's segments is written; the layout also shows a text
            about the segment.

    Raises BadInput if neither `save` nor `connect` is given, if a sink fails (see `open_recording`), or
    if the focus does not exist.
    """

    def __init__(
        self,
        source: Source,
        *,
        identity: str,
        focus: str | None = None,
        save: Path | None = None,
        connect: str | None = None,
        at: str | None = None,
        sides: Sequence[str] = (),
        fans: Sequence[Fan] = (),
        layout: Path | None = None,
    ) -> None:
        if save is None and connect is None:
            raise BadInput(
                "a timeline needs a destination: give --save FILE.rrd, --connect URL, or both"
            )
        self._source, self._focus, self._save = source, focus, save
        self._at, self._sides, self._fans, self._layout = at, sides, fans, layout
        scenario = source.run.scenario if source.run else ""
        known = available("timelines")
        self._timeline: Timeline = load("timelines", scenario) if scenario in known else GENERIC
        self._names = (
            f"fuselog-{scenario}" if scenario else "fuselog",
            hashlib.sha256(f"{source.run or source.name}{identity}".encode()).hexdigest()[:16],
        )
        self._sensed = Sensed(source, is_live=connect is not None)
        self._kept = Thin(KEPT_ROWS, KEPT_ERRORS)
        self._fresh = Thin(DRAWN_ROWS, DRAWN_ROWS)
        self._moments = Moments()
        self._sent = 0
        self._stack = ExitStack()
        self._live = None
        if connect is not None:
            self._live = self._stack.enter_context(open_recording(*self._names, connect=connect))
            self._live.send_recording_name(printable(source.name))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool | None:
        if error is not None:
            return self._stack.__exit__(kind, error, traceback)
        with self._stack:
            self._finish()
        return None

    def add(self, outputs: Mapping[str, Stream], errors: Sequence[Errors]) -> None:
        """Add a block of the run's `outputs`, and the `errors` of its estimates."""
        self._kept.add(outputs, errors)
        for each in errors:
            self._moments.add(each)
        self._sensed.advance(self._kept.last_ns)
        if self._live is not None:
            self._fresh.add(outputs, errors)
            if self._fresh.added >= LIVE_MESSAGES:
                self._send(self._live, self._fresh.last_ns)

    def _send(self, live: rr.RecordingStream, until_ns: int, last: Scene | None = None) -> None:
        """Send all new outputs since the last call, and sensor messages up to a stamp.

        At the end of the run, `last` is the scene of the whole run.
        """
        sensed = self._sensed.read_to(until_ns)
        scene = Scene(sensed, self._fresh.outputs, self._fresh.errors, self._focus)
        if last is not None:
            scene = replace(scene, moments=last.moments, divergences=last.divergences)
        self._draw(live, scene)
        self._fresh = Thin(DRAWN_ROWS, DRAWN_ROWS)
        self._sent += 1

    def _finish(self) -> None:
        moments = self._moments.found
        worst = None if self._at is None else worst_at(moments, self._at)
        if self._focus is None and worst is not None:
            self._focus = worst.case
        scene = Scene(
            self._sensed.all(),
            self._kept.outputs,
            self._kept.errors,
            self._focus,
            moments,
            _divergences(self._kept.whole),
        )
        if self._live is not None:
            self._send(self._live, np.iinfo(np.int64).max, scene)
        # moving entities have been sent, but the ranges of views are still those of the last part
        if self._live is not None and self._sent > 1:
            self._draw(self._live, scene, is_still=True)
        if self._save is not None:
            with open_recording(*self._names, save=self._save) as recording:
                recording.send_recording_name(printable(self._source.name))
                self._draw(recording, scene)

    def _draw(self, recording: rr.RecordingStream, scene: Scene, *, is_still: bool = False) -> None:
        if self._focus is not None and self._focus not in scene.cases:
            known = choices(self._focus, scene.cases)
            raise BadInput(f"--focus {self._focus}: no case in this log has this name; {known}")
        canvas = _canvas(scene, recording, self._kept.outputs.values(), is_still)
        canvas = replace(canvas, is_shared=self._layout is not None)
        layout = self._timeline.draw(canvas, scene)
        keep_moments(recording, scene.moments)
        if self._sides:
            layout = draw_side_by_side(canvas, scene, layout, self._sides)
        if self._fans:
            layout = draw_fans(canvas, layout, self._fans)
        panel = rrb.TimePanel(timeline="sim_time", state="collapsed")
        recording.send_blueprint(rrb.Blueprint(layout, panel, collapse_panels=True))
        if self._layout is not None:
            about = rrb.TextDocumentView(origin=ABOUT, name="Run")
            layout = rrb.Vertical(about, layout, row_shares=[1.0, 8.0])
            shared = rrb.Blueprint(layout, panel, collapse_panels=True)
            write_layout(self._layout, self._names[0], shared)


def show(
    source: Source,
    outputs: Mapping[str, Ragged],
    errors: Sequence[Errors],
    *,
    run: int = 0,
    focus: str | None = None,
    save: Path | None = None,
    connect: str | None = None,
) -> None:
    """Draw one run of an ensemble with all its estimators, with the drawing code of its scenario family.

    Args:
        source: the run.
        outputs: output streams of the ensemble, by topic; without outputs, only the log is shown.
        errors: the errors of the ensemble's estimates.
        run: index of the run `source` in the ensemble.
        focus: the case that is shown first, such as `robot3`.
        save: the .rrd file to write.
        connect: URL of a receiver, rerun+http://HOST:PORT/proxy.

    Raises BadInput if the run or the focus does not exist, or if a sink fails (see `open_recording`).
    """
    runs = max((ragged.runs for ragged in outputs.values()), default=1)
    if not 0 <= run < runs:
        raise BadInput(f"no run {run} to show; the runs are 0 to {runs - 1}")
    of_run = {topic: ragged.of_run(run) for topic, ragged in outputs.items()}
    own = [errors_at(each, each.run == run) for each in errors]
    with Drawing(source, identity=_identity(of_run), focus=focus, save=save, connect=connect) as drawing:
        drawing.add(of_run, own)


def _canvas(
    scene: Scene, recording: rr.RecordingStream, estimates: Iterable[Stream], is_still: bool
) -> Canvas:
    epoch_ns = scene.source.epoch_ns
    none = np.empty(0, np.int64)
    steps_ns = np.unique(np.concatenate([none, *(each.publish_time_ns for each in estimates)]))
    truths = [truth.publish_time_ns[-1:] for case in scene.cases for truth in scene.truths_of(case)]
    end_ns = int(np.concatenate([[epoch_ns], steps_ns[-1:], *truths]).max())
    return Canvas(recording, epoch_ns, end_ns, steps_ns, is_still, scene.dates)


def _divergences(outputs: Mapping[str, Stream]) -> dict[str, Divergence]:
    """Find the points at which estimators diverge, by topic of their innovations."""
    found = {
        topic: find_divergence(stream)
        for topic, stream in outputs.items()
        if stream.schema.full_name == schemas.INNOVATION.full_name
    }
    return {topic: each for topic, each in found.items() if each is not None}


def _identity(outputs: Mapping[str, Stream]) -> str:
    """Compute a digest of the outputs."""
    digest = hashlib.sha256()
    for topic, stream in outputs.items():
        digest.update(topic.encode())
        for column in (stream.publish_time_ns, *stream.columns.values()):
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def keep_moments(recording: rr.RecordingStream, moments: Sequence[Moment]) -> None:
    """Log moments as a table in the timeline, with a column for each field."""
    if moments:
        columns: dict[str, Any] = {
            name: [getattr(each, name) for each in moments] for name in Moment._fields
        }
        recording.log(_ENTITY, rr.AnyValues(**columns), static=True, strict=True)


def read_moments(rrd: Path) -> list[Moment]:
    """Read the moments stored in a timeline; empty if the timeline has no errors."""
    for chunk in rc.RrdReader(str(rrd)).stream().filter(content=f"/{_ENTITY}", is_static=True):
        batch = chunk.to_record_batch()
        columns = [batch.column(name).to_pylist()[0] for name in Moment._fields]
        return [Moment(*row) for row in zip(*columns, strict=True)]
    return []


def worst_at(moments: Sequence[Moment], at: str) -> Moment:
    """Return the moment that `worst` or `worst:ESTIMATOR` selects.

    Raises BadInput if there are no errors, or no errors of this estimator.
    """
    estimator = at.partition(":")[2]
    if not moments:
        raise BadInput(
            f"--at {at}: the timeline has no errors of estimates; give seconds, such as --at 30"
        )
    known = list(dict.fromkeys(moment.estimator for moment in moments))
    if estimator and estimator not in known:
        raise BadInput(f"--at {at}: no estimator with this name has errors; {choices(estimator, known)}")
    found = worst_of(each for each in moments if estimator in ("", each.estimator))
    assert found is not None
    return found
