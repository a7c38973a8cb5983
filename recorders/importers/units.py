"""Reads units of what others log, such as deg, km/h or m/s^2, as multiples of fuselog's.

A product of powers of a dozen names is all that logs need, and what a field is in stands in its name
(`range_m`, `turn_rate_radps`): a library of units would bring thousands more and half a second of start.
"""

import re
from math import pi, prod
from typing import NamedTuple

from fuselog.recorders.errors import BadInput, choices


class Unit(NamedTuple):
    """Holds a size in SI units (angles in rad), and powers of length, time, angle and flux density."""

    size: float
    powers: tuple[int, ...]


_LENGTH, _TIME, _ANGLE, _FLUX = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
_ACCELERATION, _SPEED, _RATE = (1, -2, 0, 0), (1, -1, 0, 0), (0, -1, 1, 0)
NAMED = {
    **{name: Unit(size, _LENGTH) for name, size in {"m": 1, "mm": 1e-3, "cm": 1e-2, "km": 1e3}.items()},
    **{name: Unit(size, _LENGTH) for name, size in {"ft": 0.3048, "mi": 1609.344, "NM": 1852}.items()},
    "in": Unit(0.0254, _LENGTH),
    **{name: Unit(size, _TIME) for name, size in {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}.items()},
    **{name: Unit(size, _TIME) for name, size in {"min": 60, "h": 3600}.items()},
    **{name: Unit(size, _ANGLE) for name, size in {"rad": 1, "mrad": 1e-3, "deg": pi / 180}.items()},
    "arcmin": Unit(pi / 180 / 60, _ANGLE),
    "semicircle": Unit(pi / 2**31, _ANGLE),
    **{name: Unit(size, _FLUX) for name, size in {"T": 1, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9}.items()},
    **{name: Unit(size, _FLUX) for name, size in {"G": 1e-4, "mG": 1e-7}.items()},
    **{name: Unit(size * 9.80665, _ACCELERATION) for name, size in {"g": 1, "mg": 1e-3}.items()},
    "kn": Unit(1852 / 3600, _SPEED),
    "rpm": Unit(2 * pi / 60, _RATE),
}
# What the end of a field's or component's name says; a covariance is of what its square root is in.
_ENDINGS = {
    "m": "m", "m2": "m", "mps": "m/s", "m2ps2": "m/s", "mps2": "m/s^2", "rad": "rad", "radps": "rad/s",
    "deg": "deg", "ut": "uT", "ut2": "uT", "s": "s",
}  # fmt: skip
_FACTOR = re.compile(r"\s*([/*]?)\s*([A-Za-z]+)(?:\^?(-?\d))?\s*")
_NUMBER = re.compile(r"\s*(-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)\s+")


def unit(text: str) -> Unit:
    """Return the unit that a text such as `m/s^2`, `deg/s`, `m s^-2` or `1e-7 deg` names.

    Raises BadInput if it names none.

    >>> unit("km/h").size, unit("0.5 m").size
    (0.2777777777777778, 0.5)
    """
    number = _NUMBER.match(text)
    place, factors = (number.end() if number else 0), []
    while place < len(text):
        found = _FACTOR.match(text, place)
        if not found or found[2] not in NAMED:
            name = found[2] if found else text
            raise BadInput(f"no unit '{text}'; {choices(name, NAMED)}")
        sign = -1 if found[1] == "/" else 1
        factors.append((NAMED[found[2]], sign * int(found[3] or 1)))
        place = found.end()
    powers = tuple(
        sum(power * each.powers[index] for each, power in factors) for index in range(len(_LENGTH))
    )
    size = prod(each.size**power for each, power in factors)
    return Unit(float(number[1]) * size if number else size, powers)


def unit_of(name: str) -> str:
    """Return the unit of a field or component by its name; empty where it has no unit.

    >>> unit_of("specific_force_mps2"), unit_of("orientation_w")
    ('m/s^2', '')
    """
    return _ENDINGS.get(name.rpartition("_")[2], "") if "_" in name else ""


def conversion(given: str, name: str) -> float:
    """Return by what numbers in a unit are multiplied for the field or component `name`.

    Raises BadInput where the unit is none, or of another kind of quantity.

    >>> conversion("g", "specific_force_mps2")
    9.80665
    """
    wanted = unit_of(name)
    here, there = unit(given), unit(wanted)
    if here.powers != there.powers:
        is_in = f"is in {wanted}" if wanted else "has no unit"
        raise BadInput(f"the unit '{given}' does not fit: {name} {is_in}; give a unit of that kind")
    return here.size / there.size
