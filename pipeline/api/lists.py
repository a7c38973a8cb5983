"""Lists of names that can be chosen, read without importing the modules that define them.

The descriptions of our modules and files, and the defaults of our recorders, are stored in
`data/lists.json`, which `python -m tests.lists` writes and a test checks. If another package registers a
name, everything is imported instead.
"""

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any

from fuselog.pipeline.output.terminal import print_table, say
from fuselog.pipeline.runs.inputs import defaults_of, kept_lists, shipped
from fuselog.recorders.parsing import read_toml
from fuselog.recorders.registry import available

# The entry-point group of each list; scenarios and experiments may also be files.
GROUPS = {
    "scenarios": "recorders",
    "estimators": "estimators",
    "models": "models",
    "methods": "models",
    "types": "models",
    "metrics": "metrics",
    "experiments": "",
    "defaults": "recorders",
}
# Title of each family by the module that defines a name, in printing order.
FAMILIES = {
    r"fuselog\.replay\.inference\.": "Methods, for any model",
    r"fuselog\.\w+\.importers\.": "Real data",
    r"fuselog\.(recorders\.simulators|replay\.estimators)\.": "Robots and navigation",
    r"fuselog\.replay\.foreign\.": "Filters of your own",
    r"fuselog\.\w+\.families\.vehicles\.": "Vehicles",
    r"fuselog\.\w+\.families\.tracking\.": "Many targets",
    r"fuselog\.\w+\.families\.networks\.": "Networks of estimators",
    r"fuselog\.\w+\.families\.ranging\.": "Ranging",
    r"fuselog\.\w+\.families\.sets\.": "Guaranteed sets",
    r"fuselog\.\w+\.families\.directional\.": "Orientations",
    r"fuselog\.\w+\.families\.sampling\.": "Sampling",
    r"fuselog\.\w+\.families\.los\.": "Lines of sight",
    r"fuselog\.\w+\.families\.acoustic\.": "Shots and sounds",
    r"fuselog\.\w+\.families\.biometrics\.": "Biometrics",
    r"": "Other packages",
}


def show_list(kind: str) -> None:
    """Print the names of a kind (such as "scenarios") by family, each with a one-line description."""
    in_families = kind in ("scenarios", "models", "estimators")
    rows = by_family(kind) if in_families else listed(kind).items()
    print_table([kind.removesuffix("s"), "what"], [*rows])
    say(f"For details of one of them: fuselog {kind} NAME")
    if kind == "models":
        methods = [
            [name, " ".join(method for method, answer in answers.items() if answer == "yes")]
            for name, answers in listed("methods").items()
        ]
        print_table(["model", "methods that estimate it"], methods)
        say("To see what a model lacks for another method: fuselog models NAME")


def by_family(kind: str) -> Iterator[tuple[str, str]]:
    """Yield a row for each family, followed by its names, each with its description."""
    lines, places = listed(kind), places_of(kind)
    order = [*FAMILIES]

    def family_of(name: str) -> int:
        place = places[name]
        if name == place:  # a file belongs to the family of its recorder
            place = places[read_toml(shipped(kind)[name])["recorder"]]
        return next(at for at, module in enumerate(order) if re.match(module, place))

    for family, names in groupby(sorted(lines, key=family_of), family_of):
        yield FAMILIES[order[family]], ""
        yield from ((f"  {name}", lines[name]) for name in names)


def listed(kind: str) -> dict[str, Any]:
    """Return each name's description.

    For "methods", it tells whether each method can estimate each model; for "types", see
    `fuselog.pipeline.api.catalog.types`.
    """
    kept, places = kept_lists()[kind], places_of(kind)
    if kept.keys() >= {*places.values()}:
        return {name: kept[place] for name, place in places.items()}
    return told(kind)


def told(kind: str, *, all_load: bool = False) -> dict[str, Any]:
    """Import all entries, and collect their descriptions.

    The description of an entry that cannot be loaded is the error; if `all_load` is set, BadInput is
    raised instead.
    """
    from fuselog.pipeline.api import catalog

    if kind == "methods":
        return catalog.methods()
    if kind == "types":
        return catalog.types()
    if kind == "defaults":
        return {name: defaults_of(name) for name in available(GROUPS[kind])}
    return {
        name: (make() if all_load else catalog.entry_or_why(name, make)).what
        for name, make in catalog.LISTS[kind.removesuffix("s")]().items()
    }


def places_of(kind: str) -> dict[str, str]:
    """Return the origin of each name: its entry point, or the file with that name."""
    registered = available(GROUPS[kind]).items()
    return {name: entry.value for name, entry in registered} | {name: name for name in shipped(kind)}
