"""What files of imu_utils and allan_variance_ros say is explained by the curves beside them."""

from pathlib import Path

import numpy as np
import pytest

from fuselog.pipeline.sensing.foreign_files import explained

DEVIATION_RADPS = 1e-4  # at 1 s


@pytest.mark.parametrize(
    ("factor", "verdict"),
    [
        (1.0, "equals it: N in rad/s/sqrt(Hz), continuous"),
        (1.2, "equals it"),
        (20.0, "is 20 times this, the root of a rate of 400 Hz: divide by 20 for N"),
        (0.05, "is 0.05 times this, the root of a rate of 0.0025 Hz"),
    ],
)
def test_the_convention_of_imu_utils_is_told_by_its_curves(
    tmp_path: Path, factor: float, verdict: str
) -> None:
    """Curves are in deg/h, over averaging times to either side of 1 s."""
    file = tmp_path / "unit_imu_param.yaml"
    stated = factor * DEVIATION_RADPS
    file.write_text(
        f"Gyr:\n  avg-axis:\n    gyr_n: {stated:.8e}\n    gyr_w: 1e-6\nAcc:\n  acc_w: 1e-4\n"
    )
    assert "the convention of these numbers is unknown" in explained(file)[-1]
    taus_s = np.array([0.1, 1.0, 10.0])
    np.savetxt(tmp_path / "data_unit_gyr_t.txt", taus_s)
    for axis in "xyz":
        curve = np.degrees(DEVIATION_RADPS) * 3600.0 / np.sqrt(taus_s)
        np.savetxt(tmp_path / f"data_unit_gyr_{axis}.txt", curve)
    *_, last = explained(file)
    assert last.startswith(
        f"{file}: the curves next to it give 0.0001 rad/s at 1 s, the mean of the axes"
    )
    assert verdict in last


def test_other_files_are_told_apart(tmp_path: Path) -> None:
    kalibr = tmp_path / "imu.yaml"
    kalibr.write_text("accelerometer_noise_density: 1\ngyroscope_random_walk: 2\n")
    assert "a Kalibr imu.yaml" in explained(kalibr)[0]
    for name, what in (("data_unit_acc_t", "averaging times in s"), ("data_unit_gyr_x", "in deg/h")):
        (tmp_path / f"{name}.txt").write_text("1\n")
        assert what in explained(tmp_path / f"{name}.txt")[0]
    (tmp_path / "notes.txt").write_text("1\n")
    assert explained(tmp_path / "notes.txt") == explained(tmp_path / "none.yaml") == []
