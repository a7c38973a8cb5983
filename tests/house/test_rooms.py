"""What every package opens with."""

import ast
import re

from tests.house.sources import PATHS, ROOT, tree_of


def test_packages_open_with_what_belongs_there_and_where_to_begin() -> None:
    """What they name as the beginning is a file or a room in them."""
    for path in PATHS:
        name = path.as_posix()
        folder, _, file = name.rpartition("/")
        if file == "__init__.py" and folder != "fuselog":
            opening = ast.get_docstring(tree_of(path)) or ""
            assert opening.partition("\n\n")[0].endswith("."), name
            begin = re.search(
                r"\b[Bb]egin (?:reading in|here|with) ?((?:`[\w.]+`|, then | and )*)", opening
            )
            assert begin, f"{name}: says nothing of where to begin"
            for first in re.findall(r"`([\w.]+)`", begin[1]):
                place = ROOT / folder / first.replace(".", "/")
                assert place.is_dir() or place.with_suffix(".py").exists(), f"{name}: {first}"
