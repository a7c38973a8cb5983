"""Conversion of logged numbers to stamps that are exact to the nanosecond."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput

Stamps = NDArray[np.int64]
# The value of a missing stamp.
NOT_A_TIME = np.iinfo(np.int64).min
# A double near 2^63 is exact to 1024.
BEYOND = 2.0**63 - 2**12


def to_ns(
    values: ArrayLike,
    unit_ns: int,
    since_ns: int | Stamps = 0,
    *,
    where: str,
    remedy: str = "correct them, or leave them out",
) -> Stamps:
    """Compute stamps (n,) as `since_ns` plus values times a unit.

    Args:
        values: (n,), whole numbers or floats; NOT_A_TIME or NaN if a value is missing.
        unit_ns: length of the unit in ns.
        since_ns: stamp at which the values are zero; NOT_A_TIME if it is unknown.
        where: beginning of error messages: file and column or topic.
        remedy: end of error messages: what to do.

    Returns:
        The stamps, NOT_A_TIME for missing values.

    Raises BadInput if a stamp does not fit 64 bits, as after the year 2262.
    """
    given, since = np.asarray(values), np.asarray(since_ns)
    numbers, start = given.astype(float), since.astype(float)
    known = ~np.isnan(numbers) & (since != NOT_A_TIME)
    if given.dtype.kind == "i":
        known &= given != NOT_A_TIME
    with np.errstate(over="ignore", invalid="ignore"):
        product = numbers * unit_ns
        fits = (np.abs(product) < BEYOND) & (np.abs(product + start) < BEYOND)
    if np.any(known & ~fits):
        value = given[np.argmax(known & ~fits)]
        raise BadInput(
            f"{where}: a stamp is before 1970 or after 2262 ({value} times {unit_ns} ns); {remedy}"
        )
    filled = np.where(known, given, 0)
    if given.dtype.kind in "iu":
        product_ns = filled.astype(np.int64) * unit_ns
    else:  # the whole part separately, since a double near 1e9 s has no nanoseconds
        whole = np.floor(filled)
        product_ns = whole.astype(np.int64) * unit_ns
        product_ns += np.rint((filled - whole) * unit_ns).astype(np.int64)
    return np.where(known, product_ns + np.where(known, since, 0).astype(np.int64), NOT_A_TIME)
