"""What an estimates log says of itself: which log it is of, and what its estimators were."""

from pathlib import Path
from typing import Any

from recorders.errors import BadInput
from recorders.log import Log
from recorders.parsing import parse_json
from replay.engine.streams.sources import Source


def log_of_estimates(estimates: Log) -> Path:
    """The log that an estimates log was replayed from; raises BadInput where it is not to be found."""
    named = estimates.run.notes.get("log") if estimates.run else None
    if named is None:
        raise BadInput(
            f"{estimates.path}: does not state the log that it was made from; give that with --log"
        )
    path = (estimates.path.parent / named).resolve()
    if not path.exists():
        raise BadInput(
            f"{estimates.path}: the log {path} that it was made from is missing; give it with --log"
        )
    return path


def stated_estimators(estimates: Log | Source) -> dict[str, Any]:
    """Parameters by label, in the order of the replay; none where the log does not say."""
    notes = estimates.run.notes if estimates.run else {}
    try:
        stated = parse_json(notes.get("estimators", "{}"))
    except ValueError:
        return {}
    return stated if isinstance(stated, dict) else {}
