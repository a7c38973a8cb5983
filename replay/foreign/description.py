"""Description of a foreign filter in JSON: its topics, its state, its parameters."""

import re
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, create_model, field_validator

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic
from fuselog.recorders.parameters import Parameters, Role, build, has_role
from fuselog.recorders.parsing import parse_json
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.streams.channels import resolved
from fuselog.replay.engine.vectors.tangent import Kind, are_kinds, tangent_components

MOST_COMPONENTS = 1000  # components of a state; the covariance then has a million numbers


class ForeignParameters(Parameters):
    """Settings of a foreign filter; the parameters in its description are added to them.

    Attributes:
        time_limit_s: time limit for one message; a run that exceeds it fails.
        memory_limit_mb: memory limit for the filter's process; a run that exceeds it fails.
        every_s: interval of additional estimates, which are made at multiples of this time.
        seed: seed of the filter's random numbers.
    """

    time_limit_s: Annotated[float, Field(gt=0), has_role("setting")] = 10.0
    memory_limit_mb: Annotated[float, Field(gt=0), has_role("setting")] = 2000.0
    every_s: Annotated[float, Field(gt=0), has_role("setting")] | None = None
    seed: Annotated[int, Field(ge=0, lt=1 << 64)] = 0


class StreamParameters(ForeignParameters):
    """Settings of a program that answers messages.

    Attributes:
        command: the command to start, with its arguments.
    """

    command: str = ""


class ProgramParameters(StreamParameters):
    """Settings of a program that reads a log and writes estimates.

    Attributes:
        time_limit_s: time limit for one run; a run that exceeds it fails.
        truth: topic of the truth; by default, the only truth in the log.
    """

    time_limit_s: Annotated[float, Field(gt=0), has_role("setting")] = 600.0
    truth: str = ""


class _Part(BaseModel):
    """Part of a description; unknown names, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class TopicRead(_Part):
    """Topic that a filter reads.

    Attributes:
        topic: name of the topic; a name without a leading slash is looked for under every prefix.
        fields: fields that the filter reads, in this order; `position_m[2]` is a vector of two numbers.
        message: schema of its messages, such as `fuselog.RangeBearing`; "" for any schema.
        static: whether all messages of the topic are passed to the filter before it starts, as for a
            map.
        optional: whether the filter also runs on logs without the topic.
        estimates: whether the filter is asked for an estimate after each message of the topic.
        target: field with the identifier of the measured target.
    """

    topic: str = Field(min_length=1)
    fields: tuple[str, ...]
    message: str = ""
    static: bool = False
    optional: bool = False
    estimates: bool = True
    target: str = ""

    @field_validator("fields")
    @classmethod
    def _are_fields(cls, fields: tuple[str, ...]) -> tuple[str, ...]:
        for field in fields:
            name, bracket, size = field.partition("[")
            if not name or (bracket and not (size.endswith("]") and size[:-1].isdecimal())):
                raise ValueError(f"'{field}' is not a field; give its name, or name[SIZE] for a vector")
        return fields

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Return the length of each vector field, and 0 for a field that is one number."""
        parts = (field.partition("[") for field in self.fields)
        return {name: int(size[:-1]) if size else 0 for name, _, size in parts}

    @property
    def width(self) -> int:
        """Return the number of values in a message."""
        return sum(size or 1 for size in self.sizes.values())


class ParameterRead(_Part):
    """Parameter: default (None if the log's channels state it), bounds, unit and meaning."""

    default: float | None = None
    unit: str = ""
    meaning: str = ""
    role: Role = "parameter"
    minimum: float | None = None
    maximum: float | None = None
    exclusiveMinimum: float | None = None  # noqa: N815
    exclusiveMaximum: float | None = None  # noqa: N815


class Description(_Part):
    """Description of a foreign filter.

    Attributes:
        summary: one-line description.
        topics: topics that it reads.
        state: components of the state by name, with their kinds.
        innovation: components of its innovations; empty if it has none.
        parameters: parameters by name.
        prior: topic of the prior; "" if the filter starts without a prior.
        truth: topic of the truth.
        output: last part of the name of its topic of estimates.
        failures: descriptions of failures: if a function of the filter returns n, the n-th description
            applies.
        digest: for a filter written by `fuselog deploy`, the digest of its graphs and numbers.
        protocol: for a streaming program, its version of the protocol.
    """

    summary: str
    topics: tuple[TopicRead, ...] = Field(min_length=1)
    state: dict[str, Kind] = Field(min_length=1, max_length=MOST_COMPONENTS)
    innovation: dict[str, Kind] = {}
    parameters: dict[str, ParameterRead] = {}
    prior: str = ""
    truth: str = ""
    output: str = Field("state", pattern=r"^\w+$")
    failures: tuple[str, ...] = ()
    digest: str = ""
    protocol: int = 1

    @cached_property
    def tangent(self) -> int:
        """Return the number of components of the tangent space."""
        return len(tangent_components(list(self.state), list(self.state.values())))

    @cached_property
    def width(self) -> int:
        """Return the number of values in the widest message."""
        return max(each.width for each in self.topics)

    def bindings(self, topics: Mapping[str, Topic]) -> Iterator[tuple[str, dict[str, Topic]]]:
        """Yield each prefix under which a log has all topics, and the topics found there, by name."""
        own = [each.topic for each in self.topics if not each.topic.startswith("/")]
        prefixes = dict.fromkeys(
            name.removesuffix(f"/{topic}")
            for topic in own
            for name in topics
            if name.endswith(f"/{topic}") and not name.startswith("/estimates/")
        )
        for prefix in prefixes if own else [""]:
            found = {
                each.topic: topics[name]
                for each in self.topics
                if (name := resolved(each.topic, prefix)) in topics
                and each.message in ("", topics[name].schema_name)
            }
            if all(each.optional or each.topic in found for each in self.topics) and any(
                not each.static for each in self.topics if each.topic in found
            ):
                yield prefix, found

    @property
    def requirements(self) -> str:
        """Describe what a log must contain."""
        return ", ".join(
            resolved(each.topic, "...")
            + (f" ({each.message})" if each.message else "")
            + (" (optional)" if each.optional else "")
            for each in self.topics
        )

    def parameters_over(self, base: type[Parameters]) -> type[Any]:
        """Make the type of all parameters: the settings in `base`, and the parameters of the filter."""
        fields: dict[str, Any] = {}
        for name, each in self.parameters.items():
            bounds = {
                "ge": each.minimum,
                "le": each.maximum,
                "gt": each.exclusiveMinimum,
                "lt": each.exclusiveMaximum,
            }
            stated: dict[str, Any] = {key: value for key, value in bounds.items() if value is not None}
            kind: Any = Annotated[float, Field(**stated)] if stated else float
            kind = kind | None if each.default is None else kind
            told: dict[str, Any] = {"role": each.role, "unit": each.unit or unit_of(name)}
            field = Field(each.default, description=each.meaning, json_schema_extra=told)
            fields[name] = (kind, field)
        return create_model("FilterParameters", __base__=base, __doc__=base.__doc__, **fields)


def read_description(text: str | bytes, where: str) -> Description:
    """Read a description; raise BadInput if it is invalid or inconsistent.

    Args:
        text: JSON.
        where: name of the filter in messages.
    """
    try:
        found = parse_json(text.decode() if isinstance(text, bytes) else text)
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{where}: its description is not valid JSON ({error}); correct it") from None
    if not isinstance(found, dict):
        raise BadInput(
            f"{where}: its description is not a JSON object; give {{...}} with topics and state"
        )
    made = build(_Described, {"description": found}, where, "entry").description
    names = [each.topic for each in made.topics]
    for name in names:
        if names.count(name) > 1:
            raise BadInput(
                f"{where}: its description has topic {name} twice; give all fields in one entry"
            )
    for each in made.topics:
        if each.target and each.target not in each.sizes:
            raise BadInput(
                f"{where}: topic {each.topic}: its target {each.target} is not one of its fields; add it"
            )
    for name in made.parameters:
        if not name.isidentifier() or name in ForeignParameters.model_fields or name in _TAKEN:
            raise BadInput(
                f"{where}: its parameter '{name}' has a name that is reserved or invalid; choose another"
            )
    for components in (made.state, made.innovation):
        for name in components:
            if not re.fullmatch(r"\w+", name):
                raise BadInput(
                    f"{where}: '{name}' is not a valid component name; use letters, digits and '_'"
                )
        if not are_kinds(list(components.values())):
            raise BadInput(
                f"{where}: the components {', '.join(components)} do not fit their kinds: an axis needs "
                "two adjacent components, a quaternion four"
            )
    build(made.parameters_over(ForeignParameters), {}, f"{where}, its defaults")
    return made


_TAKEN = {"kind", "path", "command", "in_process", "topics", "truth", "model_config"}


class _Described(Parameters):
    """Answer of a program that is asked to describe itself."""

    description: Description
