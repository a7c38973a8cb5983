"""Sounds in WAV files: which are found, when files began, what is left out, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import Recording, import_run

RATE_HZ = 8000
PLACES = {"a.wav": (0, 0), "b.wav": (10, 0), "c.wav": (0, 10), "d.wav": (10, 10)}
LATER = {"a.wav": 0, "b.wav": 100, "c.wav": -80, "d.wav": 33}  # samples


def samples_of(name: str) -> np.ndarray:
    """Two seconds with a sound at 1 s, which comes so much later at this microphone."""
    heard = np.zeros(2 * RATE_HZ)
    begin = RATE_HZ + LATER[name]
    heard[begin : begin + 2000] = np.random.default_rng(1).normal(size=2000) * np.hanning(2000)
    noise = np.random.default_rng(list(PLACES).index(name)).normal(size=len(heard))
    return np.int16(8000 * heard + 20 * noise)


def write(path: Path, samples: np.ndarray, rate_hz: int = RATE_HZ, begin: str = "") -> None:
    wavfile.write(path, rate_hz, samples)
    if begin:
        text = json.dumps({"recording_start_time": begin}).encode() + b" "
        text += b" " * (len(text) % 2)
        body = b"INFOICMT" + len(text).to_bytes(4, "little") + text
        whole = path.read_bytes() + b"LIST" + len(body).to_bytes(4, "little") + body
        path.write_bytes(whole[:4] + (len(whole) - 8).to_bytes(4, "little") + whole[8:])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in PLACES:
        write(tmp_path / name, samples_of(name))
    rows = [f"{name}, {x}, {y}" for name, (x, y) in PLACES.items()]
    (tmp_path / "coords.csv").write_text("\n".join(["file,x,y", *rows]))
    return tmp_path


def read(folder: Path, **parameters: object) -> Recording:
    return import_run("sound-recordings", folder, {"band_hz": [300, 3500], **parameters})[0]


def delays_of(recording: Recording, name: str = "coords") -> dict[int, float]:
    """By microphone, in samples later than at the first."""
    (stream,) = (each for each in recording.streams if each.topic == f"/{name}/differences")
    found = dict(zip(stream["microphone_id"].tolist(), stream["difference_s"] * RATE_HZ, strict=True))
    found[int(stream["reference_id"][0])] = 0.0
    return {number: found[number] - found[1] for number in sorted(found)}


def test_the_whole_recordings_are_one_sound(folder):
    recording = read(folder, truth_m={"coords": [3.0, 4.0], "bang": [0.0, 0.0]})
    assert recording.notes["truth_m"] == "no sound has the name bang"
    found = delays_of(recording)
    assert list(found.values()) == pytest.approx(list(LATER.values()), abs=0.02)
    streams = {stream.topic: stream for stream in recording.streams}
    assert streams["/coords/truth"]["state"].tolist() == [[3.0, 4.0]]
    assert streams["/microphones"]["position_m"][1].tolist() == [10.0, 0.0, 0.0]


def test_detections_name_sounds_and_files_begin_when_they_say(folder):
    """A file that begins 200 samples later gives the same delays, with its detection so much earlier."""
    rows = []
    for name in PLACES:
        cut = 200 if name == "b.wav" else 0
        begin = f"2024-05-01T06:00:00.{cut * 125:06d}+00:00"
        write(folder / name, samples_of(name)[cut:], begin=begin)
        rows.append(f"{name}, {1.0 - cut / RATE_HZ}, {1.2 - cut / RATE_HZ}, 1, 0")
    (folder / "heard.csv").write_text("\n".join(["file,start_time,end_time,tawny owl,fox", *rows]))
    recording = read(folder)
    assert list(delays_of(recording, "heard-tawny_owl").values()) == pytest.approx(
        list(LATER.values()), abs=0.02
    )
    assert not any("fox" in stream.topic for stream in recording.streams)
    assert recording.epoch_ns == 1_714_543_200 * 10**9


def test_what_is_silent_missing_or_clipped_is_told(folder):
    write(folder / "c.wav", np.zeros(2 * RATE_HZ, np.int16))
    write(folder / "a.wav", np.clip(samples_of("a.wav"), -3000, 3000))
    with (folder / "coords.csv").open("a") as table:
        table.write("\ne.wav, 5, 5")
    recording = read(folder)
    assert recording.notes["c.wav"] == "is silent, skipped"
    assert recording.notes["e.wav"] == "not found, skipped"
    assert "is clipped" in recording.notes["coords, a.wav"]
    assert list(delays_of(recording).values()) == pytest.approx([0, 100, 33], abs=0.1)


def test_a_short_file_shortens_the_recordings_or_is_left_out_of_a_sound(folder):
    write(folder / "d.wav", samples_of("d.wav")[: round(1.4 * RATE_HZ)])
    assert list(delays_of(read(folder)).values()) == pytest.approx(list(LATER.values()), abs=0.02)
    rows = [f"{name}, 1.0, 1.6, 1" for name in PLACES]
    (folder / "heard.csv").write_text("\n".join(["file,start_time,end_time,owl", *rows]))
    recording = read(folder)
    assert recording.notes["heard-owl, d.wav"] == "does not cover the whole sound, skipped"
    assert len(delays_of(recording, "heard-owl")) == 3


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-4000])


BAD = {
    "rates": (
        lambda f: write(f / "b.wav", samples_of("b.wav"), 16000),
        "b.wav: has 16000 samples per second, a.wav has 8000; resample all files of an array to one "
        "rate",
    ),
    "stereo": (
        lambda f: write(f / "b.wav", np.stack([samples_of("b.wav")] * 2, axis=1)),
        "b.wav: has 2 channels; give one file for each microphone",
    ),
    "no WAV": (lambda f: (f / "b.wav").write_text("hello"), "b.wav: cannot be read as a WAV file"),
    "truncated": (lambda f: _truncate(f / "b.wav"), "b.wav: cannot be read as a WAV file"),
    "not finite": (
        lambda f: write(f / "b.wav", np.full(100, np.nan, np.float32)),
        "b.wav: has samples that are not finite",
    ),
    "silent": (
        lambda f: [write(f / n, np.zeros(99, np.int16)) for n in ("b.wav", "c.wav")],
        "no sound that can be located .*b.wav: is silent.*coords: 2 microphones heard it, but 3",
    ),
    "one begin": (
        lambda f: write(f / "b.wav", samples_of("b.wav"), begin="2024-05-01T06:00:00+00:00"),
        "a.wav has no comment recording_start_time",
    ),
    "no zone": (
        lambda f: write(f / "b.wav", samples_of("b.wav"), begin="2024-05-01T06:00:00"),
        "b.wav: recording_start_time has no time zone",
    ),
    "no places": (lambda f: (f / "coords.csv").unlink(), "has no table of the microphones' positions"),
    "a place": (
        lambda f: (f / "coords.csv").write_text("file,x,y\na.wav,0,north"),
        "coords.csv: a.wav: its position is not two numbers",
    ),
    "twice": (
        lambda f: (f / "coords.csv").write_text("file,x,y\na.wav,0,0\na.wav,1,1"),
        "coords.csv: a.wav: is listed twice",
    ),
    "times": (
        lambda f: (f / "heard.csv").write_text("file,start_time,end_time,owl\na.wav,2,1,1"),
        "heard.csv: start_time and end_time must be in s",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_used_is_named(folder, what):
    spoil, sentence = BAD[what]
    spoil(folder)
    with pytest.raises(BadInput, match=sentence):
        read(folder)


def test_a_band_beyond_the_samples_is_named(folder):
    with pytest.raises(BadInput, match="at most 4000"):
        read(folder, band_hz=[300, 5000])


@pytest.mark.paper
def test_published_recordings(acoustic):
    """The synthetic array is shifted by whole samples, the real one is as published, to 1 ms."""
    recording = read(acoustic, band_hz=[5000.0, 10000.0])
    streams = {stream.topic: stream for stream in recording.streams}
    aru = streams["/aru_coords/differences"]
    later = dict(zip(aru["microphone_id"].tolist(), aru["difference_s"] * 32000.0, strict=True))
    first = int(streams["/microphones"]["landmark_id"].max()) - 4
    assert int(aru["reference_id"][0]) == first
    assert list(later.values()) == pytest.approx([589, -1714, -1473, -33], abs=0.01)
    names = ("LOCA_2021_detections-zeep", "LOCA_2021_detections_different_starts-zeep")
    both = [streams[f"/{name}/differences"] for name in names]
    published = np.array([0.0, 0.0325, -0.002, 0.0316, -0.0086, 0.024])
    for stream in both:
        found = np.append(0.0, stream["difference_s"])[
            np.argsort(np.append(stream["reference_id"][0], stream["microphone_id"]))
        ]
        assert np.abs(found - found[0] - published).max() < 1e-3
    assert both[0]["difference_s"] == pytest.approx(both[1]["difference_s"], abs=1e-9)
    assert recording.notes["tests/audio/veryshort.wav"] == "not found, skipped"
