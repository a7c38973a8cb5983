"""Editing of logs: cutting, merging, renaming topics and components, adding pseudo-measurements.

Logs are processed block by block, so memory use does not grow with their length. The result is a new log
whose metadata states the operation; the original logs are not changed.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from fuselog.pipeline.logs.constraints import ConstraintParameters, constraints_of
from fuselog.pipeline.logs.cutting import Thinner, is_prior, static_topics, thinner
from fuselog.pipeline.logs.rewriting import (
    Blocks,
    Changed,
    joined_runs,
    losses_of,
    matching_topics,
    ranked,
    readable_log,
    run_of,
    stream_blocks,
    with_operation,
    write_changed,
)
from fuselog.pipeline.output.outputs import changed, check_files
from fuselog.pipeline.runs.initial_states import span_of
from fuselog.recorders.errors import BadInput, UnknownName, choices, without_warnings_of_numbers
from fuselog.recorders.log import Log, Stream, open_log, read_empty, schemas, topics_of
from fuselog.recorders.log.schemas import SCHEMAS
from fuselog.recorders.parameters import build
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.streams.sources import LogSource


@without_warnings_of_numbers()
def cut(
    path: str | Path,
    out: str | Path,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    topics: Sequence[str] = (),
    decimate: Mapping[str, int | str] | None = None,
    recover: bool = False,
) -> Changed:
    """Write a part of a log: a time span, selected topics, or fewer messages.

    Stamps and the epoch do not change, so a time in seconds means the same in both logs. Maps, priors
    and topics that have messages only at the first stamp of the log are copied completely, regardless of
    the span.

    Args:
        path: the log, or estimates log.
        out: the log to write.
        start_s: omit messages published before this time, in seconds since the run's epoch.
        end_s: omit messages published at this time or later.
        topics: names or patterns of the topics to copy, such as "/robot1/*"; all topics if empty.
        decimate: decimation by topic or pattern: an integer n keeps every n-th stamp, a rate such as
            "5Hz" keeps at most that many stamps per second. Messages with the same stamp stay together.
        recover: read the intact part of a log that was cut off or damaged.

    Returns:
        The path of the new log, the number of messages of each topic, and sentences on what is lost.

    Raises BadInput if a name or pattern matches no topic, the span has no messages, or another file
    exists at the path of the output.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", duration_s=2.0))
    >>> topics = ["/robot1/odometry", "*/prior"]
    >>> cut("run.mcap", "part.mcap", start_s=1, topics=topics, decimate={"*/odometry": 5}).messages
    {'/robot1/prior': 1, '/robot1/odometry': 4}
    """
    log, target = open_log(path, recover=recover), Path(out)
    check_files([(target, changed("cut"))], {"log": [log.path]})
    notes = losses_of(log)
    source = span_of(LogSource(log), start_s, end_s, "publish_time")
    chosen = readable_log(log, matching_topics(log, topics), notes, asked=topics)
    zero_ns = source.zero_ns("publish_time")
    thinners: dict[str, Thinner] = {}
    for pattern, rate in (decimate or {}).items():
        for topic in matching_topics(log, [pattern]):
            thinners[topic] = thinner(pattern, rate, zero_ns)
    once = [] if source.start_ns is source.end_ns is None else static_topics(log, chosen)
    if once:
        notes.append(f"copied completely, regardless of the span: {', '.join(once)}")
    if start_s is not None and any(is_prior(log, topic) for topic in once):
        notes.append(
            f"the prior is older than this part of the log: replay the part with --start {start_s:g} "
            "--start-from truth, "
            "or start from the estimates of an earlier replay"
        )

    def blocks() -> Blocks:
        start_ns, end_ns = source.start_ns, source.end_ns
        if start_ns is not None:
            yield from stream_blocks(log, once, None, start_ns)
        yield from stream_blocks(log, chosen, start_ns, end_ns)
        if end_ns is not None:
            yield from stream_blocks(log, once, end_ns, None)

    thinned = (
        [thinners[each.topic].thin(each) if each.topic in thinners else each for each in block]
        for block in blocks()
    )
    asked = {
        "from": None if start_s is None else f"{start_s:g} s",
        "to": None if end_s is None else f"{end_s:g} s",
        "topics": " ".join(topics) or None,
        "decimated": " ".join(f"{name}={rate}" for name, rate in (decimate or {}).items()) or None,
    }
    done = " ".join(["cut", log.path.name, *(f"{key} {value}" for key, value in asked.items() if value)])
    run = with_operation(run_of(log, target), "cut", done)
    return write_changed(target, run, [read_empty(log, topic) for topic in chosen], thinned, notes)


@without_warnings_of_numbers()
def merge(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    offsets_s: Mapping[str, float] | None = None,
    recover: bool = False,
) -> Changed:
    """Merge several logs that have no topic in common into one.

    Times in seconds count from the epoch of the first log. Messages with equal stamps are written in the
    order of the logs.

    Args:
        paths: the logs.
        out: the log to write.
        offsets_s: offsets by log; each is added to all stamps of its log, to correct differences between
            clocks. The sensors' own clock readings do not change.
        recover: read the intact parts of logs that were cut off or damaged.

    Returns:
        The path of the new log, the number of messages of each topic, and sentences on what is lost.

    Raises BadInput if two logs have a topic in common, an offset refers to an unknown log or moves
    stamps out of range, or another file exists at the path of the output.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", duration_s=2.0))
    >>> _ = relabel("run.mcap", "left.mcap", topics={"/": "/left/"})
    >>> done = merge(["run.mcap", "left.mcap"], "both.mcap", offsets_s={"left.mcap": -0.5})
    >>> done.messages["/left/robot1/odometry"] == done.messages["/robot1/odometry"]
    True
    """
    target = Path(out)
    if len(paths) < 2:
        raise BadInput(
            f"{', '.join(map(str, paths))}: merging needs at least two logs; give another one"
        )
    logs = [open_log(path, recover=recover) for path in paths]
    check_files([(target, changed("merge"))], {"log": [log.path for log in logs]})
    offsets_ns = _offsets_ns(logs, offsets_s or {})
    notes = [note for log in logs for note in losses_of(log)]
    chosen = [readable_log(log, ranked(log), notes) for log in logs]
    holder: dict[str, Path] = {}
    for log, names in zip(logs, chosen, strict=True):
        common = [name for name in names if name in holder]
        if common:
            raise BadInput(
                f"{log.path}: topic {common[0]} ({len(common)} in all) is also in {holder[common[0]]}; "
                f"rename it in one log first, such as: fuselog relabel {log.path} --topic /=/b/ -o NEW"
            )
        holder |= dict.fromkeys(names, log.path)
    blocks = (
        [_shifted(stream, offset_ns) for stream in block]
        for log, names, offset_ns in zip(logs, chosen, offsets_ns, strict=True)
        for block in stream_blocks(log, names)
    )
    empty = [read_empty(log, name) for log, names in zip(logs, chosen, strict=True) for name in names]
    merged = [
        f"{log.path.name}{f' {offset_ns * 1e-9:+g} s' if offset_ns else ''}"
        for log, offset_ns in zip(logs, offsets_ns, strict=True)
    ]
    run = with_operation(joined_runs(logs, offsets_ns, target), "merge", f"merged {', '.join(merged)}")
    return write_changed(target, run, empty, blocks, notes)


@without_warnings_of_numbers()
def relabel(
    path: str | Path,
    out: str | Path,
    *,
    topics: Mapping[str, str] | None = None,
    components: Mapping[str, str] | None = None,
    recover: bool = False,
) -> Changed:
    """Write a log with renamed topics and components.

    References to a renamed topic are updated, such as an estimate's reference to its truth.

    Args:
        path: the log, or estimates log.
        out: the log to write.
        topics: new names by old names. If the old and the new name both end in a slash, as in
            "/robot1/": "/robot2/", they are prefixes, and all topics with the old prefix are renamed.
            Topics to which estimates refer, such as their truth, need not be in the log.
        components: new names of components by old names, such as "x_m": "east_m", for all topics that
            have these components.
        recover: read the intact part of a log that was cut off or damaged.

    Returns:
        The path of the new log, the number of messages of each topic, and sentences on what is lost.

    Raises BadInput if a topic or component does not exist, two would have the same name, or another
    file exists at the path of the output.
    """
    log, target = open_log(path, recover=recover), Path(out)
    check_files([(target, changed("relabel"))], {"log": [log.path]})
    if not topics and not components:
        raise BadInput(f"{log.path}: nothing to rename; give a topic or a component")
    names = _renamed_topics(log, topics or {})
    _check_components(log, components or {})
    notes = losses_of(log)
    chosen = readable_log(log, ranked(log), notes)

    def renamed(stream: Stream) -> Stream:
        metadata = {key: names.get(value, value) for key, value in stream.metadata.items()}
        if "components" in metadata:
            known = metadata["components"].split(",")
            metadata["components"] = ",".join((components or {}).get(name, name) for name in known)
        return replace(stream, topic=names.get(stream.topic, stream.topic), metadata=metadata)

    blocks = ([renamed(stream) for stream in block] for block in stream_blocks(log, chosen))
    pairs = [f"{old}={new}" for old, new in {**(topics or {}), **(components or {})}.items()]
    run = with_operation(run_of(log, target), "relabel", f"relabelled {log.path.name} {' '.join(pairs)}")
    return write_changed(
        target, run, [renamed(read_empty(log, topic)) for topic in chosen], blocks, notes
    )


@without_warnings_of_numbers()
def constrain(
    path: str | Path,
    out: str | Path,
    *,
    unit: str | None = None,
    settings: Mapping[str, object] | None = None,
    recover: bool = False,
) -> Changed:
    """Write a log with zero-velocity and non-holonomic pseudo-measurements from its inertial unit.

    The topics `standing` and `rolling` are added next to the unit's topic; see
    `fuselog.pipeline.logs.constraints`.

    Args:
        path: the log.
        out: the log to write.
        unit: the topic of the inertial samples; required if the log has several such topics.
        settings: values of `ConstraintParameters`, such as {"rolling_hz": 10}.
        recover: read the intact part of a log that was cut off or damaged.

    Returns:
        The path of the new log, the number of messages of each topic, and sentences on what is lost.

    Raises BadInput if the unit is ambiguous or missing, the log already has one of the topics, both
    rates are zero, or another file exists at the path of the output.
    """
    log, target = open_log(path, recover=recover), Path(out)
    check_files([(target, changed("constrain"))], {"log": [log.path]})
    parameters = build(ConstraintParameters, settings or {}, "constrain")
    chosen_unit = _unit_of(log, unit)
    added = constraints_of(LogSource(log).read([chosen_unit])[chosen_unit], parameters)
    for stream in added:
        if stream.topic in log.topics:
            raise BadInput(
                f"{log.path}: already has a topic {stream.topic}; rename it first with fuselog relabel"
            )
    notes = losses_of(log)
    for stream in added:
        held, total = int(stream["value"].sum()), len(stream)
        notes.append(f"{stream.topic}: true at {held} of {total} stamps")
    chosen = readable_log(log, ranked(log), notes)
    empty = [*(read_empty(log, topic) for topic in chosen), *(each.take(slice(0)) for each in added)]
    names = " ".join(stream.topic for stream in added)
    run = with_operation(
        run_of(log, target), "constrain", f"constrained {log.path.name} by {chosen_unit}: {names}"
    )
    return write_changed(target, run, empty, chain(stream_blocks(log, chosen), [added]), notes)


def _unit_of(log: Log, unit: str | None) -> str:
    """Choose the topic of inertial samples; raise BadInput if it is missing or ambiguous."""
    kind = schemas.INERTIAL_SAMPLE
    units = topics_of(log.topics, kind)
    if not units:
        raise BadInput(f"{log.path}: has no inertial unit (topic of type {kind.full_name})")
    if unit is None and len(units) > 1:
        raise BadInput(
            f"{log.path}: has several inertial units; choose one with --unit: {', '.join(units)}"
        )
    if unit is not None and unit not in units:
        raise UnknownName(f"{log.path}: no inertial unit {unit}; {choices(unit, units)}")
    return unit or units[0]


def _offsets_ns(logs: Sequence[Log], offsets_s: Mapping[str, float]) -> list[int]:
    """Return the offset of each log; raise BadInput if it would move stamps out of their range."""
    paths = [log.path for log in logs]
    for path, offset_s in offsets_s.items():
        if located(path) not in paths:
            raise UnknownName(f"no log {path} to merge; {choices(path, list(map(str, paths)))}")
        if not abs(offset_s) <= 1e9:
            raise BadInput(f"offset of {path}: is {offset_s}; give a number of seconds, such as 0.5")
    by_path = {located(path): round(offset_s * 1e9) for path, offset_s in offsets_s.items()}
    found = [by_path.get(path, 0) for path in paths]
    for log, offset_ns in zip(logs, found, strict=True):
        source = LogSource(log)
        stamps_ns = [*source.extent("publish_time"), *source.extent("log_time")]
        if min(stamps_ns) + offset_ns < 0 or max(stamps_ns) + offset_ns >= 2**63:
            raise BadInput(
                f"{log.path}: an offset of {offset_ns * 1e-9:g} s moves stamps outside the years 1970 "
                "to 2262; give a smaller one"
            )
    return found


def _shifted(stream: Stream, offset_ns: int) -> Stream:
    """Shift the stamps of a stream, and the times in its messages that refer to the log's clock."""
    if not offset_ns:
        return stream
    is_ours = stream.schema.full_name in SCHEMAS
    moved = {
        field.name: stream.columns[field.name] + offset_ns
        for field in stream.schema
        if is_ours and field.kind == "time_ns" and field.name != "sensor_time_ns"
    }
    return replace(
        stream,
        publish_time_ns=stream.publish_time_ns + offset_ns,
        log_time_ns=stream.log_time_ns + offset_ns,
        columns={**stream.columns, **moved},
    )


def _renamed_topics(log: Log, topics: Mapping[str, str]) -> dict[str, str]:
    """Return the new names of topics by old name, including topics that occur only in the metadata."""
    stated = {value for topic in log.topics.values() for value in topic.metadata.values()}
    known = [
        *log.topics,
        *sorted(value for value in stated - log.topics.keys() if value.startswith("/")),
    ]
    names: dict[str, str] = {}
    for old, new in topics.items():
        if not new.startswith("/") or not new.isprintable() or old.endswith("/") != new.endswith("/"):
            raise BadInput(
                f"relabel {old}={new}: expected two topics, as in /old=/new, or two prefixes, as in "
                "/robot1/=/robot2/"
            )
        found = [name for name in known if name == old or (old.endswith("/") and name.startswith(old))]
        if not found:
            raise UnknownName(f"{log.path}: no topic {old}; {choices(old, known)}")
        names |= {name: new + name.removeprefix(old) for name in found}
    for name, count in Counter(names.get(topic, topic) for topic in log.topics).items():
        if count > 1:
            raise BadInput(
                f"{log.path}: {count} topics would have the name {name}; give each a different name"
            )
    return names


def _check_components(log: Log, components: Mapping[str, str]) -> None:
    """Raise BadInput if a component does not exist, or two would have the same name in a topic."""
    stated = {
        topic: found["components"].split(",")
        for topic, found in ((name, each.metadata) for name, each in log.topics.items())
        if "components" in found
    }
    known = list(dict.fromkeys(name for names in stated.values() for name in names))
    for old, new in components.items():
        if old not in known:
            raise UnknownName(f"{log.path}: no component '{old}'; {choices(old, known)}")
        if not new.isprintable() or not new.strip() or "," in new:
            raise BadInput(f"relabel {old}={new}: expected a name, such as x_m, without a comma")
    for topic, names in stated.items():
        after = [components.get(name, name) for name in names]
        twice = [name for name in after if after.count(name) > 1]
        if twice and after != names:
            raise BadInput(
                f"{log.path}: topic {topic} would have two components {twice[0]}; give a different name"
            )
