"""Keep anew what `fuselog scenarios`, `estimators` and the others list: `python -m tests.lists`."""

import json
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.lists import GROUPS, KEPT, places_of, told


def lists() -> dict[str, dict[str, Any]]:
    """What the modules and files say, by list and by where each name comes from."""
    return {kind: {places_of(kind)[name]: what for name, what in told(kind).items()} for kind in GROUPS}


if __name__ == "__main__":
    Path(str(KEPT)).write_text(json.dumps(lists(), indent=1) + "\n", encoding="utf-8")
