"""Imports packages of an extra when they are first used, or says in one sentence how to install them."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

from fuselog.recorders.errors import BadInput


@contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Guard imports of an extra's packages; raises BadInput where one of them is not installed.

    Args:
        name: of the extra in pyproject.toml, such as "papers".
        what: the user asked for, as the sentence names it: "the BROAD benchmark".
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        raise BadInput(
            f"{what}: needs {missing}, which is not installed; pip install 'fuselog[{name}]'"
        ) from None


class AtFirstUse(ModuleType):
    """Represents a module of an extra, imported when its first attribute is asked for."""

    def __init__(self, module: str, name: str, what: str) -> None:
        super().__init__(module)
        self._extra = name, what

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        with extra(*self._extra):
            return getattr(import_module(self.__name__), attribute)
