"""The sample cache: LCD sets are computed once, kept on disk, and never trusted when damaged.

A file is one line of text, which begins with the SHA-256 of all that follows it and says what made the
file, and a NumPy npz archive whose members are named after their sets. Common sets ship with the package
(see `replay.sampling.ship`); others are kept in $FUSELOG_CACHE, else $XDG_CACHE_HOME/fuselog, else
~/.cache/fuselog.
"""

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from uuid import uuid4

import numpy as np

from replay.sampling.distance import Array
from replay.sampling.lcd import Report, check_count, lcd_samples, moment_corrected, silent

SHIPPED = files("fuselog_data") / "lcd-samples.bin"


@dataclass(frozen=True)
class SetName:
    """What identifies one moment-corrected LCD set."""

    dimension: int
    count: int
    symmetric: bool = False
    seed: int = 0

    def __str__(self) -> str:
        """The name in an archive; raise its version whenever another set is to come out."""
        kind = "symmetric" if self.symmetric else "free"
        return f"lcd1-{kind}-n{self.dimension}-l{self.count}-seed{self.seed}"


def cache_folder() -> Path:
    """Where this user's computed results are kept."""
    chosen = os.environ.get("FUSELOG_CACHE")
    if chosen:
        return Path(chosen)
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "fuselog"


def cached_set(name: SetName, report: Report = silent) -> Array:
    """Return one set (count, dimension), from the shipped file, the user's cache, or computed now.

    Args:
        name: the set.
        report: told when the set is computed, how far that is, and where it could not be kept.

    Raises:
        BadInput: no such set exists, see `check_count`.
    """
    check_count(name.dimension, name.count, name.symmetric)
    path = cache_folder() / "samples" / f"{name}.bin"
    for source in (SHIPPED, path):
        points = read_set(source, name)
        if points is not None:
            return points
    if path.exists():
        report(f"{path} is damaged or not ours; its samples are computed again")
    points = compute_set(name, report)
    try:
        write_sets(path, {name: points}, "fuselog on demand")
    except OSError as error:
        report(f"{path} cannot be written ({error.strerror}); its samples are not kept")
    return points


def compute_set(name: SetName, report: Report = silent) -> Array:
    """Compute one set; the same name gives the same bytes on one machine."""
    generator = np.random.default_rng(name.seed)
    return moment_corrected(
        lcd_samples(name.dimension, name.count, generator, symmetric=name.symmetric, report=report)
    )


def read_set(source: Path | Traversable, name: SetName) -> Array | None:
    """Return one set of a file, or None where the file is damaged or one of them is not there."""
    try:
        header, _, archive = source.read_bytes().partition(b"\n")
    except OSError:
        return None
    if not header.startswith(_digest(archive)):
        return None
    with np.load(io.BytesIO(archive)) as sets:
        return sets.get(str(name))


def write_sets(path: Path, sets: Mapping[SetName, Array], made_by: str) -> None:
    """Write sets to one file, which appears whole or not at all; raises OSError."""
    archive = io.BytesIO()
    members = {str(name): points for name, points in sets.items()}
    np.savez(archive, **members)  # type: ignore[arg-type]
    content = archive.getvalue()
    header = _digest(content) + f" LCD samples of N(0, I), made by {made_by}\n".encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{uuid4().hex}.part")
    try:
        part.write_bytes(header + content)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _digest(content: bytes) -> bytes:
    return sha256(content).hexdigest().encode()
