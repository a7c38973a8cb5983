"""A hand-made ensemble whose every answer is known: six runs of a car, and two estimators of it.

In run r all errors are `SIZES[r]` times as large as stated here. `one` is off by 1 m in x and by 0.2 rad
in heading, across the border of half a turn; it gives innovations, of which some are gated and some lack
their bearing. `two` errs to either side in turn, with a covariance between x and y; it has modes and
particles, and takes late messages. Nothing is recorded or replayed.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import fuselog as fl
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas

SIZES = np.array([0.8, 0.9, 1.0, 1.1, 1.2, 1.0])
EPOCH_NS, STEP_NS, STEPS = 1_767_225_600_000_000_000, 100_000_000, 21
ROWS = np.arange(STEPS)
STAMPS_NS = EPOCH_NS + STEP_NS * ROWS
AGE_S = 0.02
POSE = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}
TRUTH = np.stack([3.0 + 0.5 * ROWS, np.full(STEPS, -2.0), np.full(STEPS, 3.1)], axis=1)
SIDES = np.where(ROWS % 2, 1.0, -1.0)
ERRORS = {
    "one": np.tile([1.0, 0.0, 0.2], (STEPS, 1)),
    "two": SIDES[:, None] * [0.3, -0.4, 0.1],
}
COVARIANCES = {
    "one": np.diag([0.25, 0.25, 0.01]),
    "two": np.array([[0.04, 0.02, 0.0], [0.02, 0.09, 0.0], [0.0, 0.0, 0.01]]),
}
NIS = 1.4  # of every innovation
BEARING_LACKS, GATED = ROWS % 3 == 0, ROWS % 7 == 1
LIKELIHOOD = -2.0  # the logarithm, of each that is accepted
CALM = ROWS / 40.0  # probability of the first mode
EFFECTIVE = 10 + ROWS  # of 50 particles
# Delays of late messages by what became of them, 0.4 s apart, and what was used again for each.
LATE_S = {"dropped": [0.1, 0.2, 0.6], "inserted": [0.25, 0.75]}
REPEATED = [3, 5]


def write_runs(folder: Path) -> None:
    """Write the logs with the truth, and of each run the estimates; those of one alone in its folder."""
    for number, size in enumerate(SIZES.tolist()):
        run = RunMetadata("own", seed=4, run=number, epoch_ns=EPOCH_NS)
        log, name = (folder / f"log{number}.mcap").resolve(), f"estimates{number}.mcap"
        _write(log, sensed(), run)
        made = replace(run, notes={"log": str(log)})
        _write(folder / name, estimated(size), made)
        for label in ERRORS:
            (folder / label).mkdir(exist_ok=True)
            _write(folder / label / name, [state(label, size, "filter")], made)


def _write(path: Path, streams: list[Stream], run: RunMetadata) -> None:
    fl.write(path, fl.MemorySource({each.topic: each for each in streams}, run, "own"))


def sensed() -> list[Stream]:
    """The truth, and fixes without any error."""
    return [
        make_stream("/car/truth", schemas.TRUTH_STATE, STAMPS_NS, metadata=POSE, state=TRUTH),
        make_stream(
            "/car/fix",
            schemas.POSITION_FIX,
            STAMPS_NS,
            position_m=TRUTH[:, :2],
            covariance_m2=np.tile([1.0, 0.5, 0.5, 4.0], (STEPS, 1)),
        ),
    ]


def estimated(size: float) -> list[Stream]:
    """What both estimators say of a run."""
    return [*(state(name, size) for name in ERRORS), innovations(), *beside()]


def state(name: str, size: float, label: str = "") -> Stream:
    """What an estimator says, perhaps under another label."""
    mean = TRUTH + size * ERRORS[name]
    mean[:, 2] = np.angle(np.exp(1j * mean[:, 2]))
    return make_stream(
        f"/estimates/{label or name}/car/state",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS_NS,
        log_time_ns=STAMPS_NS + round(AGE_S * 1e9),
        metadata={**POSE, "truth": "/car/truth"},
        mean=mean,
        covariance=np.tile(COVARIANCES[name].ravel(), (STEPS, 1)),
    )


def innovations() -> Stream:
    values = np.full((STEPS, 2), 0.5)
    values[BEARING_LACKS, 1] = np.nan
    return make_stream(
        "/estimates/one/car/innovation",
        schemas.INNOVATION,
        STAMPS_NS,
        metadata={"components": "range_m,bearing_rad", "kinds": "linear,angle", "truth": "/car/truth"},
        target_id=np.zeros(STEPS, int),
        accepted=(~GATED).astype(int),
        innovation=values,
        covariance=np.tile(np.eye(2).ravel(), (STEPS, 1)),
        normalised_innovation_squared=np.full(STEPS, NIS),
        log_likelihood=np.where(GATED, 0.0, LIKELIHOOD),
    )


def beside() -> list[Stream]:
    """Modes, particles, and messages that came late: of `one` they were dropped, of `two` inserted."""
    stem = "/estimates/two/car"
    named = {"components": "calm,agile", "kinds": "linear,linear"}
    modes = np.stack([CALM, 1.0 - CALM], axis=1)
    effective = {"particles": np.full(STEPS, 50), "effective": EFFECTIVE.astype(float)}
    dropped, inserted = (
        (EPOCH_NS + 4 * STEP_NS * np.arange(len(late)), np.rint(1e9 * np.array(late)).astype(int))
        for late in LATE_S.values()
    )
    reasons = {"reasons": json.dumps(["topic /car/fix: it is older than what was used before"])}
    return [
        make_stream(
            f"{stem}/modes", schemas.MODE_PROBABILITIES, STAMPS_NS, metadata=named, probability=modes
        ),
        make_stream(f"{stem}/effective", schemas.EFFECTIVE_PARTICLES, STAMPS_NS, **effective),
        make_stream(
            "/estimates/one/car/skipped",
            schemas.SKIPPED,
            dropped[0],
            log_time_ns=dropped[0] + dropped[1],
            metadata=reasons,
            reason=np.zeros(3, int),
        ),
        make_stream(
            f"{stem}/rewound",
            schemas.REWOUND,
            inserted[0],
            log_time_ns=inserted[0] + inserted[1],
            repeated=REPEATED,
        ),
    ]


def nees(name: str) -> float:
    """NEES of the first step of a run of size one; it is the same at all of them."""
    error = ERRORS[name][0]
    return float(error @ np.linalg.inv(COVARIANCES[name]) @ error)


def position_nees(name: str) -> float:
    error = ERRORS[name][0, :2]
    return float(error @ np.linalg.inv(COVARIANCES[name][:2, :2]) @ error)


def rmse(name: str, *columns: int) -> float:
    """Of the first step of a run of size one."""
    return float(np.linalg.norm(ERRORS[name][0, list(columns)]))
