"""Names the report's sections: the experiment, and what is different in its settings."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.output.results import Result
from pipeline.output.terminal import format_value
from pipeline.output.words import count, listed


def distinct_names(results: Sequence[Result], folders: Sequence[Path]) -> list[str]:
    """A name for each result: its experiment, and where several are of one, the settings that differ.

    Results of one experiment with the same settings are told apart by their folders.
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
    keys = dict.fromkeys(key for each in settings for key in each if key != ("title",))
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
    """All settings by the names that lead to them."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, (*path, name))
        else:
            yield (*path, name), value


def title_of(result: Result, labels: Sequence[str], runs: int) -> str:
    """What a person reads as a heading: the experiment's title, or what was done with whose logs."""
    settings = result.settings
    title = str(settings.get("title") or result.experiment)
    if "sides" in settings:
        return f"{listed(list(labels))}, compared"
    if isinstance(settings.get("logs"), Mapping):
        return f"{title}: {listed(list(labels)) or count(runs, 'run')}"
    return f"{title}, swept" if "sweep" in settings else title
