"""Tables for a program, and reading of the estimates that it wrote: MCAP, TUM, or CSV."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, open_log, read_streams, schemas
from fuselog.recorders.log.streams import empty_stream, make_stream
from fuselog.recorders.trajectories import read_trajectory
from fuselog.replay.engine.vectors.components import Components, stated_components
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.errors.trajectory_streams import estimates_of

MAGIC = b"\x89MCAP0"
KEPT = (schemas.GAUSSIAN_ESTIMATE.full_name, schemas.INNOVATION.full_name)


def read_estimates(path: Path, label: str, truth: Topic | None) -> dict[str, Stream]:
    """Read the estimates in a file by topic, under a label; raise BadInput if there are none.

    Args:
        path: the file.
        label: label of the estimator.
        truth: topic of the estimated quantities; None if the log has none.
    """
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(MAGIC):
        return _of_log(path, label, truth)
    case = truth.name.rpartition("/")[0] if truth else ""
    first = start.decode(errors="replace").lstrip().splitlines()[:1]
    if first and first[0].startswith("time_"):
        stream = _of_table(path, f"/estimates/{label}{case}/state", truth)
    elif truth is None:
        raise BadInput("the program wrote a trajectory, but the log has no truth of the same object")
    else:
        like = empty_stream(truth.name, schemas.TRUTH_STATE, truth.metadata)
        try:
            stream = estimates_of(read_trajectory(path), f"/estimates/{label}{case}/state", like)
        except BadInput as error:
            raise BadInput(
                f"the program wrote neither MCAP nor CSV that begins with time_ns, and the file is not "
                f"a valid trajectory: {error}"
            ) from None
    return {stream.topic: stream}


def _of_log(path: Path, label: str, truth: Topic | None) -> dict[str, Stream]:
    """Read estimates and innovations from a log; in topic names, only the label is replaced."""
    log = open_log(path)
    chosen = [name for name, topic in log.topics.items() if topic.schema_name in KEPT]
    if not any(log.topics[name].schema_name == KEPT[0] for name in chosen):
        raise BadInput(f"the program wrote a log without estimates ({KEPT[0]})")
    found: dict[str, Stream] = {}
    for name, stream in read_streams(log, chosen).items():
        parts = name.strip("/").split("/")
        behind = parts[2:] if parts[0] == "estimates" and len(parts) > 2 else parts[-1:]
        topic = "/".join([f"/estimates/{label}", *behind])
        metadata = {"truth": truth.name, **stream.metadata} if truth else dict(stream.metadata)
        columns = {
            each.name: stream[each.name] for each in stream.schema if each.name != "sensor_time_ns"
        }
        found[topic] = make_stream(
            topic, stream.schema, stream.publish_time_ns, metadata=metadata, **columns
        )
    return found


def _of_table(path: Path, topic: str, truth: Topic | None) -> Stream:
    """Read estimates from a table.

    The columns are `time_ns` (or `time_s`), one for each component, and `cov_A_B` for the covariance of
    components A and B of the tangent space, in either order; missing covariances are zero.
    """
    try:
        table = pd.read_csv(path, skipinitialspace=True)
        numbers = table.astype(float)
    except (ValueError, OSError) as error:
        raise BadInput(f"the program's estimates cannot be read as CSV ({error})") from None
    clock = "time_ns" if "time_ns" in table else "time_s"
    if clock not in table or not len(table):
        raise BadInput("the program's estimates have no rows with time_ns or time_s")
    for name in map(str, table):
        if missing := np.flatnonzero(~np.isfinite(numbers[name])).tolist():
            raise BadInput(
                f"the program's estimates have no number in column {name}, row {missing[0] + 1} "
                f"({len(missing)} in total); write one, or leave out the row"
            )
    whole = table[clock].to_numpy()
    time_ns = whole.astype(np.int64) if clock == "time_ns" else np.rint(whole * 1e9).astype(np.int64)
    names = [name for name in map(str, table) if name != clock and not name.startswith("cov_")]
    components = _components(names, truth)
    tangent = [name for name, _ in tangent_components(names, list(components.values()))]
    covariance = np.zeros((len(table), len(tangent), len(tangent)))
    known = {f"cov_{a}_{b}": (i, j) for i, a in enumerate(tangent) for j, b in enumerate(tangent)}
    for name in (each for each in map(str, table) if each.startswith("cov_")):
        if name not in known:
            raise BadInput(
                f"the program's estimates have a column {name}; expected cov_A_B with A and B of "
                f"{', '.join(tangent)}"
            )
        i, j = known[name]
        covariance[:, i, j] = covariance[:, j, i] = numbers[name]
    stated: Mapping[str, str] = {
        "components": ",".join(components),
        "kinds": ",".join(components.values()),
        "truth": truth.name if truth else "",
    }
    return make_stream(
        topic,
        schemas.GAUSSIAN_ESTIMATE,
        time_ns,
        metadata=stated,
        mean=numbers[names].to_numpy(),
        covariance=covariance.reshape(len(table), -1),
    )


def _components(names: list[str], truth: Topic | None) -> Components:
    """Return components with their kinds in the truth, or all linear without a truth."""
    if truth is None:
        return dict.fromkeys(names, "linear")
    stated = stated_components(truth.metadata, {}, f"topic {truth.name}")
    for name in names:
        if name not in stated:
            raise BadInput(
                f"the program's estimates have a column {name}, which {truth.name} does not have; "
                f"it has {', '.join(stated)}"
            )
    return {name: stated[name] for name in names}


def write_tables(folder: Path, streams: Sequence[Stream]) -> None:
    """Write each topic to a file such as `robot1-odometry.csv`, with `time_ns` and all fields.

    A vector has a column for each number, `position_m_0` and so on. The metadata of the channel is in
    `robot1-odometry.json`.
    """
    folder.mkdir()
    for stream in streams:
        columns = {"time_ns": stream.publish_time_ns}
        for field in stream.schema:
            values = stream[field.name]
            if values.ndim == 1:
                columns[field.name] = values
            else:
                columns |= {f"{field.name}_{place}": column for place, column in enumerate(values.T)}
        name = stream.topic.strip("/").replace("/", "-")
        pd.DataFrame(columns).to_csv(folder / f"{name}.csv", index=False)
        stated = pd.Series(dict(stream.metadata), dtype=object)
        (folder / f"{name}.json").write_text(stated.to_json(), encoding="utf-8")
