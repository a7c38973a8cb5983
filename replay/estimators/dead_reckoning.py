"""Dead reckoning of robots: integration of their odometry without any other sensor."""

from fuselog.replay.estimators.landmarks import (
    DRIVE_ERRORS,
    MOTION,
    ODOMETRY,
    POSE,
    START,
    DeadReckoningParameters,
)
from fuselog.replay.inference.all_methods import modelled
from fuselog.replay.inference.model.model import Model

RECKONING = Model(
    "robot pose from odometry only",
    POSE,
    DeadReckoningParameters,
    (),
    MOTION,
    control=ODOMETRY,
    output="pose",
    needs_sensor=False,
    augmentable=DRIVE_ERRORS,
    start=START,
    takes_fixes=False,
)
DEAD_RECKONING = modelled(RECKONING, "ekf")
