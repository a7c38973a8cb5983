"""Imports sounds in synchronised recordings of microphones, as differences of their arrivals.

A folder as opensoundscape's: WAV files, a table of the microphones' places (CSV with the file first, x,
y and perhaps z, in m), and tables of detections (CSV with the file first, start_time and end_time in s
of that file, and a column for each kind of sound, 1 where it is). Tables are known by these columns.
Every kind and time of a table is one sound; without such a table the whole recordings of an array are.
A file's comment may say when it began (`recording_start_time`, as opensoundscape writes it); else all
begin at once.
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
    """States what the files do not: the air, the band that is used, and true positions of sounds.

    Attributes:
        speed_of_sound_mps: speed of sound in the air.
        band_hz: lowest and highest frequency that is used, in Hz; without them from 200 Hz to nine
            tenths of half the sampling rate.
        weighting: of frequencies when two recordings are correlated: all alike (phat), or by their
            strength (none).
        clipped_share: a file is reported as clipped if a larger share of its samples have the greatest
            value.
        truth_m: true positions of sounds (x, y or x, y, z), by name.
    """

    speed_of_sound_mps: PositiveFloat = 343.0
    band_hz: tuple[PositiveFloat, PositiveFloat] | None = None
    weighting: Weighting = "phat"
    clipped_share: Annotated[float, Field(ge=0, le=1)] = 1e-3
    truth_m: dict[str, Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]] = {}


class Recorded(NamedTuple):
    """Holds a file: its samples, how many a second, and when it began, ns since 1970, or None."""

    samples: Floats
    rate_hz: int
    begin_ns: int | None


class Sound(NamedTuple):
    """Describes one sound: the files that may have it, its begin and end there, ns since 1970."""

    name: str
    files: list[str]
    begin_ns: int
    end_ns: int


class Array(NamedTuple):
    """Holds the microphones of one table, by file: places (3,), numbers in the log, and recordings."""

    path: Path
    places: dict[str, Floats]
    numbers: dict[str, int]
    files: dict[str, Recorded]


def read(folder: Path, parameters: SoundRecordingsParameters) -> Recording:
    """Read a folder; microphones that are left out and what is doubtful is told in the notes.

    Sounds that too few microphones heard are left out, too. Raises BadInput that names the file where
    one cannot be used at all, or no sound is left.
    """
    if not folder.is_dir():
        raise BadInput(
            f"{folder}: is not a folder; give one that has WAV files and a table of the microphones' "
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
        raise BadInput(f"{folder}: has no sound that can be located ({left or 'none is detected'})")
    missing = sorted(parameters.truth_m.keys() - {stream.topic.split("/")[1] for stream in streams})
    if missing:
        notes["truth_m"] = f"no sound has the name {', '.join(missing)}"
    places = np.array([array.places[name] for array in arrays for name in array.files])
    return Recording([microphone_stream(epoch_ns, places), *streams], epoch_ns, notes)


def _array(folder: Path, path: Path, table: pd.DataFrame, first_id: int, notes: dict[str, str]) -> Array:
    """Read what an array's files hold, and where they are; microphones count from `first_id` on."""
    places = _places(path, table)
    files = _recordings(folder, places, notes)
    if not files:
        raise BadInput(
            f"{path}: none of the files that it names can be used; give the folder that their paths "
            "start from"
        )
    silent = [name for name, each in files.items() if each.begin_ns is None]
    if silent and len(silent) < len(files):
        raise BadInput(
            f"{path}: {silent[0]} lacks the comment recording_start_time, which others have; "
            "give it to all of them or to none"
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
    """Read the places (3,) of microphones by file; z is 0 where the table has none."""
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
    """Read an array's files, by name; what is not there or silent is left out, and told."""
    found: dict[str, Recorded] = {}
    for name in at:
        path = folder / name
        if not path.is_file():
            path = next(iter(sorted(folder.rglob(Path(name).name))), path)
        if not path.is_file():
            notes[name] = "is not there: left out"
            continue
        recorded = _read(path)
        if not np.ptp(recorded.samples):
            notes[name] = "is silent: left out"
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
    """Read a WAV file of one channel; raises BadInput where it is none, or not whole."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", wavfile.WavFileWarning)
        warnings.filterwarnings("ignore", r"Chunk \(non-data\)", wavfile.WavFileWarning)
        try:
            rate_hz, samples = wavfile.read(path)
        except (OSError, ValueError, EOFError, wavfile.WavFileWarning) as error:
            raise BadInput(f"{path}: cannot be read as a WAV file ({error})") from None
    if samples.ndim != 1:
        raise BadInput(f"{path}: has {samples.shape[1]} channels; give one file for each microphone")
    if samples.dtype.kind == "u":  # of 8 bits, whose middle is 128
        samples = samples.astype(float) - 128.0
    samples = samples.astype(float)
    if not np.isfinite(samples).all():
        raise BadInput(f"{path}: has samples that are not finite; export it again without them")
    return Recorded(samples, int(rate_hz), _begin_ns(path))


def _begin_ns(path: Path) -> int | None:
    """Read when a recording began, as its comment says; None where it does not."""
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
        raise BadInput(f"{path}: recording_start_time has no time zone; write it with one")
    whole = int(begin.replace(microsecond=0).timestamp())
    return int(to_ns(whole, 10**9, begin.microsecond * 1000, where=str(path)))


def _span_ns(recorded: Recorded, epoch_ns: int) -> tuple[int, int]:
    """Return when a recording begins and ends; at the epoch where it does not say."""
    begin_ns = epoch_ns if recorded.begin_ns is None else recorded.begin_ns
    return begin_ns, begin_ns + round(len(recorded.samples) / recorded.rate_hz * 1e9)


def _sounds(array: Array, tables: Mapping[Path, pd.DataFrame], epoch_ns: int) -> Iterator[Sound]:
    """Yield the sounds of an array: those of the tables of detections, or of its recordings."""
    spans = {name: _span_ns(each, epoch_ns) for name, each in array.files.items()}
    has_one = False
    for path, table in tables.items():
        file = table.iloc[:, 0].astype(str)
        if not set(TIMES) <= set(table.columns) or not set(file) & set(spans):
            continue
        has_one = True
        begin, end = (table[name].map(_number) for name in TIMES)
        if not ((begin >= 0.0) & (begin < end)).all():
            raise BadInput(f"{path}: start_time and end_time must be in s, and the end after the start")
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
    """Make a name that a topic may have as one of its parts."""
    return re.sub(r"[^\w-]+", "_", name)


def _streams(
    sound: Sound,
    array: Array,
    epoch_ns: int,
    parameters: SoundRecordingsParameters,
    notes: dict[str, str],
) -> Iterator[Stream]:
    """Yield the differences of one sound, and the truth where known; nothing where too few heard it.

    It is looked for a little longer than it lasts on both sides, as long as sound travels between the
    microphones. A file that does not cover the sound itself, or is silent there, is left out.
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
            notes[f"{name}, {each}"] = "does not last as long as the sound: left out"
            continue
        begin = round((first_ns - spans[each][0]) * 1e-9 * rate_hz)
        samples = array.files[each].samples[begin : begin + count]
        if not np.ptp(samples):
            notes[f"{name}, {each}"] = "is silent there: left out"
            continue
        kept[each] = samples
        at_top = float(np.mean(np.abs(samples) == np.abs(samples).max()))
        if at_top > parameters.clipped_share:
            notes[f"{name}, {each}"] = f"is clipped: {at_top:.1%} of it are at the greatest value"
    places = np.array([array.places[each] for each in kept]).reshape(-1, 3)
    needed = 3 if len(places) and np.ptp(places[:, 2]) == 0.0 else 4
    if len(kept) < needed:
        notes[name] = f"{len(kept)} microphones heard it, {needed} are needed to locate it: left out"
        return
    low, high = parameters.band_hz or (200.0, 0.45 * rate_hz)
    if not low < high <= 0.5 * rate_hz:
        raise BadInput(
            f"sound {name}: band_hz = [{low:g}, {high:g}] for {rate_hz} samples per second; give a "
            "lower "
            f"and a higher frequency in Hz, the higher one at most {0.5 * rate_hz:g}"
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
    "sounds in synchronised WAV files: differences of their arrivals; a folder with tables",
    SoundRecordingsParameters,
    read,
)
