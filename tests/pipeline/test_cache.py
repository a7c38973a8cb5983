"""`fuselog cache`: how much it holds; clearing removes what fuselog wrote and nothing else."""

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import fuselog as fl
from fuselog.recorders.compiling.cache import kept_files, write_checked


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of two kernels and one set of samples."""
    place = tmp_path / "cache"
    monkeypatch.setenv("FUSELOG_CACHE", str(place))
    for name in ("kernels/a.bin", "kernels/b.bin", "samples/c.bin"):
        write_checked(place / name, b"content", "a test")
    return place


def test_it_says_how_much_there_is_and_clears_it(place: Path, fuselog: Callable[..., Any]) -> None:
    size = (place / "samples/c.bin").stat().st_size
    holds = {"kernels": {"files": 2, "bytes": 2 * size}, "samples": {"files": 1, "bytes": size}}
    told = {"folder": str(place), "cleared": False, "holds": holds, "others": 0}
    assert fuselog("cache", "--json").json == told
    assert f"{place}: holds 3 files" in fuselog("cache").out
    assert fuselog("cache", "--clear", "--json").json == {**told, "cleared": True}
    assert not [path for path in place.rglob("*") if path.is_file()]
    assert fuselog("cache", "--clear").out == f"{place}: cleared 0 files\n"


def test_what_fuselog_did_not_write_stays(place: Path, fuselog: Callable[..., Any]) -> None:
    ours = (place / "kernels/a.bin").read_bytes()
    others = {
        "kernels/notes.txt": b"mine",
        "kernels/own.bin": b"mine",
        "kernels/changed.bin": ours + b"and mine",
        "kernels/deeper/a.bin": ours,
        "a.bin": ours,
    }
    for name, content in others.items():
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_bytes(content)
    said = fuselog("cache", "--clear")
    assert said.out.splitlines()[0] == f"{place}: cleared 3 files"
    assert said.out.splitlines()[-1].startswith("5 other files remain")
    left = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    assert left == {place / name: content for name, content in others.items()}


@pytest.mark.unix
def test_links_and_folders_that_others_may_write_to_stay(
    place: Path, fuselog: Callable[..., Any]
) -> None:
    elsewhere = place.with_name("elsewhere.bin")
    (place / "kernels/a.bin").rename(elsewhere)
    (place / "kernels/a.bin").symlink_to(elsewhere)
    (place / "samples").chmod(0o777)
    assert f"{place}: cleared 1 files" in fuselog("cache", "--clear").out
    assert (place / "kernels/a.bin").read_bytes() == elsewhere.read_bytes()
    assert (place / "samples/c.bin").exists()


@pytest.mark.paper
@pytest.mark.skipif(os.environ.get("FUSELOG_UNCOMPILED") == "1", reason="disables compilation")
def test_what_was_compiled_ahead_is_not_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start_fuselog: Callable[..., subprocess.Popen[str]]
) -> None:
    """By another process than the one that compiled it, for another log with the same sensors."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")  # so that the command needs no workers
    warming = start_fuselog("cache", "--warm", "batch-reactor:ekf", "--json")
    made = json.loads(warming.communicate()[0])["replays"]
    assert [(each["scenario"], each["why_not"]) for each in made] == [("batch-reactor", "")]
    kept = set(kept_files())
    assert kept
    log = tmp_path / "log.mcap"
    fl.write(log, fl.record("batch-reactor", seed=5))
    replaying = start_fuselog("replay", str(log), "-e", "ekf", "-o", f"{tmp_path}/est.mcap")
    replaying.communicate()
    assert replaying.returncode == 0
    new = {each.name.partition("-")[0] for each in set(kept_files()) - kept}
    assert new <= {"_scan", "_sort", "_agree"}  # which this process may have had from another cache


def test_what_cannot_be_compiled_ahead_is_one_sentence(place: Path, fuselog: Callable[..., Any]) -> None:
    for arguments, said in (
        (["--warm", "robt"], "no model 'robt'; did you mean 'robot'?"),
        (["--warm", "robot:ekff"], "no method 'ekff'; did you mean 'ekf'?"),
        (["--warm", "robot:smoother:ekff"], "'ekff' is not a filter"),
        (["--warm", "robot:analytic"], "the model lacks exact moments"),
        (["robot"], "add --warm"),
        (["--warm", "--clear"], "give the options in two separate commands"),
    ):
        told = fuselog("cache", *arguments)
        assert (told.code, said in told.err) == (2, True), told.err
    with pytest.raises(fl.BadInput, match="did you mean 'ukf'"):
        fl.precompile(methods="ukff")
    place.chmod(0o777)
    assert "set FUSELOG_CACHE to a folder of your own" in fuselog("cache", "--warm", "robot").err
