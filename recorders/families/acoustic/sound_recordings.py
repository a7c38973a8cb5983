"""Importer of synchronized microphone recordings of sounds, as differences of arrival times.

The input is a folder in the layout of opensoundscape. It contains WAV files, a table of the microphones'
positions (CSV with the file first, then x, y and optionally z, in m), and tables of detections (CSV with
the file first, start_time and end_time in s from the start of the file, and a column for each kind of
sound, 1 if present). Tables are recognized by these columns. Each time span of each kind in a table of
detections is one sound. Without such a table, the whole recordings of an array are one sound. A file's
comment may state when it began (`recording_start_time`, as written by opensoundscape); without such
comments, all recordings begin at the same time.
"""

import re
import warnings
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat
from scipy.io import wavfile

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.arrival_streams import (
    HeardSound,
    difference_stream,
    microphone_stream,
)
from fuselog.recorders.families.acoustic.arrivals import Weighting
from fuselog.recorders.importers.stamps import to_ns
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Importer, Recording

Floats = NDArray[np.float64]

TIMES = ("start_time", "end_time")
AXES = ("x", "y", "z")


class SoundRecordingsParameters(Parameters):
    """Settings that the files do not contain: the air, the frequency band, and true positions of sounds.

    Attributes:
        speed_of_sound_mps: speed of sound in the air.
        band_hz: lowest and highest frequency to use, in Hz; if not set, from 200 Hz to 90 % of half the
            sampling rate.
        weighting: weights of frequencies in the correlation of two recordings: equal (phat), or by
            strength (none).
        clipped_share: share of samples at the greatest value above which a file is reported as clipped.
        truth_m: true positions of sounds (x, y or x, y, z), by name.
    """

    speed_of_sound_mps: PositiveFloat = 343.0
    band_hz: tuple[PositiveFloat, PositiveFloat] | None = None
    weighting: Weighting = "phat"
    clipped_share: Annotated[float, Field(ge=0, le=1)] = 1e-3
    truth_m: dict[str, Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]] = {}


class Recorded(NamedTuple):
    """Samples of a file, its sampling rate, and when it began (ns since 1970; None if unknown)."""

    samples: Floats
    rate_hz: int
    begin_ns: int | None


class Sound(NamedTuple):
    """One sound: the files that may contain it, and its start and end in ns since 1970."""

    name: str
    files: list[str]
    begin_ns: int
    end_ns: int


class Array(NamedTuple):
    """Microphones of one table by file: positions (3,), numbers in the log, and recordings."""

    path: Path
    places: dict[str, Floats]
    numbers: dict[str, int]
    files: dict[str, Recorded]


def read(folder: Path, parameters: SoundRecordingsParameters) -> Recording:
    """Read a folder; the notes list skipped microphones and doubtful findings.

    Sounds that too few microphones heard are skipped too. Raises BadInput with the name of the file if a
    file cannot be used or no sound remains.
    """
    if not folder.is_dir():
        raise BadInput(
            f"{folder}: is not a folder; give a folder with WAV files and a table of the microphones' "
            "positions"
        )
    tables = {path: _table(path) for path in sorted(folder.rglob("*.csv"))}
    placing = {
        path: table for path, table in tables.items() if {"x", "y"} <= set(table.columns) and len(table)
    }
    if not placing:
        raise BadInput(
            f"{folder}: has no table of the microphones' positions; add a CSV file with the columns "
            "file, x, y"
        )
    notes: dict[str, str] = {}
    arrays, count = [], 0
    for path, table in placing.items():
        arrays.append(_array(folder, path, table, 1 + count, notes))
        count += len(arrays[-1].files)
    begins_ns = [each.begin_ns for array in arrays for each in array.files.values()]
    epoch_ns = min((each for each in begins_ns if each is not None), default=SIMULATION_EPOCH_NS)
    streams = [
        stream
        for array in arrays
        for sound in _sounds(array, tables, epoch_ns)
        for stream in _streams(sound, array, epoch_ns, parameters, notes)
    ]
    if not streams:
        left = "; ".join(f"{what}: {why}" for what, why in notes.items())
        raise BadInput(f"{folder}: has no sound that can be located ({left or 'none detected'})")
    missing = sorted(parameters.truth_m.keys() - {stream.topic.split("/")[1] for stream in streams})
    if missing:
        notes["truth_m"] = f"no sound has the name {', '.join(missing)}"
    places = np.array([array.places[name] for array in arrays for name in array.files])
    return Recording([microphone_stream(epoch_ns, places), *streams], epoch_ns, notes)


def _array(folder: Path, path: Path, table: pd.DataFrame, first_id: int, notes: dict[str, str]) -> Array:
    """Read the files and positions of an array; number its microphones from `first_id`."""
    places = _places(path, table)
    files = _recordings(folder, places, notes)
    if not files:
        raise BadInput(
            f"{path}: none of the listed files can be used; give the folder that their paths are "
            "relative to"
        )
    silent = [name for name, each in files.items() if each.begin_ns is None]
    if silent and len(silent) < len(files):
        raise BadInput(
            f"{path}: {silent[0]} has no comment recording_start_time, but other files have one; "
            "add it to all files or to none"
        )
    return Array(path, places, {name: first_id + place for place, name in enumerate(files)}, files)


def _table(path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, skipinitialspace=True, dtype={0: str})
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read as CSV ({error})") from None
    table.columns = [str(name).strip() for name in table.columns]
    return table


def _places(path: Path, table: pd.DataFrame) -> dict[str, Floats]:
    """Read the positions (3,) of microphones by file; z is 0 if the table has none."""
    axes = [axis for axis in AXES if axis in table.columns]
    found: dict[str, Floats] = {}
    for name, row in zip(table.iloc[:, 0], table[axes].to_numpy(), strict=True):
        place = np.array([_number(value) for value in row])
        if len(axes) < 3 or np.isnan(place[-1]):
            place = np.append(place[:2], 0.0)
        if not np.isfinite(place).all():
            raise BadInput(f"{path}: {name}: its position is not two numbers; give x and y in m")
        if name in found:
            raise BadInput(f"{path}: {name}: is listed twice; remove one of the rows")
        found[str(name)] = place
    return found


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _recordings(folder: Path, at: Mapping[str, Floats], notes: dict[str, str]) -> dict[str, Recorded]:
    """Read an array's files by name; skip missing and silent files with a note."""
    found: dict[str, Recorded] = {}
    for name in at:
        path = folder / name
        if not path.is_file():
            path = next(iter(sorted(folder.rglob(Path(name).name))), path)
        if not path.is_file():
            notes[name] = "not found, skipped"
            continue
        recorded = _read(path)
        if not np.ptp(recorded.samples):
            notes[name] = "is silent, skipped"
            continue
        other = next(iter(found.items()), None)
        if other and other[1].rate_hz != recorded.rate_hz:
            raise BadInput(
                f"{path}: has {recorded.rate_hz} samples per second, {other[0]} has {other[1].rate_hz}; "
                "resample all files of an array to one rate"
            )
        found[name] = recorded
    return found


def _read(path: Path) -> Recorded:
    """Read a WAV file with one channel; raise BadInput if it cannot be read or is incomplete."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", wavfile.WavFileWarning)
        warnings.filterwarnings("ignore", r"Chunk \(non-data\)", wavfile.WavFileWarning)
        try:
            rate_hz, samples = wavfile.read(path)
        except (OSError, ValueError, EOFError, wavfile.WavFileWarning) as error:
            raise BadInput(f"{path}: cannot be read as a WAV file ({error})") from None
    if samples.ndim != 1:
        raise BadInput(f"{path}: has {samples.shape[1]} channels; give one file for each microphone")
    if samples.dtype.kind == "u":  # 8-bit samples are centred at 128
        samples = samples.astype(float) - 128.0
    samples = samples.astype(float)
    if not np.isfinite(samples).all():
        raise BadInput(f"{path}: has samples that are not finite; export the file again without them")
    return Recorded(samples, int(rate_hz), _begin_ns(path))


def _begin_ns(path: Path) -> int | None:
    """Return the start time that a recording's comment states, or None if it states no time."""
    stated = re.search(rb'"recording_start_time": "([^"]+)"', path.read_bytes())
    if stated is None:
        return None
    try:
        begin = datetime.fromisoformat(stated[1].decode())
    except ValueError:
        raise BadInput(
            f"{path}: recording_start_time is {stated[1].decode(errors='replace')}; expected a time "
            "such as 2021-09-24T06:52:00+00:00"
        ) from None
    if begin.tzinfo is None:
        raise BadInput(f"{path}: recording_start_time has no time zone; add one")
    whole = int(begin.replace(microsecond=0).timestamp())
    return int(to_ns(whole, 10**9, begin.microsecond * 1000, where=str(path)))


def _span_ns(recorded: Recorded, epoch_ns: int) -> tuple[int, int]:
    """Return a recording's start and end; without a stated time, it starts at the epoch."""
    begin_ns = epoch_ns if recorded.begin_ns is None else recorded.begin_ns
    return begin_ns, begin_ns + round(len(recorded.samples) / recorded.rate_hz * 1e9)


def _sounds(array: Array, tables: Mapping[Path, pd.DataFrame], epoch_ns: int) -> Iterator[Sound]:
    """Yield the sounds of an array: those in tables of detections, or its whole recordings."""
    spans = {name: _span_ns(each, epoch_ns) for name, each in array.files.items()}
    has_one = False
    for path, table in tables.items():
        file = table.iloc[:, 0].astype(str)
        if not set(TIMES) <= set(table.columns) or not set(file) & set(spans):
            continue
        has_one = True
        begin, end = (table[name].map(_number) for name in TIMES)
        if not ((begin >= 0.0) & (begin < end)).all():
            raise BadInput(f"{path}: start_time and end_time must be in s, with the end after the start")
        first_ns = file.map({name: span[0] for name, span in spans.items()}).fillna(-1).astype(np.int64)
        firsts = np.asarray(first_ns, np.int64)
        begin_ns, end_ns = (
            pd.Series(to_ns(each, 10**9, firsts, where=str(path)), table.index, "int64")
            for each in (begin, end)
        )
        for kind in [each for each in table.columns[1:] if each not in TIMES]:
            is_there = (table[kind].map(_number) > 0.0) & (first_ns >= 0)
            at_once = begin_ns[is_there].groupby(begin_ns[is_there]).groups
            for number, rows in enumerate(at_once.values(), start=1):
                name = _topic(f"{path.stem}-{kind}" + (f"-{number}" if len(at_once) > 1 else ""))
                lasts_ns = int((end_ns - begin_ns)[rows].max())
                at_ns = int(begin_ns[rows].iloc[0])
                yield Sound(name, list(dict.fromkeys(file[rows])), at_ns, at_ns + lasts_ns)
    if not has_one:
        begins, ends = zip(*spans.values(), strict=True)
        yield Sound(_topic(array.path.stem), list(spans), max(begins), min(ends))


def _topic(name: str) -> str:
    """Replace characters that a topic name cannot have."""
    return re.sub(r"[^\w-]+", "_", name)


def _streams(
    sound: Sound,
    array: Array,
    epoch_ns: int,
    parameters: SoundRecordingsParameters,
    notes: dict[str, str],
) -> Iterator[Stream]:
    """Yield one sound's differences, and the truth if known, unless too few microphones hear the sound.

    The search window extends beyond the sound on both sides by the sound's travel time between the
    microphones. Files that do not cover the sound, or are silent during it, are skipped.
    """
    name = sound.name
    kept: dict[str, Floats] = {}
    spans = {each: _span_ns(array.files[each], epoch_ns) for each in sound.files}
    covering = {
        each: span
        for each, span in spans.items()
        if span[0] <= sound.begin_ns < sound.end_ns <= span[1] + 1
    }
    places = np.array([array.places[each] for each in sound.files])
    away_m = np.linalg.norm(places[:, None] - places, axis=2).max()
    margin_ns = round(away_m / parameters.speed_of_sound_mps * 1e9)
    first_ns = max([sound.begin_ns - margin_ns, *(span[0] for span in covering.values())])
    last_ns = min([sound.end_ns + margin_ns, *(span[1] for span in covering.values())])
    rate_hz = next(iter(array.files.values())).rate_hz
    count = int((last_ns - first_ns) * 1e-9 * rate_hz)
    for each in sound.files:
        if each not in covering:
            notes[f"{name}, {each}"] = "does not cover the whole sound, skipped"
            continue
        begin = round((first_ns - spans[each][0]) * 1e-9 * rate_hz)
        samples = array.files[each].samples[begin : begin + count]
        if not np.ptp(samples):
            notes[f"{name}, {each}"] = "is silent during the sound, skipped"
            continue
        kept[each] = samples
        at_top = float(np.mean(np.abs(samples) == np.abs(samples).max()))
        if at_top > parameters.clipped_share:
            notes[f"{name}, {each}"] = f"is clipped: {at_top:.1%} of its samples have the greatest value"
    places = np.array([array.places[each] for each in kept]).reshape(-1, 3)
    needed = 3 if len(places) and np.ptp(places[:, 2]) == 0.0 else 4
    if len(kept) < needed:
        notes[name] = f"{len(kept)} microphones heard it, but {needed} are needed to locate it; skipped"
        return
    low, high = parameters.band_hz or (200.0, 0.45 * rate_hz)
    if not low < high <= 0.5 * rate_hz:
        raise BadInput(
            f"sound {name}: band_hz = [{low:g}, {high:g}] for {rate_hz} samples per second; give a "
            f"lower and a higher frequency in Hz, the higher one at most {0.5 * rate_hz:g}"
        )
    shortest = min(map(len, kept.values()))
    recordings = np.array([samples[:shortest] for samples in kept.values()])
    numbers = np.array([array.numbers[each] for each in kept])
    yield difference_stream(
        f"/{name}",
        HeardSound(sound.begin_ns, recordings, float(rate_hz), places, numbers),
        band_hz=(low, high),
        speed_of_sound_mps=parameters.speed_of_sound_mps,
        weighting=parameters.weighting,
    )
    truth = parameters.truth_m.get(name)
    if truth is not None:
        components = [f"{axis}_m" for axis in AXES[: len(truth)]]
        yield truth_stream(f"/{name}/truth", [sound.begin_ns], components, [truth])


SOUND_RECORDINGS = Importer(
    "sounds in synchronized WAV files, as arrival differences; a folder with tables",
    SoundRecordingsParameters,
    read,
)
