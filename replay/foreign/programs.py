"""Estimators made from programs that answer messages, or that read a log and write estimates."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import Field, create_model

from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import RunMetadata, Stream, Topic, open_log, read_streams, schemas, write_log
from fuselog.recorders.log.streams import empty_stream, make_stream
from fuselog.recorders.parameters import build
from fuselog.recorders.trajectories import read_trajectory
from fuselog.replay.engine.replaying.estimator import Batch, Bound, Estimator, Recursive
from fuselog.replay.engine.replaying.truth import TRUTH, truths_among
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.results import failures_by_run
from fuselog.replay.engine.vectors.components import Components, stated_components
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.foreign.description import (
    Description,
    ProgramParameters,
    StreamParameters,
)
from fuselog.replay.foreign.filters import bind_all, bind_apart, unspecified
from fuselog.replay.foreign.naming import split_command, what_runs
from fuselog.replay.foreign.processes.isolation import Ended, Limits, Program, Ran, in_threads, state_of
from fuselog.replay.foreign.processes.streaming import describe_stream, follow_runs_streaming
from fuselog.replay.foreign.processes.tasks import RunGiven
from fuselog.replay.judging.errors.trajectory_streams import estimates_of

_PLACE = re.compile(r"\{(\w+)(?:=([^{}]*))?\}")
LOG, TABLES, OUT = "log", "csv", "out"
ESTIMATE = "/estimates/"
LIMITS = ("time_limit_s", "memory_limit_mb")  # these limits also apply while a program starts

MAGIC = b"\x89MCAP0"
KEPT = (schemas.GAUSSIAN_ESTIMATE.full_name, schemas.INNOVATION.full_name)


@dataclass(frozen=True)
class _OfPrograms(Estimator[Any]):
    """Placeholder for estimators of programs; the settings name the command."""

    def specified(self, label: str, settings: Mapping[str, Any]) -> Estimator[Any]:
        """Return the estimator of the command in `settings`; a command with {out} in it reads a log."""
        words = tuple(split_command(what_runs(label, "exec", settings)))
        if any("{" + OUT + "}" in word for word in words):
            return _of_files(label, words)
        for word in words:
            if _PLACE.search(word):
                raise BadInput(
                    f"estimator {label}: {word}: a program that streams has no placeholders; give "
                    "{log} and {out} to a program that reads a log"
                )
        own = {name: settings[name] for name in LIMITS if name in settings}
        limits = Limits.of(build(StreamParameters, own, f"estimator {label}"))
        return _of_stream(words, limits)


EXEC = _OfPrograms(
    "your own program: -e 'exec:./run_filter {log} {out}', or one that streams",
    "the topics that the program's description names",
    StreamParameters,
    unspecified,
)


# --- programs that stream ---------------------------------------------------------------------------


def _of_stream(words: tuple[str, ...], limits: Limits) -> Estimator[Any]:
    description = _described(words, tuple(map(state_of, words)), limits)

    def follow_runs(runs: Sequence[RunGiven | None], limits: Limits) -> list[Ran | None]:
        return follow_runs_streaming(words, runs, description, limits)

    def bind(label: str, topics: Mapping[str, Topic], parameters: Any) -> list[Bound]:
        found = bind_all(label, description, topics, parameters)
        bound = [bind_apart(each, follow_runs) for each in found]
        return [replace(each, out_of_sequence=partial(_cannot_go_back, label)) for each in bound]

    parameters = description.parameters_over(StreamParameters)
    return Estimator(description.summary, description.requirements, parameters, bind)


def _cannot_go_back(label: str, window_ns: int) -> Recursive:  # noqa: ARG001
    """Raise BadInput because programs cannot reprocess messages."""
    raise BadInput(
        f"estimator {label}: --late rewind: a program cannot be copied, unlike a filter of a library "
        "(lib:); give --late drop or --late wait:SECONDS"
    )


@lru_cache(maxsize=64)
def _described(
    words: tuple[str, ...],
    state: tuple[tuple[int, int], ...],  # noqa: ARG001
    limits: Limits,
) -> Description:
    return describe_stream(words, f"exec:{words[0]}", limits)


# --- programs that read a log -----------------------------------------------------------------------


def _of_files(label: str, words: tuple[str, ...]) -> Estimator[Any]:
    defaults = _parameters_in(label, words)
    fields: dict[str, Any] = {
        name: (float, Field(value, description="parameter of the program's command"))
        for name, value in defaults.items()
    }
    parameters = create_model(
        "ProgramParameters", __base__=ProgramParameters, __doc__=ProgramParameters.__doc__, **fields
    )

    def bind(label: str, topics: Mapping[str, Topic], values: Any) -> list[Bound]:
        truth, truths = _truth(label, topics, values.truth), truths_among(topics)
        read = [
            name
            for name, topic in topics.items()
            if name not in truths and not name.startswith(ESTIMATE) and topic.encoding == "protobuf"
        ]
        static = [name for name in read if name.endswith("/prior") or _is_map(topics[name])]
        streams = [name for name in read if name not in static]
        if not streams:
            return []

        def solve(given: dict[str, Ragged]) -> list[Ragged]:
            return _solve(label, words, defaults, values, truth, given)

        of = "" if truth is None else truth.name
        return [Batch(label, tuple(streams), tuple(static), solve, parameters=values, truth=of)]

    return Estimator(f"the program {words[0]}", "messages", parameters, bind)


def _parameters_in(label: str, words: Sequence[str]) -> dict[str, float]:
    """Return the parameters declared by placeholders such as {sigma_m=0.1}, with their defaults."""
    found: dict[str, float] = {}
    for name, default in (place for word in words for place in _PLACE.findall(word)):
        if name in (LOG, TABLES, OUT) and not default:
            continue
        try:
            found[name] = float(default)
        except ValueError:
            raise BadInput(
                f"estimator {label}: {{{name}}} in its command is not a placeholder; give "
                f"{{log}}, {{csv}}, {{out}}, or a parameter with its default, {{{name}=0.1}}"
            ) from None
        if name in ProgramParameters.model_fields:
            raise BadInput(
                f"estimator {label}: {{{name}}} in its command has a reserved name; choose another"
            )
    return found


def _is_map(topic: Topic) -> bool:
    return topic.schema_name in (schemas.LANDMARK.full_name, schemas.BODY_POINT.full_name)


def _truth(label: str, topics: Mapping[str, Topic], named: str) -> Topic | None:
    """Return the truth of the estimates; raise BadInput if it is ambiguous."""
    truths = {
        name: topic
        for name, topic in topics.items()
        if topic.schema_name == TRUTH and not name.startswith(ESTIMATE)
    }
    if named and named not in truths:
        raise BadInput(
            f"estimator {label}: truth = {named}: the log has no such truth; {choices(named, truths)}"
        )
    if not named and len(truths) > 1:
        raise BadInput(
            f"estimator {label}: the log has the truths {', '.join(truths)}; choose one with "
            f"--set {label}.truth=..."
        )
    return truths[named] if named else next(iter(truths.values()), None)


def _solve(
    label: str,
    words: Sequence[str],
    defaults: Mapping[str, float],
    values: Any,
    truth: Topic | None,
    given: Mapping[str, Ragged],
) -> list[Ragged]:
    """Run the program for every run, several in parallel, and join the estimates."""
    runs = next(iter(given.values())).runs
    started: list[Program] = []

    def one(run: int) -> dict[str, Stream] | Failure:
        streams = [ragged.of_run(run) for ragged in given.values()]
        numbers = {name: getattr(values, name) for name in defaults}
        stamps = [int(each.publish_time_ns.max()) for each in streams if len(each)]
        if not stamps:
            return {}
        try:
            return _run(label, words, numbers, Limits.of(values), truth, streams, started)
        except (Ended, BadInput) as error:
            return Failure(max(stamps), str(error))

    made = in_threads(one, range(runs), started)
    failures = {run: each for run, each in enumerate(made) if isinstance(each, Failure)}
    if len(failures) == runs == 1:
        raise BadInput(f"estimator {label}: {failures[0].reason}")
    written = [{} if isinstance(each, Failure) else each for each in made]
    nothing = {topic: stream.take(slice(0, 0)) for each in written for topic, stream in each.items()}
    return [
        failures_by_run(f"/estimates/{label}", failures, runs),
        *(gather([each.get(topic, empty) for each in written]) for topic, empty in nothing.items()),
    ]


def _run(
    label: str,
    words: Sequence[str],
    numbers: Mapping[str, float],
    limits: Limits,
    truth: Topic | None,
    streams: Sequence[Stream],
    started: list[Program],
) -> dict[str, Stream]:
    """Run the program for one run; raise Ended if it fails, BadInput if its file is invalid."""
    with scratch_folder("fuselog-program") as folder:
        places = {LOG: folder / "log.mcap", TABLES: folder / "csv", OUT: folder / "estimates"}
        command = " ".join(words)
        if "{" + LOG + "}" in command:
            write_log(places[LOG], streams, RunMetadata("replayed", epoch_ns=_first_ns(streams)))
        if "{" + TABLES + "}" in command:
            write_tables(places[TABLES], streams)
        filled: Mapping[str, Any] = {**places, **numbers}
        program = Program([_PLACE.sub(lambda place: str(filled[place[1]]), word) for word in words])
        started.append(program)
        program.wait(limits)
        found = sorted(folder.glob("estimates*"))
        if not found:
            raise Ended("the program wrote no estimates: there is no file at {out}")
        return read_estimates(found[0], label, truth)


def _first_ns(streams: Sequence[Stream]) -> int:
    return int(np.min([each.publish_time_ns.min() for each in streams if len(each)]))


def read_estimates(path: Path, label: str, truth: Topic | None) -> dict[str, Stream]:
    """Read the estimates in a file, by topic, and set their label; raise BadInput if the file has none.

    Args:
        path: the file.
        label: label of the estimator.
        truth: topic of the true values of the estimated quantities; None if the log has no such topic.
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
                f"({len(missing)} such rows in total); write a number, or leave out the row"
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
    """Return components with the kinds given by the truth; without a truth, all kinds are linear."""
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
