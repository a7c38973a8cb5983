"""Orientation by common methods: Madgwick's, Mahony's, and VQF by Laidig and Seel.

These methods are baselines for filters. They estimate no covariance, so a covariance is assumed.
Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor arrays", 2010;
Mahony, Hamel, Pflimlin, "Nonlinear Complementary Filters on the Special Orthogonal Group", IEEE
Transactions on Automatic Control 53(5), 2008; VQF is the unchanged library of its authors. The default
gains and parameters are the authors' own. Quaternions rotate vectors from body axes to east, north, up.
Estimates begin with the first sample.
"""

from typing import Any, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import schemas
from fuselog.recorders.models.inertial import cross, into_body, into_plane, product, triad, unit
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.api.functions import batch, each_run
from fuselog.replay.engine.api.inputs import Given, Messages, OneRun
from fuselog.replay.engine.api.outputs import Estimates, Results
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.families.directional.orientation.estimators import (
    FIELDS,
    ORIENTATION,
    of_inertial_samples,
)
from fuselog.replay.families.directional.orientation.magnetometers import REFUSAL, with_magnetometer
from fuselog.replay.families.directional.orientation.resting import of_nine_axes

HALF = np.sqrt(0.5)


class AssumedParameters(Parameters):
    """Assumed uncertainty of a method that estimates no covariance.

    Attributes:
        sigma_deg: standard deviation about each axis.
    """

    sigma_deg: PositiveFloat = 3.0

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the rotation vector (3, 3), rad^2."""
        return np.radians(self.sigma_deg) ** 2 * np.eye(3)


class MadgwickParameters(AssumedParameters):
    """Gain of the filter; the default is the author's value for a nine-axis unit.

    Attributes:
        gain: step along the normalized gradient, in rad/s.
    """

    gain: NonNegativeFloat = 0.041


class MahonyParameters(AssumedParameters):
    """Gains of the corrections of orientation and bias.

    Attributes:
        gain: gain of the orientation correction, in 1/s.
        bias_gain: gain of the bias correction, in 1/s^2.
    """

    gain: NonNegativeFloat = 1.0
    bias_gain: NonNegativeFloat = 0.3


class VqfParameters(AssumedParameters):
    """Time constants of VQF.

    Attributes:
        inclination_s: time constant of the inclination correction.
        heading_s: time constant of the heading correction.
    """

    inclination_s: PositiveFloat = 3.0
    heading_s: PositiveFloat = 9.0


class ComplementarySettings(NamedTuple):
    """Gains, and the assumed covariance (3, 3)."""

    gain: float
    bias_gain: float
    covariance: Floats


class ComplementaryState(NamedTuple):
    """Orientations (runs, 4), zero before the first sample; biases; time stamps."""

    orientation: Floats
    bias: Floats
    time_ns: Integers


def start(given: Given[Any]) -> tuple[ComplementarySettings, ComplementaryState]:
    """Return the settings, and a state with unknown orientations."""
    values = given.parameters
    settings = ComplementarySettings(values.gain, getattr(values, "bias_gain", 0.0), values.covariance)
    return settings, ComplementaryState(
        np.zeros((given.runs, 4)), np.zeros((given.runs, 3)), np.zeros(given.runs, int)
    )


def follow_madgwick(
    run: int,
    settings: ComplementarySettings,
    messages: Messages,
    state: ComplementaryState,
    results: Results,
) -> None:
    """Integrate the gyro and take a gradient step that aligns gravity and magnetic field."""
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        force, rate, field = unit_vectors(messages.value[row])
        if not can_follow(run, force, rate, field, state):
            continue
        q = began(run, messages, row, state)
        duration_s = (messages.time_ns[row] - state.time_ns[run]) * 1e-9
        # in the paper, x points north, see (46)
        w, x, y, z = product((HALF, 0.0, 0.0, -HALF), q)
        across, ahead, up = into_plane((w, x, y, z), field)
        north = np.sqrt(across * across + ahead * ahead)
        gravity = (
            2 * (x * z - w * y) - force[0],
            2 * (w * x + y * z) - force[1],
            1 - 2 * (x * x + y * y) - force[2],
        )
        a, b, c = gravity
        d = north * (1 - 2 * (y * y + z * z)) + 2 * up * (x * z - w * y) - field[0]
        e = 2 * north * (x * y - w * z) + 2 * up * (w * x + y * z) - field[1]
        f = 2 * north * (w * y + x * z) + up * (1 - 2 * (x * x + y * y)) - field[2]
        # the transpose of the Jacobians (26) and (33)
        gw = -2 * y * a + 2 * x * b - 2 * up * y * d + 2 * (up * x - north * z) * e + 2 * north * y * f
        gx = 2 * z * a + 2 * w * b - 4 * x * c + 2 * up * z * d + 2 * (north * y + up * w) * e
        gx += 2 * (north * z - 2 * up * x) * f
        gy = -2 * w * a + 2 * z * b - 4 * y * c - 2 * (2 * north * y + up * w) * d
        gy += 2 * (north * x + up * z) * e + 2 * (north * w - 2 * up * y) * f
        gz = 2 * x * a + 2 * y * b + 2 * (up * x - 2 * north * z) * d
        gz += 2 * (up * y - north * w) * e + 2 * north * x * f
        length = np.sqrt(gw * gw + gx * gx + gy * gy + gz * gz)
        gain = settings.gain / length if length > 0.0 else 0.0
        dw, dx, dy, dz = product((w, x, y, z), (0.0, 0.5 * rate[0], 0.5 * rate[1], 0.5 * rate[2]))
        w, x = w + duration_s * (dw - gain * gw), x + duration_s * (dx - gain * gx)
        y, z = y + duration_s * (dy - gain * gy), z + duration_s * (dz - gain * gz)
        keep(run, messages, row, product((HALF, 0.0, 0.0, HALF), (w, x, y, z)), settings, state, results)


def follow_mahony(
    run: int,
    settings: ComplementarySettings,
    messages: Messages,
    state: ComplementaryState,
    results: Results,
) -> None:
    """Integrate the gyro minus its bias, corrected towards gravity and magnetic field, by (48)."""
    bias = state.bias[run]
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        force, rate, field = unit_vectors(messages.value[row])
        if not can_follow(run, force, rate, field, state):
            continue
        q = began(run, messages, row, state)
        duration_s = (messages.time_ns[row] - state.time_ns[run]) * 1e-9
        up = into_body(q, (0.0, 0.0, 1.0))
        east, north, above = into_plane(q, field)
        ahead = into_body(q, (0.0, np.sqrt(east * east + north * north), above))
        a, b = cross(force, up), cross(field, ahead)
        x, y, z = a[0] + b[0], a[1] + b[1], a[2] + b[2]
        bias[0] -= settings.bias_gain * x * duration_s
        bias[1] -= settings.bias_gain * y * duration_s
        bias[2] -= settings.bias_gain * z * duration_s
        wx = 0.5 * (rate[0] - bias[0] + settings.gain * x)
        wy = 0.5 * (rate[1] - bias[1] + settings.gain * y)
        wz = 0.5 * (rate[2] - bias[2] + settings.gain * z)
        dw, dx, dy, dz = product(q, (0.0, wx, wy, wz))
        moved = (
            q[0] + duration_s * dw,
            q[1] + duration_s * dx,
            q[2] + duration_s * dy,
            q[3] + duration_s * dz,
        )
        keep(run, messages, row, moved, settings, state, results)


def unit_vectors(value: Floats) -> Any:
    """Return the direction of the specific force, the turn rate, and the direction of the field.

    If the field is not finite, as between two samples of a slower magnetometer, its direction is zero
    and causes no correction.
    """
    rate = value[3], value[4], value[5]
    if not np.isfinite(value[6] + value[7] + value[8]):
        return unit(value[:3]), rate, (0.0, 0.0, 0.0)
    return unit(value[:3]), rate, unit(value[6:])


def can_follow(run: int, force: Any, rate: Any, field: Any, state: ComplementaryState) -> bool:
    """Test whether a sample has a finite force and turn rate and, if it is the first, a finite field."""
    if not np.isfinite(force[0] + force[1] + force[2] + rate[0] + rate[1] + rate[2]):
        return False
    q = state.orientation[run]
    is_blank = q[0] == 0.0 and q[1] == 0.0 and q[2] == 0.0 and q[3] == 0.0
    return not (is_blank and field[0] == 0.0 and field[1] == 0.0 and field[2] == 0.0)


def began(run: int, messages: Messages, row: int, state: ComplementaryState) -> Any:
    """Return the current orientation; initialize it from the force and field of the first sample."""
    q = state.orientation[run]
    if q[0] == 0.0 and q[1] == 0.0 and q[2] == 0.0 and q[3] == 0.0:
        q[0], q[1], q[2], q[3] = triad(messages.value[row, :3], messages.value[row, 6:])
        state.time_ns[run] = messages.time_ns[row]
    return q[0], q[1], q[2], q[3]


def keep(
    run: int,
    messages: Messages,
    row: int,
    q: Any,
    settings: ComplementarySettings,
    state: ComplementaryState,
    results: Results,
) -> None:
    """Normalize an orientation, and write it to the state and the results."""
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for part in range(4):
        state.orientation[run, part] = q[part] / length
        results.mean[row, part] = q[part] / length
    results.covariance[row] = settings.covariance
    state.time_ns[run] = messages.time_ns[row]


def solve_vqf(streams: OneRun, parameters: VqfParameters) -> Estimates:
    """Return the library's estimate at every stamp, assuming evenly spaced samples.

    Raises BadInput if the library is not installed.
    """
    try:
        from vqf import VQF
    except ImportError:
        raise BadInput("estimator vqf needs the package vqf; run pip install vqf") from None
    samples = streams["inertial"]
    is_last = (
        np.diff(samples.publish_time_ns, append=-1) != 0
    )  # samples with equal stamps have their mean
    force, rate, field = (np.ascontiguousarray(samples[name][is_last]) for name in FIELDS)
    time_ns = samples.publish_time_ns[is_last]
    step_s, has_field = float(np.median(np.diff(time_ns))) * 1e-9, np.isfinite(field).all(axis=1)
    if not has_field.any():
        raise BadInput(f"topic {samples.topic}: {REFUSAL}")
    slower = len(has_field) / int(has_field.sum())
    vqf = VQF(
        step_s,
        magTs=slower * step_s,
        tauAcc=parameters.inclination_s,
        tauMag=parameters.heading_s,
    )
    if has_field.all():
        mean = vqf.updateBatch(rate, force, field)["quat9D"]
    else:
        mean = np.empty((len(rate), 4))
        for row in range(len(rate)):
            vqf.update(rate[row], force[row])
            if has_field[row]:
                vqf.updateMag(field[row])
            mean[row] = vqf.getQuat9D()
    return Estimates(time_ns, mean, np.tile(parameters.covariance, (len(mean), 1, 1)))


MADGWICK = of_nine_axes(
    of_inertial_samples(
        "Madgwick's gradient-descent filter for orientation",
        MadgwickParameters,
        start,
        follow=follow_madgwick,
    )
)
MAHONY = of_nine_axes(
    of_inertial_samples(
        "Mahony's complementary filter for orientation and gyro bias",
        MahonyParameters,
        start,
        follow=follow_mahony,
    )
)
VQF = with_magnetometer(
    batch(
        "VQF by Laidig and Seel, from the package vqf",
        parameters=VqfParameters,
        streams={"inertial": schemas.INERTIAL_SAMPLE},
        static={},
        components=ORIENTATION,
        truth="truth",
        solve=each_run(solve_vqf),
    )
)
