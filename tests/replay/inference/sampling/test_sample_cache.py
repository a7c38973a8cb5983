"""The sample cache: found again, never half, never trusted when damaged, safe among processes."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling import SetName, cached_set
from fuselog.replay.inference.sampling.cache import (
    SHIPPED,
    cache_folder,
    compute_set,
    read_set,
    write_sets,
)
from fuselog.replay.inference.sampling.ship import COMMON
from tests.replay.engine.processes import printed

SMALL = SetName(2, 4, seed=11)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty cache; where its only file will lie."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "samples"


def only_file(folder):
    (path,) = folder.iterdir()
    return path


def test_common_sets_ship_whole(folder):
    """Every set of `ship.COMMON`, with mean 0 and covariance I, and nothing computed or written."""
    for name in COMMON:
        points = cached_set(name, pytest.fail)
        assert points.shape == (name.count, name.dimension)
        assert np.abs(points.mean(axis=0)).max() < 1e-14
        assert points.T @ points / name.count == pytest.approx(np.eye(name.dimension), abs=1e-13)
    assert not folder.exists()
    assert len(SHIPPED.read_bytes()) < 300_000


def test_a_set_is_computed_once(folder):
    said = []
    first = cached_set(SMALL, said.append)
    assert said[0] == "4 samples in 2 dimensions: start 1 of 8"
    assert np.array_equal(first, cached_set(SMALL, pytest.fail))
    assert np.array_equal(first, compute_set(SMALL))
    assert "fuselog on demand" in only_file(folder).read_bytes().partition(b"\n")[0].decode()


@pytest.mark.parametrize(
    ("chosen", "xdg", "expected"),
    [
        ("/somewhere", "/xdg", Path("/somewhere")),
        ("", "/xdg", Path("/xdg/fuselog")),
        ("", "relative", Path.home() / ".cache/fuselog"),
        ("", "", Path.home() / ".cache/fuselog"),
    ],
)
def test_where_the_cache_lies(monkeypatch, chosen, xdg, expected):
    """FUSELOG_CACHE first, then XDG's folder, whose specification says to ignore a relative one."""
    monkeypatch.setenv("FUSELOG_CACHE", chosen)
    monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    assert cache_folder() == expected


@pytest.mark.paper
@given(st.data())
def test_no_damage_goes_unseen(tmp_path_factory, data):
    """Any byte changed or any tail cut off: the file gives its samples unharmed, or none."""
    path = tmp_path_factory.getbasetemp() / "damaged.bin"
    points = np.random.default_rng(0).standard_normal((4, 2))
    write_sets(path, {SMALL: points}, "a test")
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[place] ^= data.draw(st.integers(1, 255))
    else:
        del content[place:]
    path.write_bytes(content)
    found = read_set(path, SMALL)
    assert found is None or np.array_equal(found, points)


@pytest.mark.paper
@pytest.mark.parametrize("content", [b"", b"\n", b"PK\x03\x04", b"not ours\nat all"])
def test_a_damaged_file_is_computed_again_and_mended(folder, content):
    expected = cached_set(SMALL)
    only_file(folder).write_bytes(content)
    said = []
    assert np.array_equal(cached_set(SMALL, said.append), expected)
    assert "damaged or not a file of fuselog" in said[0]
    assert np.array_equal(cached_set(SMALL, pytest.fail), expected)


def test_a_renamed_file_is_not_trusted(folder):
    """A whole file with another set in it, as after a careless copy."""
    other = SetName(2, 4, seed=12)
    cached_set(other)
    only_file(folder).rename(folder / f"{SMALL}.bin")
    assert np.array_equal(cached_set(SMALL), compute_set(SMALL))


def test_a_cache_that_cannot_be_written_is_told_and_not_needed(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "file"))
    said = []
    assert np.array_equal(cached_set(SMALL, said.append), compute_set(SMALL))
    assert "are not stored" in said[-1]


def test_a_failed_write_leaves_nothing(folder, monkeypatch):
    """A disk that fills up between writing and renaming."""

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    cached_set(SMALL)
    assert list(folder.iterdir()) == []


SHARING = """
import os, pathlib, time
from fuselog.replay.inference.sampling import SetName, cached_set

pathlib.Path(f"ready-{os.getpid()}").touch()
while len(list(pathlib.Path().glob("ready-*"))) < 2:  # before either looks
    time.sleep(0.001)
for _ in range(4):
    print(cached_set(SetName(2, 4, seed=11)).tobytes().hex())
"""


@pytest.mark.paper
def test_processes_may_share_a_cache(folder, tmp_path):
    """Two at once, on an empty cache: the same samples for all, one whole file, no remains."""
    results = "".join(printed([SHARING] * 2, tmp_path, os.environ)).splitlines()
    assert len(results) == 8
    assert {*results} == {read_set(only_file(folder), SMALL).tobytes().hex()}


def test_impossible_sets_are_refused(folder):
    with pytest.raises(BadInput, match="give 5 or more"):
        cached_set(SetName(4, 4))
    assert not folder.exists()
