"""What the first use of a model with a method costs, the next one, and its loop; now, and before.

Each in a process of its own: with an empty cache, which is CPU time beyond a second replay in the same
process, and then with what the first has kept. A loop is timed alone, on columns that are ready, the
least CPU time of the two. `make bench FUSELOG_BEFORE=FOLDER` measures the earlier commit whose checkout
lies in FOLDER as well, in turns with today's. Run it with `make bench`, or `python -m tests.bench uses`.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from os import environ
from pathlib import Path
from typing import Any, NamedTuple

from tests.bench import meter

Row = tuple[str, str, str, str]
TODAY = Path(__file__).parents[2]
LOADS_S = 1.0  # what a second use may take


class Targets(NamedTuple):
    """What a first use may take in seconds, and which part of the time before; which part a loop may."""

    first_s: float
    first_part: float
    loop_part: float


USUAL, INERTIAL = Targets(1.0, 0.1, 1.0), Targets(3.0, 0.05, 0.5)


class Use(NamedTuple):
    """An estimator of so many runs of a scenario."""

    scenario: str
    parameters: dict[str, Any]
    runs: int
    estimator: str
    targets: Targets


def main() -> list[Row]:
    """First uses and loads in CPU seconds, loops in microseconds for each of their events."""
    before = environ.get("FUSELOG_BEFORE")
    return [row for use in USES for row in rows(use, Path(before).resolve() if before else None)]


def rows(use: Use, before: Path | None) -> Iterator[Row]:
    """What one use costs today, against its targets and what it cost before."""
    what, (first_s, first_part, loop_part) = f"{use.estimator} of {use.scenario}", use.targets
    own, *then = measured(use, [TODAY] + ([before] if before else []))
    for part, target in (("first", first_s), ("next", LOADS_S)):
        s = own[part]
        yield (
            f"{what}: CPU of the {part} use; target",
            f"{s:.2g} s",
            f"{target:g} s",
            f"{s / target:.2f} times",
        )
    if not then:
        yield f"{what}: loop, CPU of each event", f"{1e6 * own['event']:.3g} us", "", ""
    for old in then:
        ratios = own["first"] / old["first"], own["event"] / old["event"]
        times = f"{own['first']:.2g} s", f"{old['first']:.2g} s", f"{ratios[0]:.3f} times"
        yield f"{what}: CPU of the first use; before, at most {first_part:g} times", *times
        times = f"{1e6 * own['event']:.3g} us", f"{1e6 * old['event']:.3g} us", f"{ratios[1]:.2f} times"
        yield f"{what}: loop, CPU of each event; before, at most {loop_part:g} times", *times


def measured(use: Use, checkouts: list[Path]) -> list[dict[str, float]]:
    """CPU seconds of each checkout: first use, next use, an event of the loop."""
    turns: list[list[dict[str, float]]] = [[] for _ in checkouts]
    with tempfile.TemporaryDirectory() as caches:
        for _ in range(2):
            for number, checkout in enumerate(checkouts):
                turns[number].append(elsewhere(use, checkout, f"{caches}/{number}"))
    return [
        {
            "first": first["first_use"],
            "next": second["first_use"],
            "event": min(first["event"], second["event"]),
        }
        for first, second in turns
    ]


def elsewhere(use: Use, checkout: Path, cache: str) -> dict[str, float]:
    """What `meter` measures of a checkout, in a process of its own with this cache."""
    arguments = [use.scenario, json.dumps(use.parameters), str(use.runs), use.estimator]
    environment = {**environ, "FUSELOG_CACHE": cache, "PYTHONPATH": str(checkout)}
    done = subprocess.run(
        [sys.executable, "-P", meter.__file__, *arguments],
        env=environment,
        cwd=checkout,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(done.stdout)


def uses(
    scenario: str, parameters: dict[str, Any], runs: int, *estimators: str, targets: Targets = USUAL
) -> Iterator[Use]:
    """Estimators of the same runs, which have some thousand events."""
    return (Use(scenario, parameters, runs, estimator, targets) for estimator in estimators)


FILTERS = "ekf", "ukf"
USES = (
    *uses("landmarks", {"duration_s": 60.0}, 1, *FILTERS, "iekf", "smoother:iterated"),
    *uses("batch-reactor", {"steps": 2000}, 1, *FILTERS, "lrkf:ukf", "analytic"),
    *uses("vehicles", {"duration_s": 1000.0}, 1, *FILTERS, "imm:ekf", "vehicle-kalman"),
    *uses(meter.OWN, {}, 20, *FILTERS),
    *uses("navigation", {"duration_s": 20.0}, 1, *FILTERS, "smoother:ekf", targets=INERTIAL),
    *uses("moving-los", {}, 10, *FILTERS),
    *uses("ranging", {}, 1, *FILTERS),
    *uses("shot-sequence", {}, 30, *FILTERS),
    *uses("sound-source", {}, 500, *FILTERS),
    *uses("extended-target", {}, 20, "ukf", "lrkf:ukf"),
)
