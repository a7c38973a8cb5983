"""Cache of LCD sets on disk; each set is computed only once, and damaged files are ignored.

A file (see `fuselog.recorders.compiling.cache`) contains a NumPy npz archive whose members are named
after their sets. Common sets ship with the package (see `sampling.ship`); other sets are stored in the
user's cache.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from fuselog.recorders.compiling.cache import cache_folder, is_private, read_checked, write_checked
from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling.distance import Array
from fuselog.replay.inference.sampling.lcd import (
    Report,
    check_count,
    lcd_samples,
    moment_corrected,
    silent,
)

SHIPPED = files("fuselog_data") / "lcd-samples.bin"


@dataclass(frozen=True)
class SetName:
    """Identification of one moment-corrected LCD set."""

    dimension: int
    count: int
    symmetric: bool = False
    seed: int = 0

    def __str__(self) -> str:
        """Return the name in an archive; change the version whenever the computed sets change."""
        kind = "symmetric" if self.symmetric else "free"
        return f"lcd1-{kind}-n{self.dimension}-l{self.count}-seed{self.seed}"


def cached_set(name: SetName, report: Report = silent) -> Array:
    """Return one set (count, dimension) from the shipped file or the user's cache, or compute it.

    Args:
        name: the set.
        report: function that is called with messages about the computation of the set, and with a
            message if the set cannot be stored.

    Raises:
        BadInput: no such set exists, see `check_count`.
    """
    check_count(name.dimension, name.count, name.symmetric)
    path = cache_folder() / "samples" / f"{name}.bin"
    points = read_set(SHIPPED, name)
    if points is not None:
        return points
    if not is_private(path.parent):
        return compute_set(name, report)
    points = read_set(path, name)
    if points is not None:
        return points
    if path.exists():
        report(f"{path} is damaged or not a file of fuselog; its samples are computed again")
    points = compute_set(name, report)
    try:
        write_sets(path, {name: points}, "fuselog on demand")
    except BadInput as error:
        report(f"{error}; its samples are not stored")
    return points


def compute_set(name: SetName, report: Report = silent) -> Array:
    """Compute one set; on one machine, the result for a name is always the same."""
    generator = np.random.default_rng(name.seed)
    return moment_corrected(
        lcd_samples(name.dimension, name.count, generator, symmetric=name.symmetric, report=report)
    )


def read_set(source: Path | Traversable, name: SetName) -> Array | None:
    """Return one set of a file, or None if the file is damaged or does not contain it."""
    archive = read_checked(source)
    if archive is None:
        return None
    with np.load(io.BytesIO(archive)) as sets:
        found: Array | None = sets.get(str(name))
        return found


def write_sets(path: Path, sets: Mapping[SetName, Array], made_by: str) -> None:
    """Write sets to one file, completely or not at all; raise BadInput if this fails."""
    archive = io.BytesIO()
    members = {str(name): points for name, points in sets.items()}
    np.savez(archive, **members)  # type: ignore[arg-type]
    write_checked(path, archive.getvalue(), f"LCD samples of N(0, I), made by {made_by}")
