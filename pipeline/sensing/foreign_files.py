"""Meaning and units of the numbers in noise files of imu_utils and allan_variance_ros.

In imu_utils, `gyr_n` is sqrt(rate) times the Allan deviation at 1 s, which is a standard deviation per
sample, although its README gives rad/s/sqrt(Hz); `gyr_w` is the minimum of the Allan deviation, not a
walk. allan_variance_ros differences neighbouring bins that overlap, and its gyroscope curve is in deg/s.
"""

import math
import re
from pathlib import Path

import numpy as np

_MOST_BYTES = 1 << 16
_NUMBER = r"\s*:\s*([-+.\deE]+)"


def explained(path: Path) -> list[str]:
    """Explain the numbers in a file of these tools; return [] for any other file."""
    if path.suffix not in (".yaml", ".yml", ".txt") or not path.is_file():
        return []
    text = path.read_bytes()[:_MOST_BYTES].decode(errors="replace")
    if "gyr_n" in text and "acc_w" in text:
        return [f"{path}: {each}" for each in _of_imu_utils(path, text)]
    if "accelerometer_noise_density" in text and "gyroscope_random_walk" in text:
        return [
            f"{path}: a Kalibr imu.yaml as written by allan_variance_ros: N in unit/sqrt(Hz) and K "
            "in unit/s/sqrt(Hz), continuous; Kalibr makes them discrete with update_rate",
            f"{path}: allan_variance_ros reads N from a line over fixed times up to 10 s and "
            "differences neighbouring bins that overlap, without an interval: use fuselog noise instead",
        ]
    if path.suffix == ".txt" and re.search(r"_(gyr|acc)_[xyzt]$", path.stem):
        what = (
            "averaging times in s"
            if path.stem.endswith("t")
            else "an Allan deviation, in deg/h for a gyroscope"
        )
        return [f"{path}: this file was written by imu_utils ({what}) and has no intervals"]
    return []


def _of_imu_utils(path: Path, text: str) -> list[str]:
    sentences = [
        "this file is from imu_utils; its README gives gyr_n and acc_n in rad/s/sqrt(Hz), but its code "
        "writes sqrt(rate) times the Allan deviation at 1 s: a standard deviation per sample",
        "its gyr_w and acc_w are the minimum of its curves (bias instability), in the samples' unit: "
        "they are often used as a random walk, but are not one",
    ]
    average = re.search(rf"Gyr:.*?avg-axis:.*?gyr_n{_NUMBER}", text, re.DOTALL)
    read = _deviation_at_1_s(path)
    if average and read and (stated := _number(average[1])) > 0:
        factor = stated / read
        verdict = (
            "equals it: N in rad/s/sqrt(Hz), continuous"
            if 0.8 < factor < 1.25
            else f"is {factor:.4g} times this, the root of a rate of {factor**2:.4g} Hz: divide by "
            f"{factor:.4g} for N in rad/s/sqrt(Hz)"
        )
        sentences.append(
            f"the curves next to it give {read:.6g} rad/s at 1 s, the mean of the axes; gyr_n "
            f"{stated:.6g} {verdict}"
        )
    else:
        sentences.append("without its curve files, the convention of these numbers is unknown")
    return sentences


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _deviation_at_1_s(path: Path) -> float | None:
    """Average the gyroscope axes' Allan deviations at 1 s, in rad/s, from the curves next to a file."""
    name = path.name.partition("_imu_param")[0]
    times = path.with_name(f"data_{name}_gyr_t.txt")
    curves = [path.with_name(f"data_{name}_gyr_{axis}.txt") for axis in "xyz"]
    if not times.is_file() or not all(map(Path.is_file, curves)):
        return None
    try:
        taus_s = np.loadtxt(times, ndmin=1)
        found = [np.loadtxt(curve, ndmin=1) for curve in curves]
        read = [np.exp(np.interp(0.0, np.log(taus_s), np.log(each))) for each in found]
    except ValueError:
        return None
    return float(np.mean(read)) * math.pi / 180 / 3600
