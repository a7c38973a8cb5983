"""Importer of BROAD, the Berlin Robust Orientation Estimation Assessment Dataset.

Laidig, Caruso, Cereatti, Seel, Data 6(7), 2021, CC BY 4.0. A trial is one HDF5 file. A file or a folder
of files is one run, in which every trial has its own topics, prefixed by the name of the file.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.extras import extra
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.orientation import require_unit
from fuselog.recorders.models.states import ORIENTATION
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Importer, Recording, simulation_stamps_ns

# Width of each dataset; None for a one-dimensional one.
DATASETS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4, "movement": None}


class BroadParameters(Parameters):
    """Tolerance of true quaternions, and the gaps to report.

    Attributes:
        unit_tolerance: largest deviation of a true quaternion's length from 1.
        gap_s: gaps in the inertial samples or in the truth that are longer than this are counted in the
            notes.
    """

    unit_tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    gap_s: PositiveFloat = 0.1


def read(path: Path, parameters: BroadParameters) -> Recording:
    """Read a trial or a folder of trials; drop samples that are not finite and count them in the notes.

    The files have no absolute time, so all trials start at the same epoch. Raises BadInput with the name
    of the file if it is not HDF5, or if the truth is missing or invalid.
    """
    files = sorted(path.glob("*.hdf5")) if path.is_dir() else [path]
    if not files:
        raise BadInput(f"{path}: has no .hdf5 files; give a BROAD trial, or a folder of them")
    notes: dict[str, str] = {}
    streams = [stream for file in files for stream in _trial(file, parameters, notes)]
    return Recording(streams, SIMULATION_EPOCH_NS, notes)


def _trial(file: Path, parameters: BroadParameters, notes: dict[str, str]) -> list[Stream]:
    data, rate_hz = _datasets(file)
    count = len(data["movement"])
    time_ns = simulation_stamps_ns(np.arange(count) / rate_hz)
    inertial = np.concatenate([data["imu_acc"], data["imu_gyr"], data["imu_mag"]], axis=1)
    sampled = np.isfinite(inertial).all(axis=1)
    seen = np.isfinite(data["opt_quat"]).all(axis=1)
    if not sampled.any() or not seen.any():
        missing = "truth" if sampled.any() else "inertial samples"
        raise BadInput(f"{file}: every value of {missing} is NaN; remove this trial")
    truth = require_unit(data["opt_quat"][seen], f"{file}: truth opt_quat", parameters.unit_tolerance)
    moving = data["movement"] != 0
    changes = np.flatnonzero(np.append(True, moving[1:] != moving[:-1]))
    name = file.stem
    _tell_gaps(notes, f"{name}, inertial samples", time_ns, sampled, parameters.gap_s)
    _tell_gaps(notes, f"{name}, truth", time_ns, seen, parameters.gap_s)
    samples = inertial[sampled]
    return [
        truth_stream(f"/{name}/truth", time_ns[seen], ORIENTATION, truth),
        make_stream(
            f"/{name}/inertial",
            schemas.INERTIAL_SAMPLE,
            time_ns[sampled],
            metadata={"rate_hz": repr(rate_hz)},
            specific_force_mps2=samples[:, :3],
            turn_rate_radps=samples[:, 3:6],
            magnetic_field_ut=samples[:, 6:],
        ),
        make_stream(
            f"/{name}/movement",
            schemas.VECTOR_MEASUREMENT,
            time_ns[changes],
            metadata={"components": "moving", "kinds": "linear"},
            value=moving[changes, None].astype(float),
        ),
    ]


def _datasets(file: Path) -> tuple[dict[str, NDArray], float]:
    """Read the datasets of one file, all of the same length, and the sampling rate."""
    with extra("papers", f"{file}, an HDF5 file"):
        import h5py  # which takes long to import

    try:
        with h5py.File(file) as content:
            missing = [name for name in DATASETS if name not in content]
            if missing:
                what = "truth, " if missing[0] == "opt_quat" else ""
                raise BadInput(f"{file}: has no {what}dataset {missing[0]}; give a BROAD trial with it")
            data = {name: np.asarray(content[name][()]) for name in DATASETS}
            rate_hz = float(content.attrs.get("sampling_rate", np.nan))
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(f"{file}: cannot be read as HDF5 ({error}); give a BROAD trial") from None
    if not rate_hz > 0.0 or not np.isfinite(rate_hz):
        raise BadInput(f"{file}: attribute sampling_rate must be a positive number of Hz, as published")
    count = len(data["movement"]) if data["movement"].ndim else 0
    if count == 0:
        raise BadInput(f"{file}: dataset movement is empty; give a BROAD trial as published")
    for name, width in DATASETS.items():
        if data[name].dtype.kind not in "biuf":
            raise BadInput(f"{file}: dataset {name} is of {data[name].dtype}; expected real numbers")
        expected = (count,) if width is None else (count, width)
        if data[name].shape != expected:
            raise BadInput(f"{file}: dataset {name} has shape {data[name].shape}; expected {expected}")
    return data, rate_hz


def _tell_gaps(
    notes: dict[str, str], what: str, time_ns: NDArray, kept: NDArray[np.bool_], gap_s: float
) -> None:
    """Note the number of dropped samples, and the gaps that are longer than `gap_s`."""
    if kept.all():
        return
    ends = [time_ns[:1], time_ns[kept], time_ns[-1:]]
    silent_s = np.diff(np.concatenate(ends)) * 1e-9
    gaps = silent_s[silent_s > gap_s]
    longest = f", {len(gaps)} gaps over {gap_s:g} s, the longest {gaps.max():.2f} s" if len(gaps) else ""
    notes[what] = f"{int((~kept).sum())} of {len(kept)} not finite, dropped{longest}"


BROAD = Importer(
    "BROAD trials: inertial samples, magnetometer and optical truth; an .hdf5 file or a folder of them",
    BroadParameters,
    read,
)
