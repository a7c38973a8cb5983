"""What holds where nobody says otherwise: defaults of parameters, options and mappings."""

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from recorders.parameters import Parameters

ROOT = Path(__file__).parents[3]
PACKAGES = ("pipeline", "recorders", "replay")
_DECLARES = re.compile(r"^class \w+\(.*(Parameters|Mapping|Options)\b", re.MULTILINE)


def in_words() -> Iterator[str]:
    """Of every class of parameters its own fields, each with its default if it has one."""
    for file in sorted(file for each in PACKAGES for file in (ROOT / each).rglob("*.py")):
        if _DECLARES.search(file.read_text(encoding="utf-8")):
            module = file.relative_to(ROOT).with_suffix("").parts
            import_module(".".join(module).removesuffix(".__init__"))
    written = (each for each in _below(Parameters) if _is_written(each))
    found = {f"{each.__module__}.{each.__qualname__}": each for each in written}
    for name, kind in sorted(found.items()):
        yield f"# {name}"
        for field in kind.__annotations__:
            if field in kind.model_fields:
                own = kind.model_fields[field]
                yield f"{field}" if own.is_required() else f"{field}: {_told(own.default)}"
        yield ""


def _is_written(kind: type[Parameters]) -> bool:
    """Whether a class of ours stands in its module; others are made of it by the same name."""
    if kind.__module__.partition(".")[0] not in PACKAGES:
        return False
    return getattr(import_module(kind.__module__), kind.__qualname__, None) is kind


def _below(kind: type[Parameters]) -> Iterator[type[Parameters]]:
    for each in kind.__subclasses__():
        yield each
        yield from _below(each)


def _told(value: Any) -> str:
    """A default as it is written, numbers to all digits."""
    if isinstance(value, Parameters):
        stated = (f"{name}={_told(getattr(value, name))}" for name in sorted(value.model_fields_set))
        return f"{type(value).__name__}({', '.join(stated)})"
    return repr(value) if isinstance(value, str) else str(value)
