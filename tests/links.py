"""Makes links from `fuselog/` to the rooms, for tools that read files: mypy, import-linter, editors.

The rooms are packages of fuselog and stand at the top of a clone. Python finds them there, as
`fuselog/__init__.py` says; tools that run no code do not. Git ignores the links: a clone has none.
"""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]

for room in ("pipeline", "recorders", "replay"):
    link = ROOT / "fuselog" / room
    if link.exists():
        continue
    if os.name == "nt":
        import _winapi

        _winapi.CreateJunction(str(ROOT / room), str(link))  # needs no rights, as a symbolic link does
    else:
        link.symlink_to(Path("..", room))
