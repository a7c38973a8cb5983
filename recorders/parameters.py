"""Typed and bounded parameters of scenarios, estimators and experiments, with clear error messages."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from inspect import cleandoc
from textwrap import shorten
from tomllib import TOMLDecodeError
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PydanticUserError,
    ValidationError,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parsing import DEEPEST, parse_toml
from fuselog.recorders.units import unit_of

_POINTED = re.compile(r"\s*[+-]?(\d+\.|\.\d+)([eE][+-]?\d+)?\s*")  # numbers that TOML rejects


class Parameters(BaseModel):
    """The base class of all parameter types: immutable, without unknown names, NaN or infinity.

    Like given values, defaults are converted to the declared type: `sigma_m: float = 1` is 1.0.

    The meaning of a parameter is in one place: under `Attributes:` in the docstring of its type. Its
    unit is the ending of its name, or is stated in the same place. `describe` returns both.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, defer_build=True
    )

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Build the JSON schema, with the meaning and unit of every parameter."""
        schema = handler(core_schema)
        table = handler.resolve_ref_schema(schema)
        table["description"] = _prose(cls)
        meaning_of, entries = meanings(cls), table.setdefault("properties", {})
        for name, field in cls.model_fields.items():
            entry = entries[field.alias or name]
            entry.setdefault("description", meaning_of.get(name, ""))
            entry.setdefault("unit", unit_of(name))
        return schema


# The role of a number in its estimator: a standard deviation or density of noise, another number whose
# value may be wrong, or a setting of the algorithm, which no log can determine.
Role = Literal["process noise", "measurement noise", "parameter", "setting"]


def has_role(role: Role) -> Any:
    """Return the annotation that gives a number this role, see `Parameter`."""
    return Field(json_schema_extra={"role": role})


ProcessNoise = Annotated[float, Field(ge=0.0), has_role("process noise")]
MeasurementNoise = Annotated[float, Field(ge=0.0), has_role("measurement noise")]
ParametersType = TypeVar("ParametersType", bound=Parameters)


def build(
    kind: type[ParametersType], values: Mapping[str, Any], where: str, what: str = "parameter"
) -> ParametersType:
    """Validate `values` against a parameter type; raise BadInput that names `where` and the parameter.

    `what` is the word for a parameter in messages.
    """
    try:
        return kind.model_validate(merge(_nested_defaults(kind), values))
    except ValidationError as error:
        first = error.errors()[0]
        path = [str(part) for part in first["loc"]]
        name = ".".join(path).removeprefix("of_topics.")
        if first["type"] == "extra_forbidden":
            *above, last = path
            known = _names_at(kind, above)
            raise BadInput(f"{where}: no {what} '{name}'; {choices(last, known)}") from None
        if first["type"] == "missing":
            raise BadInput(f"{where}: {what} '{name}' is missing") from None
        message = first["msg"].removeprefix("Value error, ").replace("Input", "it")
        if not name:
            raise BadInput(f"{where}: {message}") from None
        given = shorten(repr(first["input"]), 60)
        raise BadInput(f"{where}: {what} '{name}' is {given}; {message}") from None
    except PydanticUserError as error:  # types are completed at first use, for a faster start
        why = str(error.message).partition(". ")[0]
        raise BadInput(f"{where}: its parameters, {kind.__name__}, cannot be checked: {why}") from error


@cache
def _nested_defaults(kind: type[Parameters]) -> Mapping[str, Any]:
    """Return the defaults that are tables, so that setting one entry keeps the others."""
    defaults = {name: entry.default for name, entry in kind.model_fields.items()}
    return {
        name: value.model_dump() for name, value in defaults.items() if isinstance(value, Parameters)
    }


def _names_at(kind: type[BaseModel], path: Sequence[str]) -> list[str]:
    """List the parameters in the table at `path`, which may lead through lists and tables by name."""
    names = _annotations(kind)
    for part in path:
        table = _table_in(names.get(part))
        names = _annotations(table) if table else names
    return list(names)


def _annotations(kind: type[BaseModel]) -> dict[str, Any]:
    return {each.alias or name: each.annotation for name, each in kind.model_fields.items()}


def _table_in(annotation: Any) -> type[BaseModel] | None:
    """Return the type of the tables in an annotation such as list[Matcher], or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_table_in, get_args(annotation))), None)


_ATTRIBUTES = re.compile(r"^Attributes:\n(?P<entries>(?: .*(?:\n|$)|\n)*)", re.MULTILINE)
_ENTRY = re.compile(r"^    (?P<names>\w+(?:, \w+)*): (?P<meaning>\S.*(?:\n {5,}\S.*)*)", re.MULTILINE)


MOST_WORDS = 8  # in a name


@cache
def meanings(kind: type[BaseModel]) -> dict[str, str]:
    """Return the meanings of a type's parameters, from its `Attributes:` and those of its bases.

    An entry is `name: meaning`, or `name, name: meaning` if several share a meaning. Raises BadInput if
    an entry names no parameter.
    """
    meaning_of: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        own = base.__doc__ if issubclass(base, Parameters) else None
        section = _ATTRIBUTES.search(cleandoc(own or ""))
        for entry in _ENTRY.finditer(section["entries"]) if section else ():
            for name in entry["names"].split(", "):
                if name not in kind.model_fields:
                    raise BadInput(
                        f"{base.__name__}: its docstring describes a parameter '{name}' that is not "
                        f"defined; {choices(name, kind.model_fields)}"
                    )
                meaning_of[name] = " ".join(entry["meaning"].split())
    return meaning_of


def in_few_words(meaning: str) -> str:
    """Return the first words of a parameter's meaning, or an empty text if they cannot be its name.

    >>> in_few_words("standard deviation of a range, as the sensor states it.")
    'standard deviation of a range'
    >>> in_few_words("a measurement whose NIS is beyond this quantile is not used.")
    ''
    """
    words = re.split("[,.:;]", meaning)[0]
    is_name = not re.search(r"\b(is|are|was|has|have)\b", words) and len(words.split()) <= MOST_WORDS
    return words if is_name else ""


def _prose(kind: type[BaseModel]) -> str:
    """Join the docstrings of a type and its bases, without `Attributes:`."""
    texts = [
        _ATTRIBUTES.sub("", cleandoc(each.__doc__ or "")).strip()
        for each in reversed(kind.__mro__)
        if issubclass(each, Parameters) and each is not Parameters
    ]
    return "\n\n".join(filter(None, dict.fromkeys(texts)))


class Parameter(NamedTuple):
    """A description of one parameter, for people and for code that varies it.

    Attributes:
        name: full name.
        default: default value; the current value while the parameter is varied.
        unit, meaning: empty if the type does not state them.
        accepts: the accepted values, in words.
        role: role of a number in its estimator; empty for anything else.
        low, high: bounds of a number, or of the range in which it is varied.
        is_log: whether the logarithm of the value is varied.
        is_assumed: whether the value comes neither from a setting nor from the log.
        useful: standard error that is sufficient for a calibration; zero if there is none.
        group: title under which it is shown, such as a topic.
    """

    name: str
    default: Any = None
    unit: str = ""
    accepts: str = "number"
    meaning: str = ""
    role: Role | Literal[""] = ""
    low: float = -math.inf
    high: float = math.inf
    is_log: bool = False
    is_assumed: bool = False
    useful: float = 0.0
    group: str = ""

    @property
    def fixed(self) -> "Parameter":
        """Return a copy that is fixed at its value."""
        return self._replace(low=self.default, high=self.default)

    @property
    def is_fixed(self) -> bool:
        """Test whether the parameter is fixed at its value."""
        return self.low == self.high


def describe(kind: type[BaseModel], values: Mapping[str, Any] | None = None) -> list[Parameter]:
    """List all parameters of a type, nested ones by full names; `values` replace defaults.

    In a list of tables, names look like `nodes[].sigma_m`; in tables by name, like `cases.NAME.sigma_m`.
    """
    schema = _schema_of(kind)
    return list(_described(schema, schema.get("$defs", {}), "", values or {}))


@lru_cache(maxsize=256)
def _schema_of(kind: type[BaseModel]) -> Mapping[str, Any]:
    """Return the JSON schema of a type, which callers only read."""
    return kind.model_json_schema()


def explain(kind: type[BaseModel]) -> dict[str, str]:
    """Collect the general descriptions of a type and its nested tables, by location.

    A location is the prefix of the names in a table, such as `range_bearing.`; it is empty for the type
    itself. Tables with the same description share an entry. Inherited text comes first.
    """
    schema = _schema_of(kind)
    places: dict[str, list[str]] = {}
    for place, table in _tables("", schema, schema.get("$defs", {})):
        if description := table.get("description"):
            places.setdefault(description, []).append(place)
    return {", ".join(names): text for text, names in places.items()}


def _tables(
    prefix: str, table: Mapping[str, Any], definitions: Mapping[str, Any]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    yield prefix, table
    for name, entry in table["properties"].items():
        for below in _below(entry, definitions, f"{prefix}{name}"):
            yield from _tables(*below, definitions)


def _described(
    table: Mapping[str, Any], definitions: Mapping[str, Any], prefix: str, given: Mapping[str, Any]
) -> Iterator[Parameter]:
    """Walk a JSON schema; `given` contains the defaults that the enclosing table states for this one."""
    for name, entry in table["properties"].items():
        value = given.get(name, entry.get("default"))
        below = next(_below(entry, definitions, f"{prefix}{name}"), None)
        is_table = below is not None and below[0] == f"{prefix}{name}."
        yield _parameter(f"{prefix}{name}", None if is_table else value, entry, definitions)
        if below is not None:
            values = merge(entry.get("default") or {}, given.get(name) or {}) if is_table else {}
            yield from _described(below[1], definitions, below[0], values)


def _parameter(
    name: str, default: Any, entry: Mapping[str, Any], definitions: Mapping[str, Any]
) -> Parameter:
    """Describe the parameter of one entry of a JSON schema."""
    accepts, meaning = _accepts(entry, definitions), entry.get("description", "")
    found = Parameter(name, default, entry.get("unit", unit_of(name)), accepts, meaning)
    options = [_resolved(each, definitions) for each in entry.get("anyOf", [entry])]
    for each in options:
        if each.get("type") == "number":
            found = found._replace(
                role=each.get("role", entry.get("role", "parameter")),
                low=max(found.low, each.get("exclusiveMinimum", each.get("minimum", -math.inf))),
                high=min(found.high, each.get("exclusiveMaximum", each.get("maximum", math.inf))),
            )
    return found


def _below(
    schema: Mapping[str, Any], definitions: Mapping[str, Any], name: str
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the prefix of names and the schema of each table in a value."""
    schema = _resolved(schema, definitions)
    if "properties" in schema:
        yield f"{name}.", schema
    for option in schema.get("anyOf", []):
        yield from _below(option, definitions, name)
    for key, inside in (("items", f"{name}[]"), (_OTHERS, f"{name}.NAME")):
        if isinstance(schema.get(key), dict):
            yield from _below(schema[key], definitions, inside)


def _resolved(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    return definitions[schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema


def _accepts(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Describe the values that a schema accepts: type and bounds, or choices."""
    schema = _resolved(schema, definitions)
    if "anyOf" in schema:
        return " or ".join(_accepts(each, definitions) for each in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    if "const" in schema:
        return str(schema["const"])
    kind = schema.get("type", "anything").replace("null", "none").replace("object", "table")
    bounds = [f"{sign} {schema[key]:g}" for key, sign in _SIGNS.items() if key in schema]
    inside = schema.get("prefixItems") or [
        each for each in (schema.get("items"), schema.get(_OTHERS)) if isinstance(each, dict)
    ]
    least, most = schema.get("minItems"), schema.get("maxItems")
    if least or most:
        above = f"at least {least}" if most is None else f"{least or 0} to {most}"
        bounds.append(f"({least})" if least == most else f"({above})")
    if inside:
        bounds.append("of " + ", ".join(dict.fromkeys(_accepts(each, definitions) for each in inside)))
    return " ".join([kind, *bounds])


_SIGNS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}


def field_of(key: str) -> str:
    """Return the name of the field for a number; numbers of a topic are set as TOPIC.NAME.

    >>> field_of("/gps2/fix.lever_x_m"), field_of("lever_x_m")
    ('gps2_fix_lever_x_m', 'lever_x_m')
    """
    if not key.startswith("/"):
        return key
    field = re.sub(r"\W", "_", key).strip("_")
    return f"n{field}" if field[:1].isdigit() else field


def numbers_of(kind: type[Parameters]) -> dict[str, Parameter]:
    """Describe the numbers of a type by name, without those in nested tables.

    >>> class Own(Parameters):
    ...     drift_density: ProcessNoise | None = None
    ...     lever_m: float = 0.0
    ...     label: str = ""
    >>> {name: (each.role, each.low) for name, each in numbers_of(Own).items()}
    {'drift_density': ('process noise', 0.0), 'lever_m': ('parameter', -inf)}
    """
    return {each.name: each for each in describe(kind) if each.role and "." not in each.name}


def number_of(kind: type[BaseModel], name: str) -> Parameter:
    """Describe one number of a type by its full name; `NAME` in it may replace the name of a table.

    Raises BadInput if the type has no number of this name.
    """
    schema = _schema_of(kind)
    tables: list[Mapping[str, Any]] = [schema]
    entries, known = list[Mapping[str, Any]](), set[str]()
    parts = [field_of(name)] if field_of(name) in schema.get("properties", {}) else name.split(".")
    for part in parts:
        known = {each for table in tables for each in table.get("properties", {})}
        entries = [
            table["properties"][part] if part in table.get("properties", {}) else table[_OTHERS]
            for table in tables
            if part in table.get("properties", {}) or isinstance(table.get(_OTHERS), dict)
        ]
        tables = [
            _resolved(option, schema.get("$defs", {}))
            for entry in entries
            for option in entry.get("anyOf", [entry])
        ]
    if not entries:
        raise BadInput(f"no parameter '{name}'; {choices(name.rpartition('.')[2], sorted(known))}")
    found = _parameter(name, None, {**entries[0], "anyOf": tables}, schema.get("$defs", {}))
    if not found.role:
        raise BadInput(f"parameter '{name}' is not a number, so it cannot be varied")
    return found


_OTHERS = "additionalProperties"  # the key of JSON schemas for tables with user-defined names


def nested(name: str, value: Any) -> dict[str, Any]:
    """Build the nested tables that contain a value of this full name.

    >>> nested("range.rate_hz", 5.0)
    {'range': {'rate_hz': 5.0}}
    """
    first, _, rest = name.partition(".")
    return {first: nested(rest, value) if rest else value}


def flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables with their full names.

    >>> dict(flat({"seed": 1, "range": {"rate_hz": 5.0}}))
    {'seed': 1, 'range.rate_hz': 5.0}
    """
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}.{key}", inner) for key, inner in flat(value))
        else:
            yield name, value


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Parse `--set` options such as `sensor.rate_hz=5` into nested values; the right side is TOML.

    A right side that is not a TOML value is read as text. A key that begins with a slash (the name of a
    topic) is not split. Raises BadInput if there is no `=`.

    >>> parse_settings(["duration_s=30", "range.rate_hz=.5", "name=walk", "/fix.delay_s=.3"])
    {'duration_s': 30, 'range': {'rate_hz': 0.5}, 'name': 'walk', '/fix.delay_s': 0.3}
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        parts = [key.strip()] if key.strip().startswith("/") else key.strip().split(".")
        if not equals or not all(parts):
            raise BadInput(f"--set {setting}: expected key=value, such as duration_s=30")
        if len(parts) > DEEPEST:
            raise BadInput(
                f"--set {key[:40]}...: has more than {DEEPEST} levels of nested names; give fewer"
            )
        try:
            value = parse_toml(f"value = {text}")["value"]
        except TOMLDecodeError:
            value = float(text) if _POINTED.fullmatch(text) else text
        except ValueError as error:
            raise BadInput(f"--set {key}: the value cannot be used: {error}") from None
        target = values
        for part in parts[:-1]:
            target = target.setdefault(part, {})
            if not isinstance(target, dict):
                raise BadInput(
                    f"--set {setting}: '{part}' already has a value; remove one of the two settings"
                )
        target[parts[-1]] = value
    return values


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the values of `over` into a copy of `base`, including nested tables.

    >>> merge({"seed": 1, "range": {"rate_hz": 5.0, "sigma_m": 0.1}}, {"range": {"rate_hz": 2.0}})
    {'seed': 1, 'range': {'rate_hz': 2.0, 'sigma_m': 0.1}}
    """
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged
