"""Lists what there is to choose from, without importing it.

What our modules and files say of themselves is kept in `data/lists.json`, which
`python -m tests.lists` writes and a test compares. If another package registers a name, all are
imported.
"""

import json
from typing import Any

from fuselog.pipeline.output.terminal import print_table, say
from fuselog.pipeline.runs.inputs import SHIPPED, shipped
from fuselog.recorders.registry import available

KEPT = SHIPPED / "lists.json"
# In which group the names of a list are registered; scenarios and experiments are files, too.
GROUPS = {
    "scenarios": "recorders",
    "estimators": "estimators",
    "models": "models",
    "methods": "models",
    "metrics": "metrics",
    "experiments": "",
}


def show_list(kind: str) -> None:
    """Print the names of a kind ("scenarios", say) with a line on each."""
    print_table([kind.removesuffix("s"), "what"], list(listed(kind).items()))
    say(f"For all about one of them: fuselog {kind} NAME")
    if kind == "models":
        rows = [
            [name, " ".join(method for method, answer in answers.items() if answer == "yes")]
            for name, answers in listed("methods").items()
        ]
        print_table(["model", "methods that estimate it"], rows)
        say("What a model lacks for another method: fuselog models NAME")


def listed(kind: str) -> dict[str, Any]:
    """Return a line on each name; for the methods, their answers by model."""
    kept, places = json.loads(KEPT.read_text(encoding="utf-8"))[kind], places_of(kind)
    if kept.keys() >= {*places.values()}:
        return {name: kept[place] for name, place in places.items()}
    return told(kind)


def told(kind: str, *, all_load: bool = False) -> dict[str, Any]:
    """Return what is listed as all that is listed says it, which imports all.

    An entry that does not load says why; with `all_load` it raises BadInput.
    """
    from fuselog.pipeline.api import catalog

    if kind == "methods":
        return catalog.methods()
    return {
        name: (make() if all_load else catalog.entry_or_why(name, make)).what
        for name, make in catalog.LISTS[kind.removesuffix("s")]().items()
    }


def places_of(kind: str) -> dict[str, str]:
    """Return where each name comes from: its entry point, or a file that has its name."""
    registered = available(GROUPS[kind]).items()
    return {name: entry.value for name, entry in registered} | {name: name for name in shipped(kind)}
