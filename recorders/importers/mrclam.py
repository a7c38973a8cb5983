"""Importer of UTIAS multi-robot cooperative localization and mapping (MRCLAM) data sets.

K. Leung et al., "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 2011. A
folder contains Barcodes.dat, Landmark_Groundtruth.dat and, per robot, its ground truth, odometry and
measurements as text columns.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import PositiveFloat

from fuselog.recorders.common_streams import prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.stamps import to_ns
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.states import POSE
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Importer, Recording


class MrclamParameters(Parameters):
    """Settings that the data do not state: the noise of odometry and sensor, and the prior's sigmas.

    The values are the same for all sets and robots. The noise densities describe the odometry's errors
    over 1 to 20 s, rounded up. Errors of successive ranges and bearings are correlated (by 0.5 to 0.7),
    but a filter assumes that they are independent, so the standard deviations are a few times the
    scatter.

    Attributes:
        forward_noise_density: noise of the odometry's forward speed, in m/s/sqrt(Hz).
        turn_noise_density: noise of the odometry's turn rate, in rad/s/sqrt(Hz).
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        prior_sigma_m: standard deviation of the position in the prior, per axis.
        prior_sigma_rad: standard deviation of the heading in the prior.
    """

    forward_noise_density: PositiveFloat = 0.05
    turn_noise_density: PositiveFloat = 0.05
    sigma_range_m: PositiveFloat = 0.8
    sigma_bearing_rad: PositiveFloat = 0.05
    prior_sigma_m: PositiveFloat = 0.05
    prior_sigma_rad: PositiveFloat = 0.05


def read(folder: Path, parameters: MrclamParameters) -> Recording:
    """Read a data set; drop unknown barcodes, and count them in the notes.

    Raises BadInput that names the file and line if a file is missing or malformed.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder}: not a folder; give the folder that contains Barcodes.dat")
    barcodes = _table(folder / "Barcodes.dat", 2, identifiers=(0, 1))
    landmarks = _table(folder / "Landmark_Groundtruth.dat", 5, identifiers=(0,))
    robots = _robots(folder)
    subject_of = dict(zip(barcodes[:, 1].astype(int), barcodes[:, 0].astype(int), strict=True))
    truths = {robot: _timed(folder / f"Robot{robot}_Groundtruth.dat", 4) for robot in robots}
    epoch_ns = min(int(times_ns[0]) for times_ns, _ in truths.values())
    streams = [
        make_stream(
            "/landmarks",
            schemas.LANDMARK,
            np.full(len(landmarks), epoch_ns),
            landmark_id=landmarks[:, 0],
            position_m=landmarks[:, 1:3],
        )
    ]
    notes: dict[str, str] = {}
    for robot in robots:
        streams += _robot_streams(folder, robot, truths[robot], subject_of, parameters, notes)
    return Recording(streams, epoch_ns, notes)


def _robots(folder: Path) -> list[int]:
    names = [re.fullmatch(r"Robot(\d+)_\w+\.dat", path.name) for path in folder.iterdir()]
    robots = sorted({int(name.group(1)) for name in names if name})
    if not robots:
        raise BadInput(f"{folder}: has no files RobotN_*.dat; give the folder of one MRCLAM set")
    return robots


def _robot_streams(
    folder: Path,
    robot: int,
    truth: tuple[NDArray[np.int64], NDArray[np.float64]],
    subject_of: dict[int, int],
    parameters: MrclamParameters,
    notes: dict[str, str],
) -> list[Stream]:
    truth_ns, poses = truth
    odometry_ns, odometry = _timed(folder / f"Robot{robot}_Odometry.dat", 3)
    seen_ns, seen = _timed(folder / f"Robot{robot}_Measurement.dat", 4, identifiers=(1,))
    codes = seen[:, 0].astype(int)
    known = np.isin(codes, list(subject_of))
    for code, count in zip(*np.unique(codes[~known], return_counts=True), strict=True):
        notes[f"robot {robot}, unknown barcode {code}"] = f"{count} measurements dropped"
    targets = np.array([subject_of[code] for code in codes[known]], np.uint32)
    prefix = f"/robot{robot}"
    sigma = np.array([parameters.prior_sigma_m, parameters.prior_sigma_m, parameters.prior_sigma_rad])
    start_ns = max(odometry_ns[0], truth_ns[0])
    row = min(int(np.searchsorted(truth_ns, start_ns)), len(truth_ns) - 1)
    return [
        prior_stream(f"{prefix}/prior", truth_ns[row], POSE, poses[row], np.diag(sigma**2)),
        truth_stream(f"{prefix}/truth", truth_ns, POSE, poses),
        make_stream(
            f"{prefix}/odometry",
            schemas.ODOMETRY,
            odometry_ns,
            metadata=stated_numbers(parameters, "forward_noise_density", "turn_noise_density"),
            forward_mps=odometry[:, 0],
            turn_radps=odometry[:, 1],
        ),
        make_stream(
            f"{prefix}/range_bearing",
            schemas.RANGE_BEARING,
            seen_ns[known],
            metadata=stated_numbers(parameters, "sigma_range_m", "sigma_bearing_rad"),
            target_id=targets,
            range_m=seen[known, 1],
            bearing_rad=seen[known, 2],
        ),
    ]


def _table(path: Path, columns: int, identifiers: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """Read the numbers of one file, (rows, columns); some columns contain whole numbers of 32 bits."""
    try:
        try:
            table = _columns_of(path, float)
        except ValueError:  # raised again, unless only some words are no numbers
            table = _columns_of(path, str)
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; an MRCLAM folder needs it") from None
    except pd.errors.EmptyDataError:
        raise BadInput(f"{path}: has no data rows; give the file as published") from None
    except (OSError, pd.errors.ParserError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read as columns ({error})") from None
    if table.shape[1] != columns:
        raise BadInput(
            f"{path}: has {table.shape[1]} columns, expected {columns}; give the file as published"
        )
    numbers = table.apply(pd.to_numeric, errors="coerce").to_numpy(float)
    _refuse(~np.isfinite(numbers), path, "expected a number")
    is_identifier = (numbers >= 0) & (numbers < 2**32) & (numbers == np.floor(numbers))
    is_identifier[:, [column not in identifiers for column in range(columns)]] = True
    _refuse(~is_identifier, path, "expected a whole number, zero or more")
    return numbers


def _columns_of(path: Path, kind: type) -> pd.DataFrame:
    return pd.read_csv(path, sep=r"\s+", comment="#", header=None, dtype=kind)


def _refuse(bad: NDArray[np.bool_], path: Path, what: str) -> None:
    if bad.any():
        row, column = np.argwhere(bad)[0]
        text = _columns_of(path, str).iloc[row, column]
        raise BadInput(f"{path}: data row {row + 1}, column {column + 1} is {text}, {what}")


def _timed(
    path: Path, columns: int, identifiers: tuple[int, ...] = ()
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Read stamps (n,) in ns and the other columns (n, columns - 1), sorted by time.

    Stamps are printed to the millisecond, and are not exact as doubles; rounding restores the exact
    values.
    """
    table = _table(path, columns, identifiers)
    bad = (table[:, :1] < 0) | (table[:, :1] > 9e9)
    _refuse(bad, path, "expected a time in seconds since 1970")
    times_ns = to_ns(np.rint(table[:, 0] * 1e6), 1000, where=str(path))
    order = np.argsort(times_ns, kind="stable")
    return times_ns[order], table[order, 1:]


MRCLAM = Importer(
    "UTIAS multi-robot cooperative localization and mapping sets: a folder of RobotN_*.dat files",
    MrclamParameters,
    read,
)
