"""The car of the sheet of sensors, section 3, with four ordinary faults at once.

`python -m tests.pipeline.several_faults` diagnoses 600 s, by the wheels alone and with a gyro.
"""

import time
from dataclasses import replace

import numpy as np

import fuselog as fl
from fuselog.pipeline.diagnosing.battery.car import (
    drive,
    late,
    lever,
    recorded,
)
from fuselog.pipeline.diagnosing.likelihood import Likelihood
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.simulators.car import stamps_ns

GYRO = "/car/turn_rate"
OPEN = {"kind": "ekf", "gate_probability": 1.0}
PLANTED = {
    "forward_scale": 1.0 / 1.03,
    "turn_bias_radps": -0.01,
    "fix_delay_s": 0.25,
    "lever_x_m": 0.40,
    "lever_y_m": -0.15,
}


def several(
    seed: int, duration_s: float, *, has_gyro: bool, has_prior: bool = False, **noise: float
) -> fl.MemorySource:
    """Wheels x 1.03, turn rates 0.01 rad/s too large, fixes 0.25 s late, a lever arm not given."""
    car = late(0.25)(lever(0.40, -0.15)(drive(seed, duration_s=duration_s, **noise)))
    car = car._replace(speed_mps=1.03 * car.speed_mps, turn_radps=car.turn_radps + 0.01)
    log = recorded(car, has_compass=False, has_prior=has_prior)
    if not has_gyro:
        return log
    zero = np.zeros_like(car.turn_radps)
    gyro = fl.make_stream(
        GYRO,
        fl.schemas.INERTIAL_SAMPLE,
        stamps_ns(car.odometry_s),
        metadata={"turn_noise_density": repr(car.turn_density)},
        specific_force_mps2=np.zeros((len(zero), 3)),
        turn_rate_radps=np.stack([zero, zero, car.turn_radps], axis=1),
        magnetic_field_ut=np.empty((len(zero), 0)),
    )
    return replace(log, streams={**log.streams, GYRO: gyro})


def lost_by(log: fl.MemorySource, settings: dict[str, float]) -> float:
    """By how much the log-likelihood with settings is below that of the planted values."""
    likelihood = Likelihood()
    likelihood.begin(Trial("ekf", [log], OPEN))
    planted, found = likelihood([Trial("ekf", [log], {**OPEN, **each}) for each in (PLANTED, settings)])
    return planted - found


if __name__ == "__main__":
    for has_gyro in (False, True):
        source = several(1, 600.0, has_gyro=has_gyro)
        begin = time.process_time()
        print(fl.diagnose(source, "ekf"))
        print(f"{time.process_time() - begin:.1f} s of processor time\n")
