"""Conversion of Arrow cells to stamps, without loss of digits in texts."""

from functools import reduce
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import BEYOND, NOT_A_TIME, Stamps, to_ns

# Texts that a decimal of 38 digits can hold if they are short; a large exponent crashes Arrow.
_PARTS = r"^[-+]?[0-9]*\.?(?P<part>[0-9]*)(?P<power>(?:[eE][-+]?[0-9]{1,2})?)$"
_SHORT, _LARGEST_POWER, _MORE_DIGITS = 30, 18, 11
_SIDED = r"^\s*(?P<before>[NSEWnsew]?)\s*(?P<number>\d+(?:\.\d*)?)\s*°?\s*(?P<after>[NSEWnsew]?)\s*$"
_UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}


def read_ns(
    cells: pa.Array, digits: int, since_ns: int | Stamps = 0, *, where: str, remedy: str
) -> Stamps:
    """Convert cells (n,) to stamps; texts keep all of their digits, unlike doubles.

    Args:
        cells: whole numbers, floats, texts of numbers, or timestamps or durations, which have their own
            unit.
        digits: number of decimal places at which the unit reaches a nanosecond, such as 9 for seconds.
        since_ns: stamp at which the values are zero.
        where: beginning of error messages.
        remedy: end of error messages.

    Returns:
        The stamps, NOT_A_TIME for a cell that is empty or NaN.

    Raises BadInput if a cell is not a number, or its stamp does not fit 64 bits.
    """
    if pa.types.is_dictionary(cells.type):
        cells = cells.dictionary_decode()
    if pa.types.is_timestamp(cells.type) or pa.types.is_duration(cells.type):
        values = cells.cast(pa.int64()).fill_null(NOT_A_TIME).to_numpy()
        return to_ns(values, _UNITS_NS[cells.type.unit], since_ns, where=where, remedy=remedy)
    if pa.types.is_integer(cells.type):
        stamps = to_ns(cells.fill_null(0).to_numpy(), 10**digits, since_ns, where=where, remedy=remedy)
        return np.where(cells.is_valid().to_numpy(zero_copy_only=False), stamps, NOT_A_TIME)
    is_text = pa.types.is_string(cells.type) or pa.types.is_large_string(cells.type)
    if is_text:
        cells = pc.utf8_trim_whitespace(cells)
        if (plain := _plain(cells, digits)) is not None:
            return to_ns(plain, 1, since_ns, where=where, remedy=remedy)
        cells = pc.replace_substring_regex(cells, r"^\+([0-9.])", r"\1")
    try:
        numbers = cells.cast(pa.float64()).to_numpy(zero_copy_only=False)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        why = str(error).splitlines()[0]
        raise BadInput(
            f'{where} has cells that are not numbers ({why}); dates need unit = "date"'
        ) from None
    found = to_ns(numbers, 10**digits, where=where, remedy=remedy)
    if is_text:
        found = _to_the_last_digit(cells, digits, found)
    return to_ns(found, 1, since_ns, where=where, remedy=remedy)


def sided(cells: pa.Array) -> tuple[pa.Array, pa.Array]:
    """Split texts such as 48.1N or W 11.5° into numbers and hemispheres; null for other texts."""
    parts = pc.extract_regex(cells.cast(pa.string()), _SIDED)
    letters = [pc.struct_field(parts, name) for name in ("before", "after")]
    return pc.struct_field(parts, "number").cast(pa.float64()), pc.utf8_upper(
        pc.binary_join_element_wise(*letters, "")
    )


def _plain(texts: pa.Array, digits: int) -> Stamps | None:
    """Convert texts (n,) to nanoseconds; None unless all are plain decimals of at most `digits` digits.

    This is fast, and sufficient for most files.
    """
    if any(pc.any(pc.match_substring(texts, mark)).as_py() for mark in "eE+"):
        return None
    try:
        decimals = texts.cast(pa.decimal128(38, digits))
    except pa.ArrowInvalid:
        return None
    words: Any = np.frombuffer(decimals.buffers()[1], "<i8").reshape(-1, 2)
    low, high = words[decimals.offset : decimals.offset + len(decimals)].T
    known = decimals.is_valid().to_numpy(zero_copy_only=False)
    if np.any(known & ((high != low >> 63) | (low > BEYOND) | (low < -BEYOND))):
        return None
    return np.where(known, low, NOT_A_TIME)


def _to_the_last_digit(texts: pa.Array, digits: int, rough: Stamps) -> Stamps:
    """Convert texts (n,) to exact nanoseconds; those with too many digits keep their `rough` values."""
    parts = pc.extract_regex(texts, _PARTS)
    powers = pc.replace_substring_regex(pc.struct_field(parts, "power"), r"[eE+]", "")
    power = pc.if_else(pc.equal(powers, ""), "0", powers).cast(pa.int32())
    places = pc.subtract(pc.utf8_length(pc.struct_field(parts, "part")), power)
    conditions = (
        pc.less_equal(pc.utf8_length(texts), _SHORT),
        pc.less_equal(pc.abs(power), _LARGEST_POWER),
        pc.less_equal(places, digits + _MORE_DIGITS),
    )
    is_exact = pc.fill_null(reduce(pc.and_, conditions), False)
    decimals = pc.if_else(is_exact, texts, None).cast(pa.decimal128(38, digits + _MORE_DIGITS))
    # Arrow stores a decimal as a count of units of its last digit: nanoseconds
    scaled = pc.round(decimals, digits).cast(pa.decimal128(38, digits))
    low: Any = np.frombuffer(scaled.buffers()[1], "<i8").reshape(-1, 2)[:, 0]
    exact = low[scaled.offset : scaled.offset + len(scaled)]
    return np.where(is_exact.to_numpy(zero_copy_only=False), exact, rough)
