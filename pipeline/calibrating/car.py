"""The simulated car whose calibration is estimated: errors of its sensors, and their names in a model.

Scales and the bias of `TRUTH` describe readings relative to the motion. Those of `OURS` describe the
motion relative to readings, as in the model.
"""

from typing import Any

import numpy as np

from fuselog.recorders.log import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.recorders.simulators.car import Car, CarParameters, Floats, philox, streams_of
from fuselog.recorders.simulators.car import drive as simulated
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

# factors of speed and turn rate, bias of the turn rate, lever arm, delay of fixes, compass angle
TRUTH = np.array([1.03, 0.98, 0.01, 1.2, -0.4, 0.15, 0.05])
# the same in the model's convention
OURS = np.array([1.0 / TRUTH[0], 1.0 / TRUTH[1], -TRUTH[2] / TRUTH[1], *TRUTH[3:]])
ERRORS = (
    *("forward_factor", "turn_factor", "turn_error_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "compass_error_rad"),
)
NAMES = (
    *("forward_scale", "turn_scale", "turn_bias_radps"),
    *("lever_x_m", "lever_y_m", "fix_delay_s", "bias_heading_rad"),
)
WIDE = {
    "prior_sigma_m": 1000.0,
    "prior_sigma_rad": 1.0,
}  # a prior so wide that it has no influence on the start


def drive(seed: int | None, errors: Floats = TRUTH, **changed: Any) -> Car:
    """Simulate a drive of the car and the measurements of its sensors.

    Args:
        seed: the seed of the noise and of the first pose. Without a seed, there is no noise, and the
            car starts at zero.
        errors: (7,), the sensors' errors, in the order of `TRUTH`.
        changed: parameters of the car that differ from their defaults.

    Returns:
        The measurements with their stamps.
    """
    wrong = dict(zip(ERRORS, errors.tolist(), strict=True))
    return simulated(CarParameters(**{**wrong, **changed}), None if seed is None else philox(seed))


def recorded(car: Car) -> MemorySource:
    """Make a log of a drive, with a prior around the origin."""
    return memory_source(Recording(streams_of(car)), RunMetadata("car C", epoch_ns=0))
