"""Fit of an ellipsoid to the readings of a constant vector by a rotating unit.

A sensor reads m = A^-1 u + b + n for a vector u of known length, with isotropic noise n. The length
determines b and the symmetric A by maximum likelihood, but not a rotation of the sensor's axes.
Vasconcelos et al., IEEE T-AES 2011, describe sets of readings that do not determine all parameters.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from fuselog.pipeline.tuning.information import Undetermined, undetermined
from fuselog.replay.engine.arrays import Floats

AXES = "xyz"
PAIRS = (0, 1), (0, 2), (1, 2)
NAMES = (
    *(f"offset_{axis}" for axis in AXES),
    *(f"scale_{axis}" for axis in AXES),
    *(f"cross_{AXES[first]}{AXES[second]}" for first, second in PAIRS),
)
START = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
USEFUL = 0.01  # relative to the length: the standard error that a calibration should reach
_WIDE = 1.0  # relative to the length: largest change of a value from its start
_OF_A_CONIC = 5  # largest number of values that readings in a plane determine
_STEP = 1e-6  # step of the finite differences
_LEAST_SIGMA = 1e-9  # relative to the length
# relative to the spread in the plane; readings of rotations about one axis deviate less from the plane
_FLAT = 0.1


class Fit(NamedTuple):
    """The ellipsoid of readings, in units of the vector's length, relative to the readings' middle.

    Attributes:
        numbers: (9,) the parameters, in the order of `NAMES`.
        covariance: (9, 9) covariance of the determined parameters; meaningless for the others.
        lacking: the parameters that the readings do not determine.
        turned_about: the coordinate axis closest to the axis of rotation if there was only one such
            axis; otherwise empty.
        sigma: the standard deviation of the noise.
        correlation: correlation of the noise between successive readings.
    """

    numbers: Floats
    covariance: Floats
    lacking: Undetermined
    turned_about: str
    sigma: float
    correlation: float


def matrix_of(values: Floats) -> Floats:
    """Make the symmetric matrix A (3, 3) from the parameters (9,)."""
    matrix = np.diag(values[3:6])
    for (row, column), value in zip(PAIRS, values[6:], strict=True):
        matrix[row, column] = matrix[column, row] = value
    return matrix


def middle(readings: Floats) -> tuple[Floats, float]:
    """Compute the middle (3,) of readings (n, 3), and the median distance of readings from it."""
    place = 0.5 * (readings.min(axis=0) + readings.max(axis=0))
    return place, float(np.median(np.linalg.norm(readings - place, axis=1)))


def fit(readings: Floats) -> Fit:
    """Fit an ellipsoid to readings (n, 3), in units of the length of the measured vector.

    >>> rng = np.random.default_rng(1)
    >>> directions = rng.standard_normal((500, 3))
    >>> directions /= np.linalg.norm(directions, axis=1)[:, None]
    >>> found = fit(directions / 1.02 + [0.3, 0.0, -0.1])
    >>> found.numbers[:4].round(3).tolist(), found.lacking.places
    ([0.3, 0.0, -0.1, 1.02], [])
    """
    spreads, axes = np.linalg.eigh(np.cov(readings.T))
    is_flat = bool(spreads[0] < _FLAT**2 * spreads[2])
    near, normal = middle(readings)[0], axes[:, 0]
    starts, directions = [START, np.concatenate([near, START[3:]])], np.eye(len(START))
    if is_flat:  # without this, noise across the plane would look like the thickness of an ellipsoid
        readings = readings - np.outer((readings - readings.mean(axis=0)) @ normal, normal)
        starts = [
            np.concatenate([near + normal, START[3:] / np.sqrt(2.0)])
        ]  # start from a sphere through a circle
        derivatives = _derivatives(starts[0], readings)
        directions = np.linalg.svd(derivatives, full_matrices=False)[2][:_OF_A_CONIC]
    values, left, sigma = START, np.zeros(len(readings)), 0.0
    for _ in range(2):  # the second fit uses the noise that the first one estimated
        searches = [_search(start, directions, readings, sigma) for start in starts]
        values = searches[int(np.argmin([cost for cost, _ in searches]))][1]
        left = _distances(values, readings) - sigma**2
        sigma = max(float(np.sqrt(left @ left / (len(left) - len(START)))), _LEAST_SIGMA)
    correlation = float(left[1:] @ left[:-1]) / max(float(left @ left), _LEAST_SIGMA**2)
    if correlation < 2.0 / np.sqrt(len(left)):
        correlation = 0.0
    derivatives = _derivatives(values, readings) / sigma
    information = derivatives.T @ derivatives * (1.0 - correlation) / (1.0 + correlation)
    lacking = undetermined(USEFUL**2 * information)
    about = AXES[int(np.argmax(np.abs(normal)))] if is_flat else ""
    covariance = np.linalg.inv(information + np.eye(len(START)) / _WIDE**2).astype(np.float64)
    return Fit(values, covariance, lacking, about, sigma, correlation)


def _distances(values: Floats, readings: Floats) -> Floats:
    """Compute the distances (n,) of readings from an ellipsoid to first order, positive outside."""
    matrix = matrix_of(values)
    vectors = (readings - values[:3]) @ matrix
    lengths = np.linalg.norm(vectors, axis=1)
    gradients = np.linalg.norm(vectors @ matrix, axis=1) / lengths
    found: Floats = (lengths - 1.0) / gradients
    return found


def _derivatives(values: Floats, readings: Floats) -> Floats:
    """Compute the derivatives (n, 9) of the distances with respect to the parameters."""
    steps = _STEP * np.eye(len(START))
    ways = [_distances(values + step, readings) - _distances(values - step, readings) for step in steps]
    return np.stack(ways, axis=1) / (2.0 * _STEP)


def _search(start: Floats, directions: Floats, readings: Floats, sigma: float) -> tuple[float, Floats]:
    """Minimise the cost from a start (9,) along directions (m, 9), under a wide prior.

    The surface is curved, so noise along it moves readings outwards on average, by the noise's variance
    `sigma`^2, which is subtracted from the distances.
    """

    def residuals(along: Floats) -> Floats:
        values = start + along @ directions
        distances = _distances(values, readings) - sigma**2
        return np.concatenate([distances / max(sigma, USEFUL), (values - START) / _WIDE])

    found = least_squares(residuals, np.zeros(len(directions)))
    return float(found.cost), start + found.x @ directions
