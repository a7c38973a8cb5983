"""Names of the report's sections, and text colours for the names of estimators.

A section is named after its experiment and the settings in which it differs from the others. The colour
of a curve is made dark or light enough for text.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from fuselog.pipeline.output.charts import COLOURS
from fuselog.pipeline.output.results import Result
from fuselog.pipeline.output.terminal import format_value
from fuselog.pipeline.output.words import count, listed

# Background colours behind names; the first of each tuple is that of the page.
LIGHT, DARK = ("#ffffff", "#fdf1f5"), ("#14171a", "#2a1a20")
READABLE = 4.6  # WCAG 2.2, 1.4.3 asks for 4.5 to 1


def distinct_names(results: Sequence[Result], folders: Sequence[Path]) -> list[str]:
    """Name each result after its experiment and the settings that differ from its other results.

    Results with the same experiment and settings are distinguished by their folders.
    """
    names = [
        _name(result, [each for each in results if each.experiment == result.experiment])
        for result in results
    ]
    return [
        f"{name} ({folder})" if names.count(name) > 1 else name
        for name, folder in zip(names, folders, strict=True)
    ]


def _name(result: Result, alike: Sequence[Result]) -> str:
    settings = [dict(_flat(each.settings)) for each in alike]
    own = dict(_flat(result.settings))
    # an estimator's settings are already among its parameters
    given = {key[1:] for each in settings for key in each if key[0] == "estimators"}
    keys = dict.fromkeys(
        key
        for each in settings
        for key in each
        if key not in (("title",), ("candidates",)) and not (key[0] == "parameters" and key[1:] in given)
    )
    differing = [key for key in keys if any(each.get(key) != own.get(key) for each in settings)]
    lasts = [key[-1] for key in differing]
    differences = [
        f"{key[-1] if lasts.count(key[-1]) == 1 else '.'.join(key)} "
        + (format_value(own[key]) if key in own else "default")
        for key in differing
    ]
    return ": ".join(filter(None, [result.experiment, ", ".join(differences)]))


def _flat(
    values: Mapping[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all nested settings, with the names that lead to each."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, (*path, name))
        else:
            yield (*path, name), value


def title_of(result: Result, labels: Sequence[str], runs: int) -> str:
    """Write the heading of a result: the experiment's title, or the command and the logs."""
    settings = result.settings
    title = str(settings.get("title") or result.experiment)
    if result.made_by == "compare":
        return f"{listed(list(labels))}, compared"
    if isinstance(settings.get("logs"), Mapping):
        title = f"{title}: {listed(list(labels)) or count(runs, 'run')}"
    return f"{title}, parameter sweep" if result.made_by == "sweep" else title


def luminance(colour: str) -> float:
    """Compute the relative luminance of a colour such as `#2f7fd1`, from 0 to 1 (WCAG 2.2)."""
    channels = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    linear = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Compute the contrast ratio of two colours, from 1 to 21."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def readable(colour: str, grounds: tuple[str, ...], towards: int) -> str:
    """Mix the colour with black (0) or white (255) until it is readable on all backgrounds."""
    channels = [int(colour[place : place + 2], 16) for place in (1, 3, 5)]
    for share in range(0, 101, 2):
        mixed = [round(each + (towards - each) * share / 100) for each in channels]
        text = "#" + "".join(f"{each:02x}" for each in mixed)
        if all(contrast(text, ground) >= READABLE for ground in grounds):
            return text
    raise AssertionError("black or white is readable on any background")


@cache
def text_colours() -> list[tuple[str, str]]:
    """Return, for each curve colour, text colours for the light and the dark page."""
    return [(readable(each, LIGHT, 0), readable(each, DARK, 255)) for each in COLOURS]
