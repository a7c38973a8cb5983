"""Stamps of the numbers that others log: exact or refused, whatever the text, the type or the unit."""

import subprocess
import sys
from decimal import Decimal, localcontext

import numpy as np
import pyarrow as pa
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import NOT_A_TIME, to_ns
from fuselog.recorders.importers.tables.cells import read_ns

digits = st.text("0123456789", max_size=40) | st.integers(1, 300).map("7".__mul__)
signs = st.sampled_from(["", "", "-", "+", "--", "+-"])
exponents = st.just("") | st.builds(
    "{}{}{}".format, st.sampled_from("eE"), signs, st.integers(0, 999_999_999) | st.integers(0, 40)
)
looks = st.builds(
    "{}{}{}{}{}".format, signs, digits, st.sampled_from(["", ".", ".", "..", "_"]), digits, exponents
)
odd = st.sampled_from(
    ["0x1f", "1_000", "١٢٣", "nan(7)", "nan", "inf", "-Infinity", "1e", ".", "", " 5 ", "1,5"]
)


@given(text=looks | odd, places=st.sampled_from([0, 3, 6, 9]))
@example(text="1e-32000000", places=9)
@example(text="9223372036.854775808", places=9)
@example(text="1767225600000", places=9)
@settings(max_examples=100, deadline=None)
def test_a_text_gives_its_stamp_or_a_sentence(text: str, places: int) -> None:
    """And its neighbour keeps the last digit."""
    try:
        found, beside = read_ns(pa.array([text, "1767225600.123456789"]), places, where="t", remedy="m")
    except BadInput:
        return
    assert beside == round(Decimal("1767225600.123456789").scaleb(places))
    if found == NOT_A_TIME:
        assert "nan" in text
        return
    with localcontext(prec=700):
        exact = Decimal(text.strip()).scaleb(places)
        slack = abs(exact) / 2**50 if len(text) > 30 or "e" in text.lower() else 0
        assert abs(int(found) - exact) <= Decimal("0.5") + slack


@given(
    values=st.lists(st.integers(-(2**63) + 1, 2**63 - 1), min_size=1, max_size=3),
    unit_ns=st.sampled_from([1, 1000, 10**6, 10**9, 7 * 86400 * 10**9]),
    since_ns=st.integers(-(2**62), 2**62),
    kind=st.sampled_from(["int64", "uint64", "float64", "int32"]),
)
@settings(max_examples=100, deadline=None)
def test_a_product_is_exact_or_refused(
    values: list[int], unit_ns: int, since_ns: int, kind: str
) -> None:
    numbers = np.array([each % 2**31 if kind == "int32" else abs(each) for each in values]).astype(kind)
    exact = [int(each) * unit_ns for each in numbers]
    fits = all(abs(each) < 2**63 - 2**13 and abs(each + since_ns) < 2**63 - 2**13 for each in exact)
    beyond = any(abs(each) >= 2**63 or abs(each + since_ns) >= 2**63 for each in exact)
    try:
        found = to_ns(numbers, unit_ns, since_ns, where="t")
    except BadInput:
        assert not fits
    else:
        assert not beyond
        assert found.tolist() == [each + since_ns for each in exact]


def test_bags_and_ulogs_are_imported_without_arrow() -> None:
    code = (
        "import fuselog.recorders.importers.ros.importer\n"
        "import fuselog.recorders.importers.ulog.importer, sys\n"
        "sys.exit('pyarrow' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
