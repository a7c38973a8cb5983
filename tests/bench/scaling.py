"""How far campaigns scale: measured on one and two workers here, simulated from there to a thousand.

`python -m tests.bench.scaling` measures, keeps what it measured, and makes the tables and the figure of
docs/many-runs.md; `python -m tests.bench.scaling --keep` makes them from what is kept. The simulation is
of one driver, which serves finished cells one after another: their results come over its network, are
kept and merged, and the worker gets its next cell.
"""

import heapq
import json
import re
import sys
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import NamedTuple

import matplotlib as mpl

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, draw, level
from fuselog.pipeline.runs.campaigns import Cell, cells_of
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.ensemble import RUNS_AT_ONCE
from fuselog.pipeline.runs.executors import processes, started
from fuselog.pipeline.runs.experiment import Setting, load_experiment, run_experiment
from tests.bench.parts import time_parts
from tests.bench.timing import seconds

DOCS = Path(__file__).parents[2] / "docs"
KEPT, PAGE, FIGURE = DOCS / "many-runs.json", DOCS / "many-runs.md", DOCS / "figures" / "many-runs.svg"
RUNS = 2000
WORKERS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)
NETWORK_BYTES_PER_S = 125e6  # of the driver: a gigabit a second
LATENCY_S = 1e-3
CELLS_EACH = 20  # of every worker in the simulation
_TABLES = re.compile(r"(<!-- (scaling|shares) -->\n).*?(<!-- end -->)", re.DOTALL)


class Measured(NamedTuple):
    """What was measured; seconds are of CPU time.

    Attributes:
        cell_s: a worker of one core works a cell of 128 runs off.
        driver_s: the driver keeps, reads and merges what a cell left.
        cell_bytes: the size of that.
        runs_per_s: of whole campaigns of 2000 runs, with one worker and with two.
        shares: of the parts of a cell in its CPU time, as fractions.
    """

    cell_s: float
    driver_s: float
    cell_bytes: int
    runs_per_s: tuple[float, float]
    shares: Mapping[str, float]

    @property
    def beyond_half_s(self) -> float:
        """How much longer 2000 runs take with two workers than half of the time with one."""
        one, two = (RUNS / rate for rate in self.runs_per_s)
        return two - 0.5 * one

    @property
    def served_s(self) -> float:
        """How long the driver is busy with a cell: its results come in, and are kept and merged."""
        return self.cell_bytes / NETWORK_BYTES_PER_S + self.driver_s

    @property
    def limit_runs_per_s(self) -> float:
        """More the driver cannot serve."""
        return RUNS_AT_ONCE / self.served_s

    @property
    def limit_workers(self) -> int:
        """So many workers keep the driver busy."""
        return round((self.cell_s + 2 * LATENCY_S) / self.served_s) + 1


def measure() -> Measured:
    """Measure; rates are of wall time, so that two cores must have nothing else to do for a minute."""
    with tempfile.TemporaryDirectory() as scratch:
        rates = [RUNS / seconds(partial(_campaign, Path(scratch), count)) for count in (1, 2)]
        taken = time_parts(partial(_cells(Path(scratch))[0].work_off, Path(scratch)))
        shares = {part: taken_s / taken.whole_s for part, taken_s in taken.parts_s.items()}
        return Measured(*_measured_cells(Path(scratch)), (rates[0], rates[1]), shares)


def _campaign(folder: Path, workers: int) -> None:
    name, experiment = load_experiment("landmarks", {}, {"runs": RUNS})
    with started(processes(workers)) as open_pool:
        run_experiment(name, experiment, folder / "result", logs=0, open_pool=open_pool)


def _measured_cells(folder: Path) -> tuple[float, float, int]:
    """CPU time of a cell and of the driver with it, and the bytes that come to the driver."""
    cell_s, driver_s, left, whole = [], [], b"", None
    with processes(1)() as pool, checkpoints_of(folder / "cells") as checkpoints:
        checkpoints.begin()
        for cell in _cells(folder)[:7]:
            left, taken_s = pool.executor.submit(_timed, cell, checkpoints.place_of(cell.key)).result()
            begin_s = process_time()
            checkpoints.write(cell.key, left)
            done = checkpoints.read(cell.key)
            if whole is None:
                whole = done
            else:
                whole.merge(done)
            driver_s.append(process_time() - begin_s)
            cell_s.append(taken_s)
    return median(cell_s), median(driver_s), len(left)


def _cells(folder: Path) -> list[Cell]:
    _, experiment = load_experiment("landmarks", {}, {"runs": RUNS})
    return cells_of(experiment, Setting(folder, folder, logs=0, draws=False))


def _timed(cell: Cell, folder: Path) -> tuple[bytes, float]:
    begin_s = process_time()
    return cell.packed(folder), process_time() - begin_s


def simulated(measured: Measured, workers: int) -> float:
    """Runs per second of so many workers, each with `CELLS_EACH` cells to do, when all have begun."""
    cells = CELLS_EACH * workers
    waiting = workers  # cells that are handed out
    arriving = [measured.cell_s + LATENCY_S] * workers
    free_s = 0.0
    for _ in range(cells):
        free_s = max(free_s, heapq.heappop(arriving)) + measured.served_s
        if waiting < cells:
            waiting += 1
            heapq.heappush(arriving, free_s + measured.cell_s + 2 * LATENCY_S)
    return cells * RUNS_AT_ONCE / free_s


def table(measured: Measured) -> str:
    """What the page says of it."""
    rows = [
        f"| {workers} | {simulated(measured, workers):.0f} | "
        f"{simulated(measured, workers) / simulated(measured, 1) / workers:.0%} |"
        for workers in WORKERS
    ]
    one, two = measured.runs_per_s
    said = f"""\
On two cores, {RUNS} runs of `landmarks`, including the start of processes and the figures, ran at
{one:.0f} runs/s with one worker and at {two:.0f} runs/s with two. Two workers take
{measured.beyond_half_s:.1f} s longer than half of one worker's time, partly because the driver alone
starts the campaign and draws the figures.
A worker computes a cell in {measured.cell_s:.2f} s.
The result of a cell has {measured.cell_bytes / 1e6:.1f} MB; the driver keeps it
and merges it in {1e3 * measured.driver_s:.0f} ms. In a simulation
with these numbers and a gigabit network, the driver limits the rate of {measured.limit_workers}
or more workers to {measured.limit_runs_per_s:.0f} runs/s:

| workers | runs/s, simulated | share of the ideal rate |
|---|---|---|
"""
    return said + "\n".join(rows) + "\n"


def table_of_shares(shares: Mapping[str, float]) -> str:
    """The parts of a cell, the largest first; the last row is what no part has."""
    parts = sorted(shares.items(), key=lambda each: -each[1])
    parts.append(("other: collecting streams, monitoring, reports", 1.0 - sum(shares.values())))
    rows = [f"| {part} | {share:.0%} |\n" for part, share in parts]
    return "".join(["| part | share |\n|---|---|\n", *rows])


def chart(measured: Measured) -> Chart:
    """Runs per second over workers: measured, simulated, and what the driver can serve."""
    rates = [simulated(measured, workers) for workers in WORKERS]
    series = [
        curve(
            "ideal: one worker's rate times the workers",
            WORKERS,
            [rates[0] * workers for workers in WORKERS],
            "dashed",
        ),
        level("the driver's limit", WORKERS, measured.limit_runs_per_s),
        curve("simulated", WORKERS, rates, "line+markers"),
        curve("measured, whole campaigns", (1, 2), measured.runs_per_s, "markers"),
    ]
    panel = Panel(
        x=Axis(label="workers", log=True), y=Axis(label="runs per second", log=True), series=series
    )
    return Chart(title="landmarks, cells of 128 runs, a gigabit network", panels=[panel])


def kept() -> Measured:
    """What was measured last."""
    return Measured(**json.loads(KEPT.read_text(encoding="utf-8")))


def rendered(page: str, measured: Measured) -> str:
    """The page with its tables made anew."""
    tables = {"scaling": table(measured), "shares": table_of_shares(measured.shares)}
    return _TABLES.sub(lambda found: f"{found[1]}{tables[found[2]]}{found[3]}", page)


def main() -> None:
    """Measure, unless `--keep` is given, and make the page's tables and figure."""
    if "--keep" not in sys.argv[1:]:
        KEPT.write_text(json.dumps(measure()._asdict(), indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(rendered(PAGE.read_text(encoding="utf-8"), kept()), encoding="utf-8")
    with mpl.rc_context({"svg.hashsalt": "fuselog"}):
        said = {"Date": None, "Description": chart(kept()).model_dump_json()}
        draw(chart(kept())).savefig(FIGURE, metadata=said)


if __name__ == "__main__":
    main()
