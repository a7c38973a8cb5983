"""Car D as the tests make it is that of the sheet of sensors, section 3."""

import numpy as np
import pytest

from fuselog.pipeline.diagnosing.battery.car import drive


def test_the_car_is_that_of_the_sheet() -> None:
    car = drive(1)
    wheels = np.stack([car.speed_mps, car.turn_radps], axis=1)
    exact = {"rel": 1e-9, "abs": 1e-12}
    assert wheels[0] == pytest.approx([0.120121202374, -0.007774077078], **exact)
    assert car.fix_m[0] == pytest.approx([0.058552600338, 0.392675721943], **exact)
    assert car.compass_rad[0] == pytest.approx(1.858061022442, **exact)
    assert wheels.sum(axis=0) == pytest.approx([7048.762687046, 2.44559657172], **exact)
    assert car.fix_m.sum() == pytest.approx(47772.332351194, **exact)
    assert car.compass_rad.sum() == pytest.approx(599.59175192566, **exact)
