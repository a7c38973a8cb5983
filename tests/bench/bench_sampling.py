"""What LCD sets cost, beside an independent implementation and our limits; run it, or call main().

Source: Steinbring and Hanebeck, JAIF 2014, section V; "the sheet" is that implementation's table.
"""

import tempfile
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from fuselog.replay.inference.sampling import SetName, cached_set, lcd_samples
from fuselog.replay.inference.sampling.cache import read_set, write_sets
from tests.bench.timing import median_seconds

# (N, L): CPU seconds per start in the sheet's table; "<.01" is written as .01.
SECONDS_PER_START = {
    (2, 5): 0.01,
    (2, 10): 0.01,
    (2, 12): 0.01,
    (2, 20): 0.01,
    (2, 50): 0.07,
    (2, 100): 0.4,
    (2, 150): 1.5,
    (4, 25): 0.04,
    (8, 25): 0.06,
    (8, 50): 0.2,
    (10, 50): 0.5,
}
STARTS = 8


def main() -> list[tuple[str, float, float, float]]:
    """Return rows of name, our seconds, reference seconds, and ours over the reference."""
    lcd_samples(2, 3, np.random.default_rng(0), starts=1)  # compiles
    timings = []
    for (dimension, count), reference in SECONDS_PER_START.items():
        begin = process_time()
        lcd_samples(dimension, count, np.random.default_rng(0), starts=STARTS)
        seconds = (process_time() - begin) / STARTS
        timings.append((f"LCD ({dimension}, {count}), CPU s per start", seconds, reference))

    begin = perf_counter()
    lcd_samples(20, 100, np.random.default_rng(0))
    timings.append(("LCD (20, 100), wall s in all", perf_counter() - begin, 60.0))

    shipped = SetName(8, 50)
    timings.append(("load a shipped set, s", median_seconds(lambda: cached_set(shipped), 51), 0.005))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "set.bin"
        write_sets(path, {shipped: cached_set(shipped)}, "a benchmark")
        timings.append(
            ("load a cached set, s", median_seconds(lambda: read_set(path, shipped), 51), 0.005)
        )
    return [(name, ours, reference, ours / reference) for name, ours, reference in timings]


if __name__ == "__main__":
    for name, ours, reference, ratio in main():
        print(f"{name:34} {ours:10.5f} {reference:10.5f} {ratio:8.3f}")
