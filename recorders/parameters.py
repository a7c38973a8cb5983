"""Parameters of scenarios, estimators and experiments: typed, bounded, and refused with one sentence."""

import tomllib
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from recorders.errors import BadInput


class Parameters(BaseModel):
    """Base of all parameter types: immutable, no unknown names, no NaN and no infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


ParametersType = TypeVar("ParametersType", bound=Parameters)


def build(kind: type[ParametersType], values: Mapping[str, Any], where: str) -> ParametersType:
    """Check `values` against a parameter type; raises BadInput that names `where` and the parameter."""
    try:
        return kind.model_validate(merge(_nested_defaults(kind), values))
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            model = _model_at(kind, first["loc"][:-1])
            names = ", ".join(model.model_fields) if model else "no parameters"
            raise BadInput(f"{where}: no parameter '{name}'; there are: {names}") from None
        raise BadInput(
            f"{where}: parameter '{name}' is {first['input']!r}; {_mend(first['msg'])}"
        ) from None


def _nested_defaults(kind: type[Parameters]) -> dict[str, Any]:
    """Defaults that are tables of their own, so that a setting of one entry keeps the others."""
    defaults = {name: entry.default for name, entry in kind.model_fields.items()}
    return {
        name: value.model_dump() for name, value in defaults.items() if isinstance(value, Parameters)
    }


def _mend(message: str) -> str:
    return message[:1].lower() + message[1:]


def _model_at(kind: type[BaseModel], path: tuple[int | str, ...]) -> type[BaseModel] | None:
    for part in path:
        entry = kind.model_fields.get(str(part))
        if entry is None or not isinstance(entry.annotation, type):
            return None
        kind = entry.annotation
    return kind


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Turn `--set` options such as `sensor.rate_hz=5` into nested values; the right side is TOML.

    A right side that is no TOML value is taken as text. Raises BadInput where there is no `=`.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        parts = key.strip().split(".")
        if not equals or not all(parts):
            raise BadInput(f"--set {setting}: expected key=value, such as duration_s=30")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        target = values
        for part in parts[:-1]:
            target = target.setdefault(part, {})
            if not isinstance(target, dict):
                raise BadInput(f"--set {setting}: '{part}' was already given a value of its own")
        target[parts[-1]] = value
    return values


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, nested tables merged."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged
