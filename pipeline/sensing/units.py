"""Reads units of noise: what a column's is, and those in which data sheets state it."""

import math
import re

from fuselog.recorders.errors import BadInput

# How a field's name ends, and its unit.
SUFFIXES = {
    "radps": "rad/s",
    "mps2": "m/s^2",
    "mps": "m/s",
    "ut": "uT",
    "rad": "rad",
    "m": "m",
    "s": "s",
}
_DEGREE, _GRAVITY = math.pi / 180, 9.80665
_QUANTITIES = {
    "rad": ("rad/s", 1.0),
    "deg": ("rad/s", _DEGREE),
    "mdeg": ("rad/s", 1e-3 * _DEGREE),
    "g": ("m/s^2", _GRAVITY),
    "mg": ("m/s^2", 1e-3 * _GRAVITY),
    "ug": ("m/s^2", 1e-6 * _GRAVITY),
}
# Units by what they state: the column's unit, white noise or walk, and how many of ours one is.
UNITS: dict[str, tuple[str, str, float]] = {
    "m/s^2/sqrt(Hz)": ("m/s^2", "white", 1.0),
    "m/s/sqrt(s)": ("m/s^2", "white", 1.0),
    "m/s/sqrt(h)": ("m/s^2", "white", 1 / 60),
    "m/s^3/sqrt(Hz)": ("m/s^2", "walk", 1.0),
    "m/s^2/sqrt(s)": ("m/s^2", "walk", 1.0),
    "m/s^2*sqrt(Hz)": ("m/s^2", "walk", 1.0),
}
for _name, (_unit, _factor) in _QUANTITIES.items():
    if _unit == "rad/s":
        UNITS |= {
            f"{_name}/s/sqrt(Hz)": (_unit, "white", _factor),
            f"{_name}/sqrt(s)": (_unit, "white", _factor),
            f"{_name}/sqrt(h)": (_unit, "white", _factor / 60),
            f"{_name}/h/sqrt(Hz)": (_unit, "white", _factor / 3600),
            f"{_name}/s^2/sqrt(Hz)": (_unit, "walk", _factor),
            f"{_name}/s/sqrt(s)": (_unit, "walk", _factor),
            f"{_name}/s*sqrt(Hz)": (_unit, "walk", _factor),
            f"{_name}/h/sqrt(h)": (_unit, "walk", _factor / 3600 / 60),
        }
    else:
        UNITS[f"{_name}/sqrt(Hz)"] = (_unit, "white", _factor)
        UNITS[f"{_name}/sqrt(s)"] = (_unit, "walk", _factor)


def unit_of(field: str) -> str:
    """Return the unit that a field's name states; empty where it states none that is known."""
    return SUFFIXES.get(field.rpartition("_")[2], "")


def parse_sheet(field: str, text: str) -> tuple[str, float]:
    """Return what a data sheet states, as `white` or `walk` and a number in our units.

    A one-sided density, as spectrum analysers show it, is sqrt(2) times the two-sided one.

    Raises BadInput where the text is no number with a unit, or the unit is another quantity's.
    """
    found = re.fullmatch(r"\s*(\S+)\s+(.*?)\s*(one-sided)?\s*", text)
    try:
        value = float(found[1]) if found else math.nan
    except ValueError:
        value = math.nan
    written = found[2].replace(" ", "").replace("°", "deg").replace("µ", "u") if found else ""
    if not (0 < value < math.inf) or written not in UNITS:
        raise BadInput(
            f"--sheet {field}={text}: expected a number and a unit, as '0.007 deg/s/sqrt(Hz)', of: "
            f"{', '.join(UNITS)}"
        )
    quantity, term, factor = UNITS[written]
    if unit_of(field) and quantity != unit_of(field):
        raise BadInput(
            f"--sheet {field}={text}: {field} is in {unit_of(field)}, and {written} is a unit for "
            f"{quantity}; give one for {unit_of(field)}"
        )
    return term, value * factor / (math.sqrt(2) if found and found[3] else 1.0)
