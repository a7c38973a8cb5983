"""Estimators made from programs that answer messages, or that read a log and write estimates."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field, create_model

from fuselog.recorders.atomic import scratch_folder
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import RunMetadata, Stream, Topic, schemas, write_log
from fuselog.recorders.parameters import build, has_role
from fuselog.replay.engine.replaying.estimator import Batch, Bound, Estimator, Recursive
from fuselog.replay.engine.replaying.truth import TRUTH, truths_among
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.failures import Failure
from fuselog.replay.engine.streams.results import failures_by_run
from fuselog.replay.foreign.description import Description, ForeignParameters
from fuselog.replay.foreign.files.estimates import read_estimates, write_tables
from fuselog.replay.foreign.filters import bind_all, bind_apart, unspecified
from fuselog.replay.foreign.naming import split_command, what_runs
from fuselog.replay.foreign.processes.isolation import Ended, Limits, Program, Ran, in_threads, state_of
from fuselog.replay.foreign.processes.streaming import describe_stream, follow_runs_streaming
from fuselog.replay.foreign.processes.tasks import RunGiven

_PLACE = re.compile(r"\{(\w+)(?:=([^{}]*))?\}")
LOG, TABLES, OUT = "log", "csv", "out"
ESTIMATE = "/estimates/"
LIMITS = ("time_limit_s", "memory_limit_mb")  # these limits also apply while a program starts


class StreamParameters(ForeignParameters):
    """Settings of a program that answers messages.

    Attributes:
        command: the command to start, with its arguments.
    """

    command: str = ""


class ProgramParameters(StreamParameters):
    """Settings of a program that reads a log and writes estimates.

    Attributes:
        time_limit_s: limit of the time for one run; a run that exceeds it fails.
        truth: topic of the truth; by default, the only truth in the log.
    """

    time_limit_s: Annotated[float, Field(gt=0), has_role("setting")] = 600.0
    truth: str = ""


@dataclass(frozen=True)
class _OfPrograms(Estimator[Any]):
    """Placeholder for estimators of programs; the settings name the command."""

    def specified(self, label: str, settings: Mapping[str, Any]) -> Estimator[Any]:
        """Return the estimator for the command in `settings`; a command with {out} reads a log."""
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
