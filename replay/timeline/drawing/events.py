"""Event log of a run: worst moments, rejected and out-of-sequence measurements, failures, gaps."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.replaying.usage import CONTROLS
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.judging.errors.moments import Moment
from fuselog.replay.timeline.drawing.canvas import (
    Board,
    Canvas,
    Scene,
    Times,
    entity_path,
    escaped,
    gap_limit_ns,
    thin,
)

NOT_SENSED = frozenset(
    schema.full_name
    for schema in (
        schemas.LANDMARK,
        schemas.TRUTH_STATE,
        schemas.OUTAGE,
        schemas.LINK_EVENT,
        schemas.GAUSSIAN_ESTIMATE,
    )
)


# Meaning of components for the solution of a receiver, numbered as in RTKLIB, and for a body.
STATES: Mapping[str, Mapping[float, str]] = {
    "quality": {
        1: "solution fixed",
        2: "solution float",
        3: "solution SBAS",
        4: "solution differential",
        5: "solution single",
        6: "solution PPP",
    },
    "standing": {0: "moves", 1: "stationary: zero velocity"},
    "rolling": {0: "may slip", 1: "rolls: zero lateral and vertical velocity"},
}

Draw = Callable[[Canvas, Scene, str], list[Board]]


class Happened(NamedTuple):
    """Events of an estimator or a sensor: a text for each time, all of one level.

    `part` is an entity below the entity of `who`, for events that are drawn as a separate entity.
    """

    who: str
    level: str
    time_ns: Times
    texts: list[str]
    part: str = ""


def above_events(
    board: rrb.View | rrb.Container, events: Sequence[rrb.View], share: float = 3.0
) -> rrb.Container:
    """Return a panel above its events, if any; the panel is `share` times as high as the events."""
    return rrb.Vertical(board, *events, row_shares=[share, 1.0][: 1 + len(events)])


def draw_events(
    canvas: Canvas,
    scene: Scene,
    case: str,
    not_drawn: Mapping[str, str] | None = None,
    also: Iterable[Happened] = (),
    more: Collection[str] = (),
) -> list[rrb.TextLogView]:
    """Draw the events of a case, one entity per estimator and sensor; return no view without events.

    `not_drawn` states why topics are not drawn, in addition to unreadable topics; `also` contains events
    of the scenario family; `more` contains other cases whose worst moments are included.
    """
    root = entity_path("events", case)
    reasons = {**scene.unread, **(not_drawn or {})}
    texts = [f"{topic} is not drawn: {reason}" for topic, reason in reasons.items()]
    unread = Happened("log", "INFO", np.full(len(texts), canvas.epoch_ns), texts)
    happened = [unread, *also, *_of_moments(scene, {case, *more}), *_of_estimators(scene, case)]
    happened += [*_of_divergences(scene, case), *_of_sensors(scene, case)]
    happened = [each for each in happened if each.texts]
    for who, level, time_ns, texts, part in happened:
        lines = stamped(canvas, time_ns, [f"{who}: {text}" for text in texts])
        columns = rr.TextLog.columns(text=lines, level=[level] * len(lines))
        canvas.send(entity_path(root, who, part), time_ns, columns)
    return [events_view(root)] if happened else []


def stamped(canvas: Canvas, time_ns: Times, texts: Sequence[str]) -> list[str]:
    """Put the time in the run before each text, because the viewer truncates its own column of stamps.

    Args:
        canvas: a canvas with the run's epoch.
        time_ns, texts: n stamps and n texts.
    """
    elapsed_s = ((time_ns - canvas.epoch_ns) * 1e-9).tolist()
    return [f"{at_s:.3f} s, {text}" for at_s, text in zip(elapsed_s, texts, strict=True)]


def events_view(root: str) -> rrb.TextLogView:
    """Return a view of all events below an entity."""
    shown = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin=escaped(root), name="Events", columns=shown)


def _of_moments(scene: Scene, cases: Collection[str]) -> Iterator[Happened]:
    """Yield the moments at which the estimators of some cases are worst."""
    found: dict[str, list[Moment]] = {}
    for moment in sorted(scene.moments, key=lambda each: each.time_ns):
        if moment.case in cases:
            found.setdefault(moment.estimator, []).append(moment)
    for estimator, moments in found.items():
        texts = [f"largest {each.words}" + (f" of {each.case}" if each.case else "") for each in moments]
        yield Happened(estimator, "INFO", np.array([each.time_ns for each in moments]), texts, "worst")


def _of_divergences(scene: Scene, case: str) -> Iterator[Happened]:
    """Yield the points at which estimators diverge, unless a diagnosis has already found the cause."""
    diagnosed = {estimator for estimator, _ in scene.outputs_of(case, schemas.DIAGNOSED)}
    for estimator, stream in scene.outputs_of(case, schemas.INNOVATION):
        if stream.topic in scene.divergences and estimator not in diagnosed:
            found = scene.divergences[stream.topic]
            text = f"diverges: NIS per component is {found.nis_per_component:.3g} from here on"
            yield Happened(estimator, "ERROR", np.array([found.time_ns]), [text])


def _of_estimators(scene: Scene, case: str) -> Iterator[Happened]:
    for estimator, stream in scene.outputs_of(case, schemas.GAUSSIAN_ESTIMATE):
        times = stream.publish_time_ns
        drawn, span_s = len(thin(times)), (times[-1] - times[0]) * 1e-9
        if drawn < len(times):
            text = f"drawn at {drawn / span_s:.3g} Hz instead of {len(times) / span_s:.3g} Hz"
            yield Happened(estimator, "INFO", times[:1], [text])
    for estimator, stream in scene.outputs_of(case, schemas.INNOVATION):
        gated = stream.take(stream["accepted"] == 0)
        if len(gated):
            yield Happened(estimator, "WARN", gated.publish_time_ns, _gated(scene, case, gated))
    for estimator, stream in scene.outputs_of(case, schemas.STARTED):
        yield Happened(estimator, "INFO", stream.publish_time_ns, sentences_of(stream))
    for estimator, stream in scene.outputs_of(case, schemas.DIAGNOSED):
        yield Happened(estimator, "WARN", stream.publish_time_ns, sentences_of(stream))
    for estimator, stream in scene.outputs_of(case, schemas.SKIPPED):
        texts = [f"not used: {reason}" for reason in sentences_of(stream)]
        yield Happened(estimator, "WARN", stream.publish_time_ns, texts)
    for estimator, stream in scene.outputs_of(case, schemas.REWOUND):
        late_s = (stream.log_time_ns - stream.publish_time_ns) * 1e-9
        texts = [
            f"came {delay:.3f} s late: {repeated} messages after it were reprocessed"
            for delay, repeated in zip(late_s.tolist(), stream["repeated"].tolist(), strict=True)
        ]
        yield Happened(estimator, "INFO", stream.publish_time_ns, texts)
    for estimator, stream in scene.outputs_of(case, schemas.WAITED):
        texts = [
            f"came late, {behind:.3f} s behind newer messages, which waited for it"
            for behind in stream["behind_s"].tolist()
        ]
        yield Happened(estimator, "INFO", stream.publish_time_ns, texts)
    for estimator, stream in scene.outputs_of(case, schemas.FAILURE):
        texts = [f"failed: {reason}" for reason in sentences_of(stream)]
        yield Happened(estimator, "ERROR", stream.publish_time_ns, texts)
    for estimator, stream in scene.outputs_of(case, schemas.RELATIVE_BEARING):
        pairs = zip(stream["first_id"].tolist(), stream["second_id"].tolist(), strict=True)
        texts = [f"empty set, caused by the pair {first}, {second}" for first, second in pairs]
        yield Happened(estimator, "ERROR", stream.publish_time_ns, texts)


def _gated(scene: Scene, case: str, gated: Stream) -> list[str]:
    """Describe rejected measurements by naming sensors with a message of the same stamp and target."""
    sensed = {
        within(topic, case): scene.read(topic)
        for topic in scene.topics_near(case)
        if scene.source.topics[topic].schema_name not in NOT_SENSED | CONTROLS
    }
    there = {
        sensor: set(zip(stream.publish_time_ns.tolist(), _targets(stream), strict=True))
        for sensor, stream in sensed.items()
    }
    texts = []
    squares = gated["normalised_innovation_squared"].tolist()
    of = zip(gated.publish_time_ns.tolist(), _targets(gated), squares, strict=True)
    for time_ns, target, square in of:
        sensors = [sensor for sensor, messages in there.items() if (time_ns, target) in messages]
        what = " or ".join(sensors) or "a measurement"
        texts.append(f"rejected {what}{f' of target {target}' if target else ''}: NIS {square:.1f}")
    return texts


def _targets(stream: Stream) -> list[int]:
    """Return the targets of messages, 0 for none."""
    none = np.zeros(len(stream), np.int64)
    return stream.columns.get("target_id", none).tolist()


def within(topic: str, case: str) -> str:
    """Return the name of a topic within its case."""
    return topic.removeprefix(f"/{case}").removeprefix("/")


def _of_sensors(scene: Scene, case: str) -> Iterator[Happened]:
    """Yield outages and gaps of sensors, and changes in the status of their solutions."""
    for topic in scene.topics_near(case):
        if scene.source.topics[topic].schema_name in NOT_SENSED:
            continue
        outages = np.empty((0, 2), np.int64)
        if f"{topic}/outages" in scene.source.topics:
            stated = scene.read(f"{topic}/outages")
            outages = np.stack([stated.publish_time_ns, stated["end_time_ns"]], axis=1)
        silent = gaps(scene.read(topic))
        explained = (silent[:, None, 0] < outages[:, 1]) & (outages[:, 0] < silent[:, None, 1])
        sensor = within(topic, case)
        yield from _changes(sensor, scene.read(topic))
        yield _spans(sensor, "outage of", outages)
        yield _spans(sensor, "no messages for", silent[~explained.any(axis=1)])


def _changes(sensor: str, stream: Stream) -> Iterator[Happened]:
    """Yield changes in the status of the solution or body that a sensor reports; see STATES."""
    if stream.schema.full_name != schemas.VECTOR_MEASUREMENT.full_name:
        return
    for column, component in enumerate(stream.components):
        if component in STATES:
            numbers, words = stream["value"][:, column], STATES[component]
            rows = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0.0)
            texts = [words.get(number, f"{component} {number:g}") for number in numbers[rows].tolist()]
            yield Happened(sensor, "INFO", stream.publish_time_ns[rows], texts)


def gaps(stream: Stream, *end_ns: int) -> Times:
    """Find gaps (n, 2), start and end, that are much longer than the usual interval of a sensor.

    With the end of the run, the time after the last message can also be a gap.
    """
    times = np.append(stream.publish_time_ns, np.array(end_ns, np.int64))
    long = np.diff(times) > gap_limit_ns(stream.publish_time_ns)
    return np.stack([times[:-1][long], times[1:][long]], axis=1)


def _spans(sensor: str, what: str, spans: Times) -> Happened:
    texts = [f"{what} {seconds:.1f} s" for seconds in (np.diff(spans)[:, 0] * 1e-9).tolist()]
    return Happened(sensor, "WARN", spans[:, 0], texts)


def draw_registered(canvas: Canvas, scene: Scene, case: str, streams: Iterable[Stream]) -> list[Board]:
    """Draw a case with the registered `fuselog.drawings` entry points, and return their panels.

    Each entry point has the name of a schema. It is loaded if one of `streams` has this schema.
    """
    found = dict.fromkeys(stream.schema.full_name for stream in streams)
    drawn: list[Board] = []
    for name in [each for each in found if each in available("drawings")]:
        draw: Draw = load("drawings", name)
        drawn += draw(canvas, scene, case)
    return drawn
