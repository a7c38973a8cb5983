"""Checks of magnetic fields: their unit, and iron near the sensor, from the fields in a full turn."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, digits
from fuselog.recorders.log import Stream, schemas

Floats = NDArray[np.float64]
FIELD = "magnetic_field_ut"
FEWEST = 50
EARTH_UT = (22.0, 67.0)
UNITS_UT = {"G": 100.0, "T": 1e6, "mT": 1e3, "mG": 0.1, "nT": 1e-3}
SECTORS = 12  # sectors of a turn, which all have to be covered
FLAT = 0.05  # largest ratio of the third spread to the second, in a turn about one axis
ROUNDING = 1e-6  # relative to the radius: smaller offsets are ignored
HARD, SOFT = 0.2, 1.1  # the centre in radii; the ratio of the axes
SCATTER = 0.1  # about the ellipse, relative to the radius


def units(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find measurements of the Earth's magnetic field in a wrong unit, or normalised."""
    field = _field(stream)
    if field is None:
        return
    norm = float(np.median(np.linalg.norm(field, axis=1)))
    if EARTH_UT[0] <= norm <= EARTH_UT[1] or not norm:
        return
    given = next((unit for unit, ut in UNITS_UT.items() if EARTH_UT[0] <= norm * ut <= EARTH_UT[1]), "")
    factor = UNITS_UT.get(given, 0.0)
    what = f"is in {given}" if given else "is in an unknown unit, or normalised, or affected by iron"
    yield Finding(
        "magnetometer",
        stream.topic,
        FIELD,
        1.0 / factor if given else norm,
        f"{stream.topic}: {FIELD} {what}: its median length is {norm:.3g}, but the Earth's field "
        f"has {EARTH_UT[0]:g} to {EARTH_UT[1]:g} uT",
        f"{stream.topic}.magnetic_field_scale={digits(factor)}" if given else "",
        f'units.{FIELD} = "{given}" in the mapping'
        if given
        else "calibrate it; until then, only its direction is usable",
        "likely" if given else "hint",
    )


def iron(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find fields whose path in a full turn is off the centre (hard iron) or an ellipse (soft iron)."""
    field = _field(stream)
    circle = None if field is None else ellipse(field)
    if circle is None:
        return
    share = float(np.linalg.norm(circle.centre)) / circle.radius
    if share > HARD:
        is_off = np.abs(circle.centre) > ROUNDING * circle.radius
        offsets = ", ".join(f"{each:.4g}" for each in np.where(is_off, -circle.centre, 0.0))
        axis = int(np.argmax(np.abs(circle.centre)))
        yield Finding(
            "magnetometer",
            stream.topic,
            FIELD,
            share,
            f"{stream.topic}: hard iron: in a full turn, the centre of {FIELD} is {share:.2g} of the "
            f"radius, {circle.radius:.3g} uT, away from zero",
            f"{stream.topic}.magnetic_field_{'xyz'[axis]}_bias={digits(float(circle.centre[axis]))}",
            f"offsets.{FIELD} = [{offsets}] in the mapping",
        )
    elif circle.ratio > SOFT:
        yield Finding(
            "magnetometer",
            stream.topic,
            FIELD,
            circle.ratio,
            f"{stream.topic}: soft iron: in a full turn, {FIELD} follows an ellipse with axes of "
            f"{circle.ratio:.3g} to 1",
            otherwise="calibrate its axes",
        )


class Ellipse(NamedTuple):
    """The path of a field in a turn: its centre (3,), mean radius and ratio of axes."""

    centre: Floats
    radius: float
    ratio: float


def ellipse(field: Floats) -> Ellipse | None:
    """Fit the ellipse of a full turn about one axis by least squares; return None without a turn."""
    mean = field.mean(axis=0)
    spreads, axes = np.linalg.eigh(np.cov((field - mean).T))
    if spreads[1] <= 0.0 or spreads[0] > FLAT * spreads[1]:
        return None
    plane = axes[:, 1:]
    size = float(np.sqrt(spreads.sum()))
    x, y = ((field - mean) @ plane / size).T
    (a, b, c, d, e), *_ = np.linalg.lstsq(
        np.stack([x * x, x * y, y * y, x, y], axis=1), np.ones(len(x)), rcond=None
    )
    form = np.array([[a, 0.5 * b], [0.5 * b, c]])
    if np.linalg.eigvalsh(form)[0] <= 0.0:
        return None
    middle = -0.5 * np.linalg.solve(form, [d, e])
    scaled = np.linalg.eigvalsh(form / (1.0 + middle @ form @ middle))
    radii = size / np.sqrt(scaled)
    offset = np.stack([x, y], axis=1) - middle
    sector = np.floor(SECTORS * (np.arctan2(offset[:, 1], offset[:, 0]) / (2.0 * np.pi) + 0.5)).astype(
        int
    )
    length = np.sqrt(np.einsum("ni,ij,nj->n", offset, form, offset) / (1.0 + middle @ form @ middle))
    if len(np.unique(sector % SECTORS)) < SECTORS or np.std(length) > SCATTER:
        return None
    centre = plane @ (plane.T @ mean + size * middle)
    return Ellipse(centre, float(radii.mean()), float(radii[0] / radii[1]))


def _field(stream: Stream) -> Floats | None:
    """Return the known fields (n, 3), or None if there are too few."""
    known = {schemas.INERTIAL_SAMPLE.full_name, schemas.MAGNETIC_FIELD.full_name}
    if stream.schema.full_name not in known or stream[FIELD].shape[1] != 3:
        return None
    field = stream[FIELD][np.isfinite(stream[FIELD]).all(axis=1)]
    return field if len(field) >= FEWEST else None
