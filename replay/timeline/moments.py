"""Worst moments of a run, which are stored in its timeline and used for the cursor of the viewer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.chunk as rc

from fuselog.recorders.errors import BadInput, choices
from fuselog.replay.judging.errors.moments import Moment, worst_of

WORST = "worst"
_ENTITY = "moments"


def keep_moments(recording: rr.RecordingStream, moments: Sequence[Moment]) -> None:
    """Log moments as a table in the timeline, with a column for each field."""
    if moments:
        columns: dict[str, Any] = {
            name: [getattr(each, name) for each in moments] for name in Moment._fields
        }
        recording.log(_ENTITY, rr.AnyValues(**columns), static=True, strict=True)


def read_moments(rrd: Path) -> list[Moment]:
    """Read the moments stored in a timeline; empty if the timeline has no errors."""
    for chunk in rc.RrdReader(str(rrd)).stream().filter(content=f"/{_ENTITY}", is_static=True):
        batch = chunk.to_record_batch()
        columns = [batch.column(name).to_pylist()[0] for name in Moment._fields]
        return [Moment(*row) for row in zip(*columns, strict=True)]
    return []


def worst_at(moments: Sequence[Moment], at: str) -> Moment:
    """Return the moment that `worst` or `worst:ESTIMATOR` selects.

    Raises BadInput if there are no errors, or no errors of this estimator.
    """
    estimator = at.partition(":")[2]
    if not moments:
        raise BadInput(
            f"--at {at}: the timeline has no errors of estimates; give seconds, such as --at 30"
        )
    known = list(dict.fromkeys(moment.estimator for moment in moments))
    if estimator and estimator not in known:
        raise BadInput(f"--at {at}: no estimator with this name has errors; {choices(estimator, known)}")
    found = worst_of(each for each in moments if estimator in ("", each.estimator))
    assert found is not None
    return found
