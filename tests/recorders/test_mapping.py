"""What a mapping makes of sources whose numbers are known: units, gaps, covariances, axes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.mapping import Mapped, StreamMapping, mapped
from fuselog.recorders.units import NAMED, conversion, unit

SOURCES = {
    "a": np.array([1.0, -9.0, 3.0, 999.0]),
    "b": np.array([2.0, 5.0, -9.0, 6.0]),
    "c": np.array([4.0, 7.0, 8.0, 9.0]),
    "mode": np.array([1.0, 2.0, 2.0, 1.0]),
}
# In metres, seconds, radians and teslas, by the definitions of the units.
SIZES = {
    "m": 1.0,
    "arcmin": np.pi / 10800,
    "mm": 1e-3,
    "cm": 1e-2,
    "km": 1e3,
    "in": 0.0254,
    "ft": 12 * 0.0254,
    "mi": 5280 * 0.3048,
    "NM": 1852.0,
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": np.pi / 180,
    "semicircle": np.pi / 2**31,
    "T": 1.0,
    "mT": 1e-3,
    "uT": 1e-6,
    "nT": 1e-9,
    "G": 1e-4,
    "mG": 1e-7,
    "g": 9.80665,
    "mg": 9.80665e-3,
    "kn": 1852 / 3600,
    "rpm": np.pi / 30,
    "Hz": 1.0,
    "mdeg": np.pi / 180e3,
    "ug": 9.80665e-6,
    **dict.fromkeys(["Pa", "dB", "degC", "%", "bytes"], 1.0),
}


def made(**mapping: Any) -> Mapped:
    def holds(source: str, values: Sequence[Any]) -> np.ndarray:
        return np.isin(SOURCES[source], values)

    return mapped(StreamMapping(**mapping), 4, SOURCES.__getitem__, holds, "here")


def test_units_are_as_large_as_they_are_defined() -> None:
    assert {name: each.size for name, each in NAMED.items()} == pytest.approx(SIZES, rel=1e-12)
    assert unit("km h^-2").size == pytest.approx(1000.0 / 3600.0**2)
    for given, field, factor in (
        ("g", "specific_force_mps2", 9.80665),
        ("deg/s", "turn_rate_radps", np.pi / 180),
        ("rad", "latitude_deg", 180 / np.pi),
        ("mG", "magnetic_field_ut", 0.1),
        ("cm^2", "covariance_m2", 1e-4),
        ("1/min", "clutter_per_s", 1 / 60),
        ("km/h", "velocity_mps", 1 / 3.6),
    ):
        assert conversion(given, field) == pytest.approx(factor), given
    assert conversion("cm", "covariance_m2", is_root=True) == pytest.approx(0.01)
    for name, field in (("cm", "covariance_m2"), ("%", "clutter_share"), ("Hz", "turn_rate_radps")):
        with pytest.raises(BadInput, match=f"'{name}' does not fit: {field}"):
            conversion(name, field)


def test_factors_come_before_offsets_and_these_before_units() -> None:
    found = made(
        becomes="RangeBearing",
        fields={"range_m": "b", "bearing_rad": "c", "target_id": 7},
        factors={"range_m": 2, "bearing_rad": -1},
        offsets={"range_m": 3, "bearing_rad": 90},
        units={"range_m": "cm", "bearing_rad": "deg"},
    ).columns
    assert_allclose(found["range_m"], 0.01 * (2.0 * SOURCES["b"] + 3.0))
    assert_allclose(found["bearing_rad"], np.radians(90.0 - SOURCES["c"]))
    assert set(found["target_id"]) == {7}


def test_every_number_that_stands_for_nothing_is_nan_wherever_it_stands() -> None:
    found = made(becomes="PositionFix", fields={"position_m": ["a", "b"]}, missing=[-9, 999]).columns
    assert_array_equal(found["position_m"], [[1, 2], [np.nan, 5], [3, np.nan], [np.nan, 6]])
    assert np.isnan(found["covariance_m2"]).all()


def test_covariances_have_their_deviations_and_crossed_roots_in_their_places() -> None:
    """With signs, as large as factors, units and rows that are inflated make them."""
    found = made(
        becomes="PositionFix",
        fields={"position_m": ["a", "b", "c"]},
        deviations={"covariance_m2": ["b", 3, "c"]},
        cross_deviations={"covariance_m2": [-1, 2, 0.5]},
        factors={"covariance_m2": [1, 2, 3]},
        units={"covariance_m2": "cm"},
        inflated=[{"where": {"mode": 2}, "by": 10}],
    ).columns["covariance_m2"]
    scale = np.diag([1.0, 2.0, 3.0])
    for row, (b, c, mode) in enumerate(
        zip(*(SOURCES[name] for name in "bc"), SOURCES["mode"], strict=True)
    ):
        matrix = np.array([[b**2, -1.0, 4.0], [-1.0, 9.0, 0.25], [4.0, 0.25, c**2]])
        wanted = scale @ matrix @ scale * 1e-4 * (100.0 if mode == 2 else 1.0)
        assert_allclose(found[row].reshape(3, 3), wanted, rtol=1e-12)


def test_rows_are_chosen_and_become_one_message_for_each() -> None:
    found = made(
        becomes="Range",
        each=[{"range_m": "b", "target_id": 1}, {"range_m": "c", "target_id": 2}],
        where={"mode": 2},
    )
    assert found.rows.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert found.columns["target_id"].tolist() == [1, 2] * 4
    assert found.columns["range_m"].tolist() == [2, 4, 5, 7, -9, 8, 6, 9]
    [is_left_out] = found.dropped.values()
    assert is_left_out.tolist() == [True, True, False, False, False, False, True, True]


def test_a_mounting_turns_the_sensors_axes_into_the_bodys() -> None:
    """A unit on its left side, that is, and looking backwards; by roll, pitch and yaw in this order."""
    angles = (90.0, 20.0, 180.0)
    roll, pitch, yaw = (
        Rotation.from_rotvec(np.radians(angle) * axis).as_matrix()
        for angle, axis in zip(angles, np.eye(3), strict=True)
    )
    turn = yaw @ pitch @ roll
    fields = {"specific_force_mps2": ["a", "b", "c"], "turn_rate_radps": ["c", "a", "b"]}
    found = made(becomes="InertialSample", fields=fields, mounting_deg=angles).columns
    for name, sources in fields.items():
        for row in range(4):
            wanted = turn @ [SOURCES[each][row] for each in sources]
            assert_allclose(found[name][row], wanted, atol=1e-9)
    deviations = {"covariance_ut2": [1, 2, 3]}
    field = made(
        becomes="MagneticField",
        fields={"magnetic_field_ut": ["a", "b", "c"]},
        deviations=deviations,
        mounting_deg=angles,
    ).columns
    spread = turn @ np.diag([1.0, 4.0, 9.0]) @ turn.T
    assert_allclose(field["covariance_ut2"][0].reshape(3, 3), spread, atol=1e-9)
