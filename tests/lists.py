"""Keep anew what `fuselog scenarios`, `estimators` and the others list: `python -m tests.lists`."""

import json
import sys
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.lists import GROUPS, places_of, told
from fuselog.pipeline.runs.inputs import KEPT
from fuselog.recorders.errors import BadInput


def lists() -> dict[str, dict[str, Any]]:
    """Return what modules and files say, by list and place; raises BadInput if one does not load."""
    return {
        kind: {places_of(kind)[name]: what for name, what in told(kind, all_load=True).items()}
        for kind in GROUPS
    }


def main() -> None:
    """Keep the lists; ends the process with a sentence if something does not load."""
    try:
        kept = lists()
    except BadInput as error:
        print(f"nothing is kept: {error}", file=sys.stderr)
        sys.exit(2)
    Path(str(KEPT)).write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
