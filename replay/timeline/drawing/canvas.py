"""Defines what is drawn (a scene), what it is drawn on (a canvas), and who draws it (a timeline).

A timeline is made of parts: each sends its columns and returns the view that shows them. Everything
that moves is on three timelines: `step`, `sim_time` (since the run's epoch) and `utc`. Where stamps are
no dates, as those of a simulated clock in a bag, `utc` is when they reached the recorder.
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

Board = rrb.Container | rrb.View
Times = NDArray[np.int64]
Colour = tuple[int, int, int]

# Okabe and Ito's colours, told apart by everyone; red is kept for what went wrong.
PALETTE: tuple[Colour, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (0, 114, 178),
)
# How wide a line is, in pixels.
WIDTH = 1.5
TRUTH: Colour = (200, 200, 200)
MUTED: Colour = (130, 130, 130)
WRONG: Colour = (230, 60, 40)

# What moves has at most so many rows per entity, evenly in time: several per pixel of a plot, and
# several a second in a log of a quarter of an hour.
DRAWN_ROWS = 5000
# A stream is silent after so many of its usual intervals, but not before so long.
GAP_INTERVALS = 5.0
GAP_S = 1.0
# A stream has a rate if half of its intervals are within this share of the usual one.
RATE_JITTER = 0.25
ESTIMATES = (
    schemas.GAUSSIAN_ESTIMATE,
    schemas.DENSITY_ESTIMATE,
    schemas.ESTIMATE_SIZE,
    schemas.TRACK_ESTIMATE,
    schemas.SCORE_VECTOR,
)
# Stamps before the year 2000 count from something else than 1970.
DATES_FROM_NS = 946_684_800_000_000_000


@dataclass(frozen=True)
class Scene:
    """Holds one run and what the estimators made of it.

    Attributes:
        source: the run's sensor streams and truth.
        outputs: the estimators' streams of this run, by topic.
        errors: the errors of this run's estimates, where there is truth.
        focus: the case that is seen first; None is the first one.
        moments: where NEES and errors of the whole run are largest.
        divergences: where estimators diverge, by topic of their innovations.
    """

    source: Source
    outputs: Mapping[str, Stream]
    errors: Sequence[Errors]
    focus: str | None = None
    moments: Sequence[Moment] = ()
    divergences: Mapping[str, Divergence] = field(default_factory=dict)

    @property
    def estimators(self) -> list[str]:
        """Return the estimators' labels, in the order they were given."""
        names = [split_topic(topic)[0] for topic in self.outputs]
        return list(dict.fromkeys([*names, *(errors.estimator for errors in self.errors)]))

    @property
    def cases(self) -> list[str]:
        """Return what is estimated, or has a truth: `robot1`, say. A single one may be named ""."""
        estimated = [split_topic(topic)[1] for topic in self.outputs]
        found = {*estimated, *(_prefix(topic) for topic in self._truths)}
        return sorted(found, key=_natural) or [""]

    def colour(self, estimator: str) -> Colour:
        """Return the one colour that `estimator` has everywhere."""
        return PALETTE[self.estimators.index(estimator) % len(PALETTE)]

    @property
    def spare_colours(self) -> Iterator[Colour]:
        """Return colours without end, first those that no estimator has."""
        used = len(self.estimators) % len(PALETTE)
        return cycle([*PALETTE[used:], *PALETTE[:used]])

    def width(self, estimator: str) -> float:
        """Return how wide lines of `estimator` are, in pixels, so that one on another shows both.

        The viewer draws entities in the order of their names, so the first ones are the widest.
        """
        above = len(self.estimators) - 1 - sorted(self.estimators).index(estimator)
        return WIDTH * (1.0 + 2.0 * above / max(len(self.estimators) - 1, 1))

    def colours(self, case: str) -> dict[str, Colour]:
        """Return the colours of the truth of `case` and of its estimators, by name."""
        truths = [topic for topic in self._truths if _prefix(topic) == case]
        has_truth = any(self.source.topics[topic].messages for topic in truths)
        named = {"truth": TRUTH} if has_truth else {}
        return named | {name: self.colour(name) for name in self.estimators_of(case)}

    def estimators_of(self, case: str) -> list[str]:
        """Return the estimators that estimate something of `case`."""
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
        """Return the run's sensor topics below `case`, and those below none; see `unread`."""
        others = [f"/{other}/" for other in self.cases if other != case and other]
        elsewhere = ("/estimates/", *others)
        return [
            topic
            for topic in self.source.topics
            if not topic.startswith(elsewhere) and topic not in self.unread
        ]

    @cached_property
    def unread(self) -> dict[str, str]:
        """Return the run's topics whose messages are no columns, such as images, and why."""
        found: dict[str, str] = {}
        for topic in self.source.topics:
            try:
                self.source.empty(topic)
            except BadInput as error:
                found[topic] = str(error)
        return found

    def read(self, topic: str) -> Stream:
        """Read all of the run's topic `topic`."""
        return self.source.read([topic])[topic]

    @property
    def dates(self) -> "Dates | None":
        """Return date stamps by the topic with most messages; None where stamps are dates."""
        streams = [self.read(topic) for topic in self.source.topics if topic not in self.unread]
        return dates_of(max(streams, key=len)) if streams else None

    @property
    def _truths(self) -> list[str]:
        return topics_of(self.source.topics, schemas.TRUTH_STATE)


def _prefix(topic: str) -> str:
    return topic.rpartition("/")[0].removeprefix("/")


def _natural(name: str) -> list[tuple[str, int]]:
    """Return the key that puts robot2 before robot10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name)]


@dataclass(frozen=True)
class Dates:
    """Holds two clocks side by side: stamps (k,), and by how many ns the dates are later (k,).

    Between two stamps the difference is linear, and before the first and after the last it stays.
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
    """Return the dates of a stream's stamps, when they were logged; None where the stamps are dates."""
    stamps_ns, logged_ns = stream.publish_time_ns, stream.log_time_ns
    if not len(stream) or stamps_ns[0] >= DATES_FROM_NS or logged_ns[0] < DATES_FROM_NS:
        return None
    return Dates(stamps_ns, logged_ns - stamps_ns)


@dataclass(frozen=True)
class Canvas:
    """Represents a recording and its clocks.

    Attributes:
        recording: where it goes.
        epoch_ns: the run's time zero.
        end_ns: when the last estimate or truth is.
        steps_ns: the distinct times of estimates, which `step` counts.
        is_still: nothing that moves is sent: it is there already.
        dates: what stamps are as dates, where they are none themselves.
    """

    recording: rr.RecordingStream
    epoch_ns: int
    end_ns: int
    steps_ns: Times
    is_still: bool = False
    dates: Dates | None = None

    def send(self, entity: str, time_ns: Times, columns: rr.ComponentColumnList) -> None:
        """Send all rows of an entity at once.

        Args:
            entity: the path.
            time_ns: (n,), the stamps.
            columns: of Rerun, with n rows.
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
        """Log `what` holds of `entity` at all times, such as a style."""
        self.recording.log(escaped(entity), *what, static=True, strict=True)


@dataclass(frozen=True)
class Timeline:
    """Draws a scenario family: `draw` sends everything and returns the layout of its views.

    Attributes:
        draw: (canvas, scene) -> the layout.
    """

    draw: Callable[[Canvas, Scene], rrb.Container | rrb.View]


def draw_cases(
    scene: Scene, draw_case: Callable[[str], rrb.Container | rrb.View]
) -> rrb.Container | rrb.View:
    """Return the layouts of all cases, in tabs where there are several, an estimated one first."""
    layouts = [draw_case(case) for case in scene.cases]
    if len(layouts) == 1:
        return layouts[0]
    estimated = [case for case in scene.cases if scene.estimators_of(case)]
    first = scene.focus or next(iter(estimated), scene.cases[0])
    return rrb.Tabs(*layouts, active_tab=scene.cases.index(first))


def beside(board: rrb.Container, plots: Sequence[Board], case: str) -> rrb.Container:
    """Return a case's board, and to its right its plots if there are any, all equally high."""
    shares = [float(strips_of(plot)) for plot in plots]
    columns = [board, rrb.Vertical(*plots, row_shares=shares)] if plots else [board]
    return rrb.Horizontal(*columns, name=case or "run")


def strips_of(board: Board) -> int:
    """Count the views that are seen one below another in a part of a layout."""
    if not isinstance(board, rrb.Container):
        return 1
    within = [strips_of(each) for each in board.contents if isinstance(each, rrb.Container | rrb.View)]
    return sum(within) if isinstance(board, rrb.Vertical) else max(within, default=0)


def entity_path(*parts: str) -> str:
    """Return an entity from its parts; empty ones, such as the case of a log with one, are left out."""
    return "/".join(part for part in parts if part)


def escaped(entity: str) -> str:
    """Write an entity as Rerun wants it, whatever is in its parts: an estimator `ukf:2`, say."""
    return "/".join(rr.escape_entity_path_part(part) for part in entity.split("/"))


def thin(time_ns: Times, rows: int = DRAWN_ROWS) -> NDArray[np.int64]:
    """Return the rows to draw: all, or the last of each of `rows` equal spans of time.

    Args:
        time_ns: (n,), in order.
        rows: how many at most.
    """
    if len(time_ns) <= rows:
        return np.arange(len(time_ns))
    of_span = _spans(time_ns, rows)
    return np.flatnonzero(np.append(of_span[1:] != of_span[:-1], True))


def thin_curve(time_ns: Times, values: Floats, rows: int = DRAWN_ROWS) -> NDArray[np.int64]:
    """Return the rows of a curve to draw: all, or the least and the greatest of each span of time.

    Args:
        time_ns, values: (n,), in order of time.
        rows: how many at most.
    """
    if len(time_ns) <= rows:
        return np.arange(len(time_ns))
    return extremes(_spans(time_ns, rows // 2), values)


def thin_scatter(count: int, rows: int = DRAWN_ROWS) -> NDArray[np.int64]:
    """Return the rows of a scatter of points to draw: all, or `rows` of them at random, in order.

    Extremes as of a curve would leave out what is between them, where most points are.
    """
    if count <= rows:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, rows, replace=False))


def extremes(of_span: NDArray[np.int64], values: Floats) -> NDArray[np.int64]:
    """Return the rows of the least and of the greatest value of every span, the first where several are.

    Args:
        of_span: (n,), the number of each value's span, from zero on and sorted.
        values: (n,); NaN is no extreme.
    """
    first = np.flatnonzero(np.diff(of_span, prepend=-1))
    sizes = np.diff(first, append=len(of_span))
    is_extreme = np.zeros(len(values), bool)
    for extreme in (np.fmin, np.fmax):
        rows = np.flatnonzero(values == np.repeat(extreme.reduceat(values, first), sizes))
        is_extreme[rows[np.diff(of_span[rows], prepend=-1) > 0]] = True
    return np.flatnonzero(is_extreme)


def _spans(time_ns: Times, spans: int) -> NDArray[np.int64]:
    """Tell in which of so many equal spans of time each stamp is, from zero on."""
    span_ns = max((time_ns[-1] - time_ns[0]) / spans, 1.0)
    return np.minimum((time_ns - time_ns[0]) / span_ns, spans - 1).astype(np.int64)


def gap_limit_ns(time_ns: Times) -> int:
    """Return how long a stream with these times, sorted, may be silent before it is missed.

    A stream without a rate, such as of shots or of what a camera happens to see, comes in bursts: it is
    compared with the pauses in which half of its time passes, apart from the longest.
    """
    intervals = np.sort(np.diff(np.unique(time_ns))).astype(float)
    usual_ns = usual_interval_ns(time_ns)
    near = np.abs(intervals - usual_ns) <= RATE_JITTER * usual_ns
    if len(intervals) > 1 and np.count_nonzero(near) < 0.5 * len(intervals):
        passed = np.cumsum(intervals[:-1])
        usual_ns = float(intervals[np.searchsorted(passed, 0.5 * passed[-1])])
    return int(max(GAP_INTERVALS * usual_ns, GAP_S * 1e9))


def usual_interval_ns(time_ns: Times) -> float:
    """Return the median between distinct times, sorted; zero where there is only one."""
    intervals = np.diff(np.unique(time_ns))
    return float(np.median(intervals)) if len(intervals) else 0.0


def nice(value: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is not below a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value))
