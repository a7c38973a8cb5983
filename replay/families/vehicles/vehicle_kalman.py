"""Tracking of every vehicle by its own fixes with a Kalman filter, which knows their association."""

from fuselog.replay.families.vehicles.vehicle_model import VEHICLE
from fuselog.replay.inference.all_methods import modelled

VEHICLE_KALMAN = modelled(VEHICLE, "ekf")
