"""Timelines in words: how views are laid out; of every entity how it looks, when it moves, and numbers.

Estimates are made, and so is what other families are of (`boards`). Of the numbers that are drawn the
first, the last and the root mean square are told; what they should be is tested in
`tests/replay/timeline`.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun.chunk as rc

from recorders.log import Stream, make_stream, schemas
from replay.engine.streams.blocks import gather
from replay.engine.streams.sources import MemorySource
from replay.judging.errors.evaluation import Floats
from replay.judging.judge import Judge
from replay.timeline.drawing.curves import CurvePanel, save_curves
from replay.timeline.drawing.plane import Stroke
from replay.timeline.show import show
from tests.replay.timeline.making import estimate, record
from tests.replay.timeline.test_timeline import Columns, read
from tests.words.made import boards

# By scenario, parameters of a short run, and whose estimates are made.
FAMILIES: Mapping[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "acoustic-shots": ({"shots": 2}, ("shooter",)),
    "axis": ({"steps": 4}, ("",)),
    "biometric-scores": ({"users": 20}, ()),
    "crossing": ({"duration_s": 4.0}, ()),
    "extended-target": ({"points": 8}, ("",)),
    "ispace": ({"steps": 4}, ("node1", "node2")),
    "landmarks": ({"duration_s": 1.0, "landmarks": 3}, ("robot1",)),
    "navigation": ({"duration_s": 12.0}, ()),
    "optical-los": ({}, ("",)),
    "orientation": ({"steps": 4}, ("", "left")),
    "relative-bearings": ({"looks": 4}, ()),
    "torus-headings": ({"steps": 4}, ("",)),
    "vehicles": ({"duration_s": 2.0, "vehicles": 2}, ("vehicle1", "vehicle2", "infrastructure")),
}
OTHER = "of no family"  # the robots' log, by schema
KINDS = {1: "tabs", 2: "side by side", 3: "one below the other", 4: "a grid"}
LOOKS = ("colors", "labels", "level", "radii", "text")
# What is drawn, of which a few numbers are told.
DATA = (
    *("positions", "strips", "centers", "half_sizes", "quaternions", "quaternion", "buffer"),
    *("line_strings", "origins", "vectors", "scalars", "values", "variances", "abscissa"),
    *("translation", "mat3x3", "scale"),
)
MOST = 6  # numbers of a row


def in_words(folder: Path) -> Iterator[str]:
    """The layout and the entities of a short run of every family, whose truth ends a stamp early."""
    recorded = {name: (record(name, **given), cases) for name, (given, cases) in FAMILIES.items()}
    robots, cases = recorded["landmarks"]
    receiver = _receiver(robots.epoch_ns)
    streams = {**robots.streams, receiver.topic: receiver}
    other = replace(robots, run=replace(robots.run, scenario=OTHER), streams=streams)
    recorded[OTHER] = other, cases
    for scenario, (source, cases) in recorded.items():
        common = source.streams.get("/truth")
        truths = {case: source.streams.get(f"/{case}/truth", common) for case in cases}
        known = {case: truth for case, truth in truths.items() if truth is not None}
        of_one = [_broken(estimate("one", case, truth)) for case, truth in known.items()]
        beside = [stream for each in of_one for stream in _beside(each)]
        of_two = [_broken(estimate("two", case, truth)) for case, truth in list(known.items())[:1]]
        ending = {truth.topic: truth.take(slice(None, -1)) for truth in known.values() if len(truth) > 2}
        ended = replace(source, streams={**source.streams, **ending})
        yield f"# {scenario}"
        yield from _drawn(ended, [*of_one, *beside, *of_two], folder / f"{scenario}.rrd")
        yield ""
    for title, source, made in boards.boards():
        yield f"# {title}"
        yield from _drawn(source, made, folder / f"{title.replace(' ', '_')}.rrd")
        yield ""
    yield from _curves(folder / "curves.rrd")


def _drawn(source: MemorySource, made: list[Stream], path: Path) -> Iterator[str]:
    """The layout and the entities of a run and of what is made of it."""
    outputs = {each.topic: gather([each]) for each in made}
    errors = Judge([source], {}, gap_limit_s=2.0).add(outputs).errors
    show(source, outputs, [each for each in errors if each is not None], save=path)
    yield from _layout(path)
    moving, still = read(path), read(path, static=True)
    alike: dict[str, list[str]] = defaultdict(list)
    for entity in sorted({*moving, *still}):
        told = [*_looks(still.get(entity, {})), *_moves(moving.get(entity, {}))]
        # errors of all families are compared with the judge's
        if not entity.rpartition("/")[0].rpartition("/")[2].startswith(("error_", "nees_")):
            told += [*_numbers(still.get(entity, {})), *_numbers(moving.get(entity, {}))]
        alike[", ".join(told)].append(entity)
    for line, entities in alike.items():
        yield from entities[:-1]
        yield f"{entities[-1]}: {line}"


def _broken(states: Stream) -> Stream:
    """The same, the covariance of whose second estimate is none."""
    states["covariance"][1:2, 0] *= -1.0
    return states


def _receiver(epoch_ns: int) -> Stream:
    """What components say of a solution and of a body: all that is known, and one that is not."""
    quality = [*range(1, 8), 7]
    return make_stream(
        "/robot1/receiver",
        schemas.VECTOR_MEASUREMENT,
        epoch_ns + 10**8 * np.arange(8),
        metadata={"components": "quality,standing,rolling"},
        value=np.stack([quality, np.arange(8) % 2, np.arange(8) // 4], axis=1).astype(float),
    )


def _curves(path: Path) -> Iterator[str]:
    """Two panels of curves over logarithms, of which a place is not positive."""
    x = np.array([1e-2, 1.0, 50.0])
    falling = np.stack([x, 1e3 / x], axis=1)
    strokes = {"one": Stroke((1, 2, 3), 1.5), "two": Stroke((4, 5, 6), 2.5)}
    first = CurvePanel("x over y", {"one": falling, "two": falling[1:] * [3.0, 1e-3]}, strokes)
    second = CurvePanel("of one", {"one": np.vstack([falling, [-1.0, 2.0]])}, strokes)
    save_curves("curves", [first, second], path)
    yield "# curves"
    yield from _layout(path)
    still = read(path, static=True)
    for entity in sorted(still):
        yield f"{entity}: {', '.join([*_looks(still[entity]), *_numbers(still[entity])])}"


def _beside(state: Stream) -> Iterator[Stream]:
    """What a filter says beside its states: particles, two modes, one that is gated, a failure."""
    stem, time_ns = state.topic.rpartition("/")[0], state.publish_time_ns
    rising = np.linspace(0.1, 0.9, len(time_ns))
    modes = np.stack([rising, 1.0 - rising], axis=1)
    named = {"components": "calm,agile", "kinds": "linear,linear"}
    yield make_stream(
        f"{stem}/modes", schemas.MODE_PROBABILITIES, time_ns, metadata=named, probability=modes
    )
    count = np.full(len(time_ns), 50)
    yield make_stream(
        f"{stem}/effective",
        schemas.EFFECTIVE_PARTICLES,
        time_ns,
        particles=count,
        effective=count * rising,
    )
    yield make_stream(
        f"{stem}/innovation",
        schemas.INNOVATION,
        time_ns,
        target_id=np.zeros(len(time_ns), int),
        accepted=np.arange(len(time_ns)) > 0,
        innovation=modes,
        covariance=np.tile([4.0, 1.0, 1.0, 9.0], (len(time_ns), 1)),
        normalised_innovation_squared=9.0 * rising,
        log_likelihood=-rising,
    )
    failed = {"reasons": json.dumps(["the covariance is no longer positive definite"])}
    yield make_stream(f"{stem}/failure", schemas.FAILURE, time_ns[-1:], metadata=failed, reason=[0])


def _layout(path: Path) -> Iterator[str]:
    """The boards and views, those within others set in."""
    reader = rc.RrdReader(str(path))
    parts: dict[str, dict[str, Any]] = defaultdict(dict)
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        part, _, of = chunk.entity_path.strip("/").partition("/")
        number, _, detail = of.partition("/")
        named = {name: batch.column(name)[0].as_py() for name in batch.schema.names}
        if "VisibleTimeRanges:ranges" in named:
            shown = [each["range"]["start"] for each in named["VisibleTimeRanges:ranges"]]
            named = {f"trail {detail}": [shown[0] / 1e9, shown[-1]]}
        parts[f"{part}/{number}"] |= named
    within = {each for part in parts.values() for each in part.get("ContainerBlueprint:contents", ())}
    [root] = [each for each in parts if each.startswith("container/") and each not in within]
    for name in sorted(each for each in parts if "_panel/" in each):
        told = " ".join(map(str, parts[name].get("PanelBlueprint:state", ())))
        yield from [f"{name.strip('/')}: state {told}"] if told else []
    yield from (f"time: {each}" for each in parts["time_panel/"].get("TimePanelBlueprint:timeline", ()))
    yield from _board(parts, root, 1)


def _board(parts: Mapping[str, dict[str, Any]], name: str, depth: int) -> Iterator[str]:
    """A board with its shares, or a view with what it shows, and all within it."""
    part = parts[name]
    if name.startswith("view/"):
        [kind], [title] = part["ViewBlueprint:class_identifier"], part["ViewBlueprint:display_name"]
        [origin] = part["ViewBlueprint:space_origin"]
        roots = " ".join(each.replace("$origin", origin) for each in part["ViewContents:query"])
        told = [f"{kind} '{title}' of {roots}"]
        told += [f"from {low:.4g} to {high:.4g}" for low, high in part.get("ScalarAxis:range") or ()]
        for bounds in part.get("VisualBounds2D:range") or ():
            told += [f"{axis[0]} {_short(ends)}" for axis, ends in bounds.items()]
        for way, words in (("PlotLegend:visible", "legend"), ("ScalarAxis:zoom_lock", "locked")):
            told += [words] if (part.get(way) or [False])[0] else []
        trails = {tuple(trail) for key, trail in part.items() if key.startswith("trail ")}
        told += [f"trail {-seconds:g} s, {-steps} steps" for seconds, steps in sorted(trails)]
    else:
        [title] = part.get("ContainerBlueprint:display_name", [""])
        told = [f"{KINDS[part['ContainerBlueprint:container_kind'][0]]} '{title}'"]
        shares = part.get("ContainerBlueprint:col_shares") or part.get("ContainerBlueprint:row_shares")
        told += [f"shares {_short(shares)}"] if shares else []
        shown = part.get("ContainerBlueprint:active_tab")
        contents = part["ContainerBlueprint:contents"]
        told += [f"shows number {contents.index(shown[0]) + 1}"] if shown else []
    yield "  " * depth + ", ".join(told)
    for each in part.get("ContainerBlueprint:contents", ()):
        yield from _board(parts, each, depth + 1)


def _looks(columns: Columns) -> Iterator[str]:
    """What holds at all times, but for the data: names, colours, widths."""
    for name in sorted(columns):
        values = columns[name][-1]
        what = name.partition(":")[2]
        if what in DATA or not values:
            continue
        if what == "colors":
            values = list(dict.fromkeys(f"#{each:08x}" for each in values))
        yield f"{what} {' '.join(map(_short, values[:8]))}"


def _numbers(columns: Columns) -> Iterator[str]:
    """Of what is drawn the first numbers, the last, the root mean square; of pictures that alone."""
    for name in sorted(columns):
        what = name.partition(":")[2]
        values = _flat(columns[name] if what in DATA else [])
        known = values[np.isfinite(values)]
        if not len(known):
            continue
        values[np.abs(values) < 1e-6 * np.abs(known).max()] = 0.0
        ends = [values] if len(values) <= 2 * MOST else [values[:MOST], values[-MOST:]]
        told = " to ".join(" ".join(map(_digits, end)) for end in ends)
        told = "" if what == "buffer" else f"{told}, "
        yield f"{what} {told}{len(values)} with rms {np.sqrt(np.mean(known**2)):.4g}"


def _digits(number: float) -> str:
    """Four digits, with zeros: what is compared may differ by one of the last."""
    return f"{number:.4g}" if number == round(number) else f"{number:#.4g}"


def _flat(value: Any) -> Floats:
    """All numbers within lists and their buffers."""
    if isinstance(value, Mapping):
        return _flat(value["buffer"])
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8).astype(float)
    try:
        return np.array(value, float).ravel()
    except (TypeError, ValueError):  # lists of different lengths, or of buffers
        return np.concatenate([_flat(each) for each in value])


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "(" + " ".join(map(_short, value)) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _moves(columns: Columns) -> Iterator[str]:
    """What moves, how many rows of it, from when to when, and how it looks or what it says meanwhile."""
    if not columns:
        return
    kinds = {name.partition(":")[0] for name in columns if ":" in name}
    times = columns["sim_time"]
    span = f"from {times[0] / 1e9:.4f} to {times[-1] / 1e9:.4f} s"
    yield f"{len(times)} of {' and '.join(sorted(kinds))} {span}"
    for name in sorted(columns):
        what = name.partition(":")[2]
        if what in LOOKS:
            shown = dict.fromkeys(each for row in columns[name] for each in row or ())
            told = [f"#{each:08x}" if what == "colors" else _short(each) for each in shown]
            yield f"{what} {' '.join(told[:20])}"
