"""Support for public names of the previous release, with warnings that state the new names."""

import warnings
from collections.abc import Callable
from functools import wraps
from operator import attrgetter
from typing import Any, TypeVar

# A function or a class with any arguments.
Taking = Callable[..., Any]  # type: ignore[explicit-any]
Target = TypeVar("Target", bound=Taking)


def renamed(**names: str) -> Callable[[Target], Target]:
    """Make a function or a dataclass also accept arguments under their old names, with a FutureWarning.

    Args:
        names: the new name of each argument, by the old one. The fields of a dataclass can be read
            under their old names as well.

    >>> @renamed(length="length_m")
    ... def area(length_m):
    ...     return length_m**2
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     area(length=2.0)
    4.0
    >>> print(caught[0].message)
    area: 'length' was renamed to 'length_m'; the old name will be removed in the next release
    """

    def accepting(function: Taking, owner: str) -> Taking:
        @wraps(function)
        def call(*arguments: object, **given: object) -> object:
            for old in names.keys() & given.keys():
                notice = (
                    f"'{old}' was renamed to '{names[old]}'; the old name will be removed in the next "
                    "release"
                )
                warnings.warn(f"{owner}: {notice}", FutureWarning, stacklevel=2)
                given[names[old]] = given.pop(old)
            return function(*arguments, **given)

        return call

    def mark(target: Target) -> Target:
        marked: Any = target  # type: ignore[explicit-any]  # whose __init__ is replaced
        if not isinstance(target, type):
            return accepting(target, target.__name__)  # type: ignore[return-value]
        marked.__init__ = accepting(marked.__init__, target.__name__)
        for old, new in names.items():
            setattr(marked, old, property(attrgetter(new)))
        return target

    return mark
