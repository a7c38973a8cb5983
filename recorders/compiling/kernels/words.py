"""Operations on 64-bit words that neither Python nor NumPy provides as a single operation."""

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import WORD, Emitter, Number


def high_word(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return the upper 64 bits of a 128-bit product."""
    low, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    a_low, a_high, b_low, b_high = a & low, a >> half, b & low, b >> half
    first = a_high * b_low + ((a_low * b_low) >> half)
    second = a_low * b_high + (first & low)
    return a_high * b_high + (first >> half) + (second >> half)


def emit_high_word(emitter: Emitter, a: Number, b: Number) -> Number:
    """Lower `high_word(a, b)`, which is a single instruction of the processor."""
    wide = []
    for each in (a, b):
        wide.append(emitter.fresh())
        emitter.add(f"{wide[-1]} = zext i64 {emitter.as_kind(each, WORD).code} to i128")
    product, high = emitter.fresh(), emitter.fresh()
    emitter.add(f"{product} = mul nuw i128 {wide[0]}, {wide[1]}")
    emitter.add(f"{high} = lshr i128 {product}, 64")
    return emitter.number(WORD, f"trunc i128 {high} to i64")
