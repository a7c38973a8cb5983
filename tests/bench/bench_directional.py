"""The Bingham filter in four dimensions against PyRecEst's, step by step on the same measurements.

One predict + update of the paper's evaluation ((61)-(65)). PyRecEst 2.4.2 is no dependency: where it is
not installed, its times are those that we measured once, on a machine of ours (us, one thread).
"""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from fuselog.replay.families.directional.bingham import (
    BinghamNoise,
    Steps,
    make_steps,
    run_bingham_filter,
)
from fuselog.replay.families.directional.distributions import bingham
from fuselog.replay.families.directional.distributions.bingham import Bingham, make_bingham
from tests.bench.timing import median_seconds, seconds

REVERSE = np.eye(4)[::-1]
Z_SYSTEM, Z_MEASUREMENT, Z_START = [-200.0, -200, -2, 0], [-500.0, -500, -500, 0], [-1.0, -1, -1, 0]
STEPS = 100
PYRECEST_STEPS = 10
STORED_US = {"step": 63_700.0, "fit": 22_000.0, "normaliser": 1_070.0}

Row = tuple[str, float, float, float]


def main() -> list[Row]:
    """Rows of (what, our time in us, PyRecEst's, how many times faster)."""
    measured = measurements()
    installed = find_spec("pyrecest") is not None
    theirs = pyrecest_us(measured) if installed else STORED_US
    source = "PyRecEst" if installed else "PyRecEst 2.4.2 as stored"
    moments = bingham.covariance(make_bingham(REVERSE, Z_SYSTEM))
    z = np.array(Z_SYSTEM)
    many_moments, many_z = np.broadcast_to(moments, (1000, 4, 4)), np.broadcast_to(z, (1000, 4))
    ours = {
        "predict + update, 1000 runs of 100 steps": ("step", filter_us(measured, 1000)),
        "predict + update, one log of 2000 steps": ("step", filter_us(np.tile(measured, (20, 1)), 1)),
        "moment fit, batch of 1000": ("fit", us(lambda: bingham.fit(many_moments)) / 1000),
        "moment fit, single": ("fit", us(lambda: bingham.fit(moments))),
        "F and moments, batch of 1000": (
            "normaliser",
            us(lambda: (bingham.log_normaliser(many_z), bingham.square_moments(many_z))) / 1000,
        ),
    }
    return [
        (f"{name}, us; {source}", time, theirs[kind], theirs[kind] / time)
        for name, (kind, time) in ours.items()
    ]


def measurements() -> np.ndarray:
    """Quaternions (STEPS, 4) about (1, 1, 1, 1) / 2, as in the evaluation's second half."""
    x = 0.5 + 0.03 * np.random.default_rng(0).standard_normal((STEPS, 4))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def filter_us(measured: np.ndarray, runs: int) -> float:
    """Our filter, per run and step."""
    noise = BinghamNoise(make_bingham(REVERSE, Z_SYSTEM), make_bingham(REVERSE, Z_MEASUREMENT))
    start = make_bingham(np.eye(4), Z_START)
    state = Bingham(*(np.broadcast_to(part, (runs, *part.shape)) for part in start))
    rows = np.tile(measured, (runs, 1))
    offsets = np.arange(runs + 1) * len(measured)
    steps: Steps = make_steps(offsets, np.tile(np.eye(4)[0], (len(rows), 1)), rows)
    return us(lambda: run_bingham_filter(noise, state, steps)) / len(rows)


def us(work: Callable[[], object]) -> float:
    """The median time of a call."""
    return 1e6 * median_seconds(work)


def pyrecest_us(measured: np.ndarray) -> dict[str, float]:
    """PyRecEst's times of a step, a fit, and a normalisation constant with gradient, uncached."""
    from pyrecest.distributions.hypersphere_subset import bingham_distribution as module
    from pyrecest.filters.bingham_filter import BinghamFilter

    make = module.BinghamDistribution
    system, sensor, start = (
        make(np.array(z), axes)
        for z, axes in ((Z_SYSTEM, REVERSE), (Z_MEASUREMENT, REVERSE), (Z_START, np.eye(4)))
    )
    theirs = BinghamFilter()
    theirs.filter_state = start

    def steps() -> None:
        for z in measured[:PYRECEST_STEPS]:
            theirs.predict_identity(system)
            theirs.update_identity(sensor, z)

    moment = system.moment()

    def fit() -> None:
        module._calculate_F_and_dF_cached.cache_clear()
        make.fit_to_moment(moment)

    def normaliser() -> None:
        module._calculate_F_and_dF_cached.cache_clear()
        module._calculate_F_and_dF_cached(tuple(Z_SYSTEM))

    return {
        "step": seconds(steps) / PYRECEST_STEPS * 1e6,
        "fit": us(fit),
        "normaliser": us(normaliser),
    }
