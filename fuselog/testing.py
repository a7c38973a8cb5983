"""Assertions that compare replayed estimates with a golden file, as `fuselog check` does.

>>> def test_my_estimator():
...     assert_golden("drive.mcap", "tests/mine.golden.xz", {"mine": MINE})
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.planning import Kind, settings_of
from fuselog.pipeline.checking.checking import Checked, check, compared, runs_of
from fuselog.pipeline.checking.golden import Replayed, make
from fuselog.pipeline.checking.stored import Golden, read, write
from fuselog.replay.engine.streams.sources import LogSource, MemorySource

__all__ = ["Golden", "Replayed", "assert_golden", "assert_same"]

# Name of an environment variable; if it is set, golden files are written instead of compared.
UPDATE = "FUSELOG_UPDATE_GOLDENS"


def assert_golden(
    logs: str | Path | Mapping[str, LogSource | MemorySource],
    golden: str | Path,
    estimators: str | Mapping[str, Kind] | list[str | Mapping[str, Kind]] | None = None,
) -> None:
    """Replay estimators over logs and compare the estimates with a golden file, field by field.

    If the environment variable FUSELOG_UPDATE_GOLDENS is set, the golden file is written instead.

    Args:
        logs: a log, a folder of logs, or runs by name, such as `{"seed 7": fuselog.record(...)}`.
        golden: the golden file. The file's name ends in .golden.xz; keep the file next to the tests.
        estimators: as for `fuselog.replay`; by default, the estimators that the golden file names.

    Raises AssertionError with the first difference: topic, run, stamp, component, both values, and the
    innovation at this stamp. Raises BadInput if the golden file does not exist or was made from other
    runs.
    """
    runs = logs if isinstance(logs, Mapping) else runs_of(Path(logs))
    place = Path(golden)
    chosen: dict[str, dict[str, Any]] | None = None if estimators is None else settings_of(estimators)
    if os.environ.get(UPDATE):
        there = read(place) if place.exists() else None
        write(place, make(runs, chosen or (there or {"settings": {}})["settings"]["estimators"]).golden)
        return
    remedy = f"if this change is intended, run once with {UPDATE}=1 to write the golden again"
    _require(check(runs, read(place), chosen), place, remedy)


def assert_same(replayed: Replayed, golden: str | Path) -> None:
    """Compare estimates from any source with a golden file; raise the same errors as `assert_golden`."""
    _require(compared(read(Path(golden)), replayed), Path(golden))


def _require(checked: Checked, golden: Path, *advice: str) -> None:
    if checked.found:
        more = [each.sentence for each in checked.found[1:10]]
        raise AssertionError("\n".join([f"{golden}:", *checked.sentences, *more, *advice]))
