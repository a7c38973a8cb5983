"""Scene (content of a timeline), canvas (recording on which it is drawn), and drawing code.

A timeline consists of parts: each part sends its columns and returns the view that shows them. Moving
entities are on three Rerun timelines: `step`, `sim_time` (since the epoch of the run) and `utc`. If
stamps are not dates, as with a simulated clock in a bag, `utc` is the time of recording.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import cycle

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Schema, Stream, schemas, topics_of
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.judging.consistency.divergence import Divergence
from fuselog.replay.judging.errors.evaluation import Errors, Floats, split_topic
from fuselog.replay.judging.errors.moments import Moment
from fuselog.replay.timeline.drawing.extremes import extremes

Board = rrb.Container | rrb.View
Times = NDArray[np.int64]
Colour = tuple[int, int, int]

# Colours by Okabe and Ito, which colour-blind people can distinguish; red is reserved for faults.
PALETTE: tuple[Colour, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (0, 114, 178),
)
# Width of a line in pixels.
WIDTH = 1.5
TRUTH: Colour = (200, 200, 200)
MUTED: Colour = (130, 130, 130)
WRONG: Colour = (230, 60, 40)

# Largest number of rows of a moving entity, evenly spaced in time: several per pixel of a plot, and
# several per second in a log of 15 minutes.
DRAWN_ROWS = 5000
# A silence longer than both this multiple of the usual interval and this time is a gap of a stream.
GAP_INTERVALS = 5.0
GAP_S = 1.0
# A stream has a rate if half of its intervals differ from the usual one by at most this fraction.
RATE_JITTER = 0.25
ESTIMATES = (
    schemas.GAUSSIAN_ESTIMATE,
    schemas.DENSITY_ESTIMATE,
    schemas.ESTIMATE_SIZE,
    schemas.TRACK_ESTIMATE,
    schemas.SCORE_VECTOR,
)
# Stamps before the year 2000 are not dates.
DATES_FROM_NS = 946_684_800_000_000_000


@dataclass(frozen=True)
class Scene:
    """One run and the results of estimators.

    Attributes:
        source: sensor streams and truth of the run.
        outputs: output streams of this run, by topic.
        errors: errors of the estimates of this run, if there is truth.
        focus: the case that is shown first; None for the first one.
        moments: the moments of the largest NEES and errors of the run.
        divergences: points at which estimators diverge, by topic of their innovations.
    """

    source: Source
    outputs: Mapping[str, Stream]
    errors: Sequence[Errors]
    focus: str | None = None
    moments: Sequence[Moment] = ()
    divergences: Mapping[str, Divergence] = field(default_factory=dict)

    @cached_property
    def estimators(self) -> list[str]:
        """Return the labels of the estimators, in the given order."""
        names = [split_topic(topic)[0] for topic in self.outputs]
        return list(dict.fromkeys([*names, *(errors.estimator for errors in self.errors)]))

    @cached_property
    def cases(self) -> list[str]:
        """Return the cases with estimates or a truth, such as `robot1`; a single case may be ""."""
        estimated = [split_topic(topic)[1] for topic in self.outputs]
        found = {*estimated, *(_prefix(topic) for topic in self._truths)}
        return sorted(found, key=_natural) or [""]

    def colour(self, estimator: str) -> Colour:
        """Return the colour of `estimator` in all views."""
        return PALETTE[self.estimators.index(estimator) % len(PALETTE)]

    @property
    def spare_colours(self) -> Iterator[Colour]:
        """Yield colours endlessly, starting with those that no estimator has."""
        used = len(self.estimators) % len(PALETTE)
        return cycle([*PALETTE[used:], *PALETTE[:used]])

    def width(self, estimator: str) -> float:
        """Return the line width of `estimator` in pixels, so that overlapping lines are all visible.

        The viewer draws entities in the order of their names, so the first ones are the widest.
        """
        above = len(self.estimators) - 1 - sorted(self.estimators).index(estimator)
        return WIDTH * (1.0 + 2.0 * above / max(len(self.estimators) - 1, 1))

    def colours(self, case: str) -> dict[str, Colour]:
        """Return the colours, by name, of the truth and the estimators of `case`."""
        truths = [topic for topic in self._truths if _prefix(topic) == case]
        has_truth = any(self.source.topics[topic].messages for topic in truths)
        named = {"truth": TRUTH} if has_truth else {}
        return named | {name: self.colour(name) for name in self.estimators_of(case)}

    def estimators_of(self, case: str) -> list[str]:
        """Return the estimators with estimates of `case`."""
        own = {name for schema in ESTIMATES for name, _ in self.outputs_of(case, schema)}
        return [name for name in self.estimators if name in own]

    def outputs_of(self, case: str, schema: Schema) -> list[tuple[str, Stream]]:
        """Return the non-empty output streams of `case` with this `schema`, and their estimators."""
        return [
            (split_topic(topic)[0], stream)
            for topic, stream in self.outputs.items()
            if split_topic(topic)[1] == case
            and stream.schema.full_name == schema.full_name
            and len(stream)
        ]

    def errors_of(self, case: str) -> list[Errors]:
        """Return the non-empty errors of `case`."""
        return [errors for errors in self.errors if errors.case == case and len(errors.error)]

    def truths_of(self, case: str) -> list[Stream]:
        """Return the non-empty truth streams of `case`."""
        truths = (self.read(topic) for topic in self._truths if _prefix(topic) == case)
        return [truth for truth in truths if len(truth)]

    def topics_near(self, case: str) -> list[str]:
        """Return the readable sensor topics of the run that belong to `case` or to no case."""
        others = [f"/{other}/" for other in self.cases if other != case and other]
        elsewhere = ("/estimates/", *others)
        return [
            topic
            for topic in self.source.topics
            if not topic.startswith(elsewhere) and topic not in self.unread
        ]

    @cached_property
    def unread(self) -> dict[str, str]:
        """Return, by topic, the reason why messages, such as images, cannot be read as columns."""
        found: dict[str, str] = {}
        for topic in self.source.topics:
            try:
                self.source.empty(topic)
            except BadInput as error:
                found[topic] = str(error)
        return found

    def read(self, topic: str) -> Stream:
        """Read all messages of `topic` in the run."""
        return self.source.read([topic])[topic]

    @property
    def dates(self) -> "Dates | None":
        """Return dates of stamps, from the topic with the most messages; None if stamps are dates."""
        streams = [self.read(topic) for topic in self.source.topics if topic not in self.unread]
        return dates_of(max(streams, key=len)) if streams else None

    @property
    def _truths(self) -> list[str]:
        return topics_of(self.source.topics, schemas.TRUTH_STATE)


def _prefix(topic: str) -> str:
    return topic.rpartition("/")[0].removeprefix("/")


def _natural(name: str) -> list[tuple[str, int]]:
    """Return the sort key that puts robot2 before robot10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name)]


@dataclass(frozen=True)
class Dates:
    """Relation of two clocks: stamps (k,), and dates minus stamps in ns (k,).

    The difference is linear between two stamps, and constant before the first and after the last.
    """

    stamps_ns: Times
    later_ns: Times

    def of(self, time_ns: Times) -> Times:
        """Return the dates of stamps (n,)."""
        first_ns = self.later_ns[0]
        drift_ns = np.interp(time_ns, self.stamps_ns, self.later_ns - first_ns)
        found: Times = time_ns + first_ns + np.rint(drift_ns).astype(np.int64)
        return found


def dates_of(stream: Stream) -> Dates | None:
    """Return the dates at which the messages of a stream were logged; None if its stamps are dates."""
    stamps_ns, logged_ns = stream.publish_time_ns, stream.log_time_ns
    if not len(stream) or stamps_ns[0] >= DATES_FROM_NS or logged_ns[0] < DATES_FROM_NS:
        return None
    return Dates(stamps_ns, logged_ns - stamps_ns)


@dataclass(frozen=True)
class Canvas:
    """Recording with the clocks of a run.

    Attributes:
        recording: the Rerun recording.
        epoch_ns: the run's time zero.
        end_ns: time of the last estimate or truth.
        steps_ns: distinct times of estimates, which `step` counts.
        is_still: whether moving entities are left out because they have already been sent.
        dates: dates of stamps, if stamps are not dates.
        is_shared: whether the layout is also used for other runs, so that titles must not contain
            counts.
    """

    recording: rr.RecordingStream
    epoch_ns: int
    end_ns: int
    steps_ns: Times
    is_still: bool = False
    dates: Dates | None = None
    is_shared: bool = False

    def send(self, entity: str, time_ns: Times, columns: rr.ComponentColumnList) -> None:
        """Send all rows of an entity in one call.

        Args:
            entity: path of the entity.
            time_ns: (n,), stamps in ns.
            columns: Rerun columns with n rows.
        """
        if len(time_ns) == 0 or self.is_still:
            return
        step = np.searchsorted(self.steps_ns, time_ns, side="right") - 1
        date_ns = time_ns if self.dates is None else self.dates.of(time_ns)
        index = [
            rr.TimeColumn("step", sequence=np.maximum(step, 0)),
            rr.TimeColumn("sim_time", duration=(time_ns - self.epoch_ns).astype("timedelta64[ns]")),
            rr.TimeColumn("utc", timestamp=date_ns.astype("datetime64[ns]")),
        ]
        self.recording.send_columns(escaped(entity), index, columns, strict=True)

    def fix(self, entity: str, *what: rr.AsComponents) -> None:
        """Log the properties `what` of `entity`, such as a style, which apply at all times."""
        self.recording.log(escaped(entity), *what, static=True, strict=True)


@dataclass(frozen=True)
class Timeline:
    """Drawing code of a scenario family.

    Attributes:
        draw: draw(canvas, scene) sends the whole drawing and returns the layout of the views.
    """

    draw: Callable[[Canvas, Scene], rrb.Container | rrb.View]


def draw_cases(
    scene: Scene, draw_case: Callable[[str], rrb.Container | rrb.View]
) -> rrb.Container | rrb.View:
    """Draw all cases; return their layouts, in tabs if there are several, estimated cases first."""
    layouts = [draw_case(case) for case in scene.cases]
    if len(layouts) == 1:
        return layouts[0]
    estimated = [case for case in scene.cases if scene.estimators_of(case)]
    first = scene.focus or next(iter(estimated), scene.cases[0])
    return rrb.Tabs(*layouts, active_tab=scene.cases.index(first))


def beside(board: rrb.Container, plots: Sequence[Board], case: str) -> rrb.Container:
    """Return a case's panel with any plots to its right; all strips have the same height."""
    shares = [float(strips_of(plot)) for plot in plots]
    columns = [board, rrb.Vertical(*plots, row_shares=shares)] if plots else [board]
    return rrb.Horizontal(*columns, name=case or "run")


def strips_of(board: Board) -> int:
    """Count the views that a part of a layout shows below each other."""
    if not isinstance(board, rrb.Container):
        return 1
    within = [strips_of(each) for each in board.contents if isinstance(each, rrb.Container | rrb.View)]
    return sum(within) if isinstance(board, rrb.Vertical) else max(within, default=0)


def entity_path(*parts: str) -> str:
    """Join parts to an entity path, without empty parts, such as the name of a log's only case."""
    return "/".join(part for part in parts if part)


def escaped(entity: str) -> str:
    """Escape an entity path for Rerun; its parts may contain any characters, such as `ukf:2`."""
    return "/".join(rr.escape_entity_path_part(part) for part in entity.split("/"))


def thin(time_ns: Times, rows: int = DRAWN_ROWS) -> NDArray[np.int64]:
    """Return the rows to draw: all rows, or the last row in each of `rows` equal spans of time.

    Args:
        time_ns: (n,), in order.
        rows: largest number of rows.
    """
    if len(time_ns) <= rows:
        return np.arange(len(time_ns))
    of_span = _spans(time_ns, rows)
    return np.flatnonzero(np.append(of_span[1:] != of_span[:-1], True))


def thin_curve(time_ns: Times, values: Floats, rows: int = DRAWN_ROWS) -> NDArray[np.int64]:
    """Return the rows of a curve to draw: all rows, or the minimum and maximum of each span of time.

    Args:
        time_ns, values: (n,), in order of time.
        rows: largest number of rows.
    """
    if len(time_ns) <= rows:
        return np.arange(len(time_ns))
    return extremes(_spans(time_ns, rows // 2), values)


def thin_scatter(count: int) -> NDArray[np.int64]:
    """Return the rows of a scatter plot to draw: all rows, or a random selection, in order.

    Extremes, as for a curve, would leave out the points in between, which are the majority.
    """
    if count <= DRAWN_ROWS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, DRAWN_ROWS, replace=False))


def _spans(time_ns: Times, spans: int) -> NDArray[np.int64]:
    """Return the index of each stamp's span, out of `spans` equal spans of time."""
    span_ns = max((time_ns[-1] - time_ns[0]) / spans, 1.0)
    return np.minimum((time_ns - time_ns[0]) / span_ns, spans - 1).astype(np.int64)


def gap_limit_ns(time_ns: Times) -> int:
    """Compute the limit above which an interval between the sorted times of a stream is a gap.

    A stream without a rate, such as gunshots or objects seen by a camera, has bursts. Its limit is a
    multiple of a pause length; pauses up to this length make up half of the total time, not counting the
    longest pause.
    """
    intervals = np.sort(np.diff(np.unique(time_ns))).astype(float)
    usual_ns = usual_interval_ns(time_ns)
    near = np.abs(intervals - usual_ns) <= RATE_JITTER * usual_ns
    if len(intervals) > 1 and np.count_nonzero(near) < 0.5 * len(intervals):
        passed = np.cumsum(intervals[:-1])
        usual_ns = float(intervals[np.searchsorted(passed, 0.5 * passed[-1])])
    return int(max(GAP_INTERVALS * usual_ns, GAP_S * 1e9))


def usual_interval_ns(time_ns: Times) -> float:
    """Compute the median interval of distinct, sorted times; zero if there is only one."""
    intervals = np.diff(np.unique(time_ns))
    return float(np.median(intervals)) if len(intervals) else 0.0


def nice(value: float) -> float:
    """Return the smallest number not below a positive value that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value))
