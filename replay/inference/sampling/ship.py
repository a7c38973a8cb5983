"""Computation of the sample sets that ship with fuselog, in data/.

Run it with `python -m fuselog.replay.inference.sampling.ship`. A different CPU may find a different
optimum with (nearly) the same D, so existing sets are not computed again.
"""

from pathlib import Path

from fuselog.replay.inference.sampling.cache import SHIPPED, SetName, compute_set, read_set, write_sets

COMMON = (
    *(SetName(dimension, count) for dimension in range(1, 9) for count in (25, 50, 100, 200)),
    *(SetName(dimension, count, symmetric=True) for dimension in range(1, 9) for count in (50, 100)),
    *(SetName(2, count) for count in (5, 10, 12, 15, 20, 150)),
    *(SetName(dimension, count) for dimension in (10, 15, 20) for count in (25, 50, 100)),
)


def main() -> None:
    """Compute the sets that are missing from the shipped file, and replace the file."""
    found = {name: read_set(SHIPPED, name) for name in COMMON}
    sets = {
        name: compute_set(name, lambda message: print(message, flush=True)) if points is None else points
        for name, points in found.items()
    }
    write_sets(Path(str(SHIPPED)), sets, made_by="python -m fuselog.replay.inference.sampling.ship")


if __name__ == "__main__":
    main()
