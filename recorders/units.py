"""Units: their sizes, the endings of names that imply them, and their written form.

Logs need only products of powers of a few names, and the name of a field ends with its unit (`range_m`,
`turn_rate_radps`). A units library would add thousands of units and half a second to every start.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from math import pi
from typing import NamedTuple

from fuselog.recorders.errors import BadInput, choices


class Unit(NamedTuple):
    """The size of a unit in SI units (angles in rad), and the powers of the base units in it."""

    size: float
    powers: Mapping[str, float]


STANDARD_GRAVITY_MPS2 = 9.80665  # by definition
_OF_GRAVITY = {"g": 1, "mg": 1e-3, "ug": 1e-6}
_SIZES: tuple[tuple[dict[str, float], dict[str, float]], ...] = (
    ({"m": 1}, {"m": 1, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "in": 0.0254, "ft": 0.3048}),
    ({"m": 1}, {"mi": 1609.344, "NM": 1852}),
    ({"s": 1}, {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60, "h": 3600}),
    ({"s": -1}, {"Hz": 1}),
    ({"rad": 1}, {"rad": 1, "mrad": 1e-3, "deg": pi / 180, "mdeg": pi / 180e3}),
    ({"rad": 1}, {"arcmin": pi / 180 / 60, "semicircle": pi / 2**31}),
    ({"T": 1}, {"T": 1, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7}),
    ({"m": 1, "s": -2}, {g: size * STANDARD_GRAVITY_MPS2 for g, size in _OF_GRAVITY.items()}),
    ({"m": 1, "s": -1}, {"kn": 1852 / 3600}),
    ({"rad": 1, "s": -1}, {"rpm": 2 * pi / 60}),
    *(({name: 1.0}, {name: 1.0}) for name in ("Pa", "dB", "degC", "%", "bytes")),
)
NAMED = {name: Unit(size, powers) for powers, sizes in _SIZES for name, size in sizes.items()}
# Units by the ending of the name of a field, component, parameter or metric.
ENDINGS = {
    "m": "m", "m2": "m^2", "mm": "mm", "km": "km", "s": "s", "s2": "s^2", "h": "h", "hz": "Hz",
    "rad": "rad", "rad2": "rad^2", "mrad": "mrad", "deg": "deg", "radps": "rad/s", "degps": "deg/s",
    "mps": "m/s", "m2ps2": "m^2/s^2", "mps2": "m/s^2", "ut": "uT", "ut2": "uT^2", "db": "dB", "pa": "Pa",
    "degC": "degC", "percent": "%", "bytes": "bytes", "per_s": "1/s", "per_minute": "1/min",
    "per_m2": "1/m^2", "per_rad": "1/rad", "per_km2_h": "1/(km^2 h)",
}  # fmt: skip
# For each expected unit, the units in which numbers are often given by mistake.
MISTAKEN = {
    "m/s": ("km/h", "ft/s", "mi/h", "kn"), "m": ("ft",), "rad/s": ("deg/s",), "rad": ("deg",),
    "m/s^2": ("g",),
}  # fmt: skip
_ENDING = re.compile(f"(.+?)_({'|'.join(ENDINGS)})")
_ROOTS = {"m^2": "m", "m^2/s^2": "m/s", "uT^2": "uT", "s^2": "s", "rad^2": "rad"}
_FACTOR = re.compile(r"\s*([/*]?)\s*(?:(sqrt)?\(([^()]+)\)|([A-Za-z]+|%))(?:\^?(-?\d))?\s*")
_NUMBER = re.compile(r"\s*(-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)(?:\s+|(?=/))")


def unit(text: str) -> Unit:
    """Parse a unit such as `m/s^2`, `deg/sqrt(h)`, `m s^-2` or `1e-7 deg`.

    Raises BadInput if the text is not a unit.

    >>> unit("km/h").size, unit("0.5 m").size
    (0.2777777777777778, 0.5)
    """
    number = _NUMBER.match(text)
    place, size, powers = (number.end() if number else 0), 1.0, defaultdict[str, float](float)
    while place < len(text):
        found = _FACTOR.match(text, place)
        if not found or (found[4] and found[4] not in NAMED):
            name = found[4] if found else text
            raise BadInput(f"unknown unit '{text}'; {choices(name, NAMED)}")
        factor = NAMED[found[4]] if found[4] else unit(found[3])
        power = (-1 if found[1] == "/" else 1) * int(found[5] or 1) * (0.5 if found[2] else 1)
        size *= factor.size**power
        for name, own in factor.powers.items():
            powers[name] += own * power
        place = found.end()
    if number and float(number[1]) == 0.0:
        raise BadInput(f"the unit '{text}': its number must not be zero")
    return Unit(
        float(number[1]) * size if number else size, {name: own for name, own in powers.items() if own}
    )


def parted(name: str) -> tuple[str, str]:
    """Split the name of a field, component, parameter or metric into the name and its unit.

    >>> parted("clutter_per_m2"), parted("orientation_w")
    (('clutter', '1/m^2'), ('orientation_w', ''))
    """
    found = _ENDING.fullmatch(name)
    return (found[1], ENDINGS[found[2]]) if found else (name, "")


def unit_of(name: str) -> str:
    """Return the unit that a name ends with, or an empty string.

    >>> unit_of("turn_bias_radps"), unit_of("gate_probability")
    ('rad/s', '')
    """
    return parted(name)[1]


def written(unit: str) -> str:
    """Format a unit with superscripts and symbols.

    >>> written("m^2/s^2"), written("uT"), written("deg/s"), written("1/(km^2 h)")
    ('m²/s²', 'µT', 'deg/s', '1/(km² h)')
    """
    raised = re.sub(r"\^(\d)", lambda power: "⁰¹²³⁴⁵⁶⁷⁸⁹"[int(power[1])], unit)
    return raised.replace("uT", "µT").replace("degC", "°C")


def mistaken(unit_: str) -> dict[str, float]:
    """Return units often mistaken for `unit_`, with the factors by which numbers become too large."""
    return {name: unit(unit_).size / unit(name).size for name in MISTAKEN.get(unit_, ())}


def conversion(given: str, name: str, *, is_root: bool = False) -> float:
    """Compute the factor that converts numbers in a unit to the unit of the field or component `name`.

    With `is_root`, the numbers are square roots of the field's values, such as standard deviations for a
    covariance.

    Raises BadInput if the text is not a unit, or if the unit measures another quantity.

    >>> conversion("g", "specific_force_mps2"), conversion("cm", "covariance_m2", is_root=True)
    (9.80665, 0.01)
    """
    wanted = unit_of(name)
    wanted = _ROOTS.get(wanted, wanted) if is_root else wanted
    here, there = unit(given), unit(wanted)
    if here.powers != there.powers:
        is_in = f"is in {wanted}" if wanted else "has no unit"
        raise BadInput(
            f"the unit '{given}' does not fit: {name} {is_in}; give a unit of the same quantity"
        )
    return here.size / there.size
