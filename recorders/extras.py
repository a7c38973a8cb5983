"""Imports of optional dependencies at first use; if a package is missing, the error names its extra."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

from fuselog.recorders.errors import BadInput


@contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Guard imports of an extra's packages; raise BadInput if one of them is not installed.

    Args:
        name: the extra in pyproject.toml, such as "papers".
        what: the feature that needs the package, as the message names it, such as "the BROAD benchmark".
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        raise BadInput(
            f"{what}: needs {missing}, which is not installed; run: pip install 'fuselog[{name}]'"
        ) from None


class AtFirstUse(ModuleType):
    """A module of an extra that is imported when one of its attributes is first accessed."""

    def __init__(self, module: str, name: str, what: str) -> None:
        super().__init__(module)
        self._extra = name, what

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        with extra(*self._extra):
            return getattr(import_module(self.__name__), attribute)
