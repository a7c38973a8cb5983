"""Has the car whose calibration is to be found: what errs, and how a model calls it.

Scales and the bias are of the readings by the motion here; the model's, of the motion by the readings,
are in `OURS`.
"""

from typing import Any

import numpy as np

from fuselog.recorders.log import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.recorders.simulators.car import Car, CarParameters, Floats, philox, streams_of
from fuselog.recorders.simulators.car import drive as simulated
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

# speed's and turn rate's factor, turn rate's bias, lever, delay of fixes, angle of the compass
TRUTH = np.array([1.03, 0.98, 0.01, 1.2, -0.4, 0.15, 0.05])
# the same as the model has them
OURS = np.array([1.0 / TRUTH[0], 1.0 / TRUTH[1], -TRUTH[2] / TRUTH[1], *TRUTH[3:]])
ERRORS = (
    *("forward_factor", "turn_factor", "turn_error_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "compass_error_rad"),
)
NAMES = (
    *("forward_scale", "turn_scale", "turn_bias_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "bias_heading_rad"),
)
WIDE = {"prior_sigma_m": 1000.0, "prior_sigma_rad": 1.0}  # tells nothing of where it begins


def drive(seed: int | None, errors: Floats = TRUTH, **changed: Any) -> Car:
    """Simulate a drive of the car, and what its sensors measure.

    Args:
        seed: of the noise and of the first pose; without one there is no noise, and the car starts at
            zero.
        errors: (7,), what is wrong with the sensors, as `TRUTH` has it.
        changed: parameters of the car.

    Returns:
        What was measured, with its stamps.
    """
    wrong = dict(zip(ERRORS, errors.tolist(), strict=True))
    return simulated(CarParameters(**{**wrong, **changed}), None if seed is None else philox(seed))


def recorded(car: Car) -> MemorySource:
    """Return the car as a log, whose prior is about the origin."""
    return memory_source(Recording(streams_of(car)), RunMetadata("car C", epoch_ns=0))
