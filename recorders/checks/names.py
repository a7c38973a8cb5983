"""Checks of names: frames (REP 103), inertial units recorded twice (REP 145), isolated topics."""

import re
from collections.abc import Iterator, Mapping

from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.losses import REGULARS
from fuselog.recorders.log import Stream, schemas

SUFFIX = re.compile(r"_(ned|frd)$", re.IGNORECASE)


def frames(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find frames named NED or FRD, unlike the ENU and FLU of REP 103."""
    for key in ("frame_id", "child_frame_id"):
        found = SUFFIX.search(stream.metadata.get(key, ""))
        if found:
            kind = found[1].upper()
            ours = {"NED": "east, north, up", "FRD": "forward, left, up"}[kind]
            yield Finding(
                "name",
                stream.topic,
                "",
                0.0,
                f"{stream.topic}: its {key} {stream.metadata[key]} means {kind}, but REP 103 and "
                f"fuselog use {ours}",
                otherwise="mounting_deg = [180, 0, 0] in the mapping"
                if kind == "FRD"
                else "in the mapping swap north and east, and use the factor -1 for down",
                severity="hint",
            )


def doubles(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find inertial units that are recorded raw and, as in REP 145, again with an orientation."""
    raw = streams.get(stream.topic.replace("/data", "/data_raw"))
    is_unit = stream.schema.full_name == schemas.INERTIAL_SAMPLE.full_name
    if not is_unit or raw is None or raw is stream or raw.schema is not stream.schema:
        return
    yield Finding(
        "name",
        stream.topic,
        "",
        0.0,
        f"{stream.topic}: by REP 145 it repeats {raw.topic}, with an orientation from a filter: an "
        "estimator that uses both counts one unit twice",
        otherwise=f"--set topics.inertial={raw.topic} uses only one in the replay",
        severity="hint",
    )


def strays(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a topic alone in its namespace that duplicates another, so that a replay may ignore it."""
    sensed = [each for each in streams.values() if each.schema.full_name in REGULARS]
    alike = [each for each in sensed if each.schema.full_name == stream.schema.full_name]
    if stream.schema.full_name not in REGULARS or len(alike) != 2:
        return
    spaces = [each.topic.rpartition("/")[0] for each in sensed]
    [other] = [each for each in alike if each.topic != stream.topic]
    space, used = (each.topic.rpartition("/")[0] for each in (stream, other))
    if spaces.count(space) > 1 or spaces.count(used) < 2 or f"{space}/".startswith(f"{used}/"):
        return
    name = stream.topic.rpartition("/")[2]
    yield Finding(
        "name",
        stream.topic,
        "",
        0.0,
        f"{stream.topic}: it is alone in its namespace, but {other.topic}, which has the same messages, "
        f"is with {spaces.count(used) - 1} other topics in {used or '/'}: replay uses that one",
        otherwise=f"fuselog relabel LOG --topic {stream.topic}={used}/second/{name} joins them; when "
        f"importing, use "
        f"""--set 'names={{"{stream.topic}" = "{used}"}}'""",
        severity="hint",
    )
