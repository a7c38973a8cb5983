"""Logs at URLs: the bytes that are fetched, the cache, and what goes wrong in a network."""

import gc
import pickle
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
from fsspec.registry import known_implementations

from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import (
    Log,
    make_stream,
    open_log,
    read_streams,
    schemas,
    write_log,
)
from fuselog.recorders.recording import record_run
from fuselog.recorders.remote import backends, paths
from fuselog.recorders.remote.paths import located, partly
from fuselog.replay.engine.streams.sources import LogSource, in_memory
from tests.pipeline.site import Site, served

SECRET = "pass%20word"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of `landmarks`, and a log of 4 MB that no compression makes smaller."""
    folder = tmp_path_factory.mktemp("logs")
    recording, run = record_run("landmarks", {"duration_s": 2.0}, seed=7)
    write_log(folder / "run.mcap", recording.streams, run)
    noise = np.random.default_rng(0).standard_normal(100_000)
    stream = make_stream(
        "/range", schemas.RANGE, np.arange(100_000) * 10**7, target_id=0 * noise, range_m=noise
    )
    write_log(folder / "large.mcap", [stream], replace(run, scenario="unknown"))
    return folder


@pytest.fixture
def site(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """The logs on a web server; an empty cache, an empty current folder, and no pauses."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(backends, "PAUSES_S", (0.0, 0.0))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(logs, tmp_path / "site")
    with served(tmp_path / "site") as found:
        yield found


@pytest.fixture
def copies(tmp_path: Path) -> Callable[[], list[int]]:
    """The sizes of everything that the cache keeps of URLs."""
    folder = tmp_path / "cache" / "remote"
    return lambda: sorted(each.stat().st_size for each in folder.rglob("*") if each.is_file())


def hashes_of(log: Log) -> str:
    """The hash of everything in a log."""
    return hash_streams([in_memory(LogSource(log), log.topics)])


def test_the_summary_is_at_most_two_per_cent_of_a_log(site, copies):
    local = site.folder / "large.mcap"
    log, whole = open_log(partly(located(f"{site.url}/large.mcap"))), open_log(local)
    assert (log.run, log.topics) == (whole.run, whole.topics)
    assert site.sent < 0.02 * local.stat().st_size
    # a chunk that is needed is fetched, and the others are not
    (first,) = read_streams(log, ["/range"], end_ns=10**9).values()
    assert len(first) == 100
    assert site.sent < 0.5 * local.stat().st_size
    assert copies() == []


@pytest.mark.paper
def test_info_needs_only_the_summary(fuselog, site, copies):
    url, local = f"{site.url}/large.mcap", site.folder / "large.mcap"
    said = fuselog("info", url, "--json").json
    assert site.sent < 0.02 * local.stat().st_size
    assert copies() == []
    told = fuselog("info", local, "--json").json
    assert said == {**told, "path": url, "findings": None, "estimators": said["estimators"]}


@pytest.mark.paper
def test_commands_take_a_url(fuselog, site, copies):
    """The outputs are in the current folder, refer to the URL, and are those of the local log."""
    url, local = f"{site.url}/run.mcap", site.folder / "run.mcap"
    assert fuselog("replay", url, "-e", "ekf").code == 0
    fuselog("replay", local, "-e", "ekf")
    here, there = open_log("run.estimates.mcap"), open_log(site.folder / "run.estimates.mcap")
    assert hashes_of(here) == hashes_of(there)
    assert here.run.notes["log"] == url
    said = fuselog("evaluate", "run.estimates.mcap", "--json").json
    assert said["metrics"] == fuselog("evaluate", there.path, "--json").json["metrics"]
    # estimates at a URL have their log next to them
    (site.folder / "run.estimates.mcap").replace(site.folder / "e.mcap")
    assert fuselog("evaluate", f"{site.url}/e.mcap", "--json").json["metrics"] == said["metrics"]
    for number, path in enumerate((url, local)):
        assert fuselog("cut", path, "-o", f"{number}/cut.mcap", "--end", "1").code == 0
        assert fuselog("export", path, "-o", f"{number}/tables", "--to", "csv").code == 0
    outputs = [[each.read_bytes() for each in sorted(Path(name).rglob("*.*"))] for name in "01"]
    assert outputs[0] == outputs[1]
    assert len(outputs[0]) == 6
    assert fuselog("lint", url).out.replace(url, str(local)) == fuselog("lint", local).out
    assert sum(each.startswith("GET /run.mcap") for each in site.asked) == 1  # one copy serves all
    assert copies() == sorted([local.stat().st_size, (site.folder / "e.mcap").stat().st_size])
    assert fuselog("cache", "--json").json["holds"]["remote"]["files"] == 2
    fuselog("cache", "--clear")
    assert copies() == []


@pytest.mark.paper
def test_folders_patterns_and_archives(fuselog, site):
    """A folder is listed by its page, and a zip is read through the server; each log is a run."""
    place = site.folder / "day"
    place.mkdir()
    with ZipFile(place / "logs.zip", "w", ZIP_DEFLATED) as archive:
        for name in ("a.mcap", "b.mcap"):
            shutil.copy(site.folder / "run.mcap", place / name)
            archive.write(place / name, name)
    day = f"{site.url}/day/"
    for url in (day, f"{day}*.mcap", f"zip://*.mcap::{day}logs.zip", f"zip://*.mcap::{place}/logs.zip"):
        said = fuselog("replay", url, "-e", "ekf", "-o", "out", "--json")
        names = [Path(each).name for each in said.json["written"]]
        assert names == ["a.estimates.mcap", "b.estimates.mcap"]
        shutil.rmtree("out")
    assert fuselog("info", f"zip://a.mcap::{day}logs.zip").code == 0
    rows = fuselog("lint", day, "--json").json["logs"]
    assert [Path(row["log"]).name for row in rows] == ["a.mcap", "b.mcap"]


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("cuts", [2, 9])
def test_a_cut_connection_is_retried(site, copies, monkeypatch, ranges, cuts):
    """From where it was cut, or from the beginning if the server can only send the whole file."""
    monkeypatch.setattr(backends, "_BLOCK_BYTES", 1 << 20)
    site.ranges, site.cuts, site.spared = ranges, cuts, 1 + ranges
    log, local = located(f"{site.url}/large.mcap"), site.folder / "large.mcap"
    if cuts < 3:
        assert log.read_bytes() == local.read_bytes()
        assert copies() == [local.stat().st_size]
        assert site.sent < (1.5 if ranges else 3.5) * local.stat().st_size
    else:
        with pytest.raises(BadInput, match="large\\.mcap: the request failed 3 times"):
            log.read_bytes()
        assert copies() == []


def test_a_server_without_ranges(fuselog, site, copies, caplog):
    """Its logs are copied, also for `info`, which says so."""
    site.ranges = False
    said = fuselog("info", f"{site.url}/large.mcap")
    size = (site.folder / "large.mcap").stat().st_size
    assert said.code == 0
    assert f"all of it is fetched, {size / 1e6:.3g} MB, because its server cannot" in caplog.text
    assert copies() == [size]


def test_a_log_without_a_summary(fuselog, site, caplog):
    whole = (site.folder / "run.mcap").read_bytes()
    (site.folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    said = fuselog("info", f"{site.url}/cut.mcap")
    local = fuselog("info", site.folder / "cut.mcap")
    assert said.err.splitlines()[-1] == local.err.replace(str(site.folder), site.url).strip()
    assert "because it has no index" in caplog.text


@pytest.mark.parametrize(
    ("name", "fault", "reason"),
    [
        ("absent.mcap", {}, "not found; check the URL"),
        ("run.mcap", {"status": 401}, "access refused; check the credentials"),
        ("run.mcap", {"status": 403}, "access refused; check the credentials"),
        ("run.mcap", {"status": 503}, "the request failed 3 times \\(status 503\\)"),
        ("run.mcap", {"silent_s": 0.2}, "no answer within 0.1 s, 3 times"),
        ("run.mcap", {"login": True}, "the server sent a web page instead of the log"),
        ("run.mcap", {"stated_bytes": 9}, "the request failed 3 times \\(WrongLength"),
        ("run.mcap", {"stated_bytes": -9}, "the request failed 3 times|cut off|its footer is missing"),
    ],
)
@pytest.mark.parametrize("command", [["info"], ["replay", "-e", "ekf"]])
def test_faults_are_one_sentence(fuselog, site, monkeypatch, name, fault, reason, command):
    """It names the URL without its secrets, and nothing is left behind."""
    if "silent_s" in fault:
        monkeypatch.setattr(backends, "PATIENCE_S", 0.1)
    vars(site).update(fault)
    url = f"{site.url.replace('//', f'//me:{SECRET}@')}/{name}?sig={SECRET}"
    first, *options = command
    said = fuselog(first, url, *options)
    assert said.code == 2
    assert len(said.err.splitlines()) == 1
    assert SECRET not in said.out + said.err
    assert f"{site.url.replace('//', '//***@')}/{name}?sig=***: " in said.err
    assert re.search(reason, said.err)
    assert list(Path().iterdir()) == []


@pytest.mark.paper
def test_results_keep_no_password(fuselog, site, monkeypatch):
    """Another process can therefore not open such a log again, and says why."""
    url = f"{site.url.replace('//', f'//me:{SECRET}@')}/run.mcap?sig={SECRET}"
    shown = f"{site.url.replace('//', '//***@')}/run.mcap?sig=***"
    assert fuselog("run", url, "-e", "ekf", "--out", "result").code == 0
    assert fuselog("replay", url, "-e", "ekf", "-o", "estimates.mcap").code == 0
    assert fuselog("evaluate", "estimates.mcap").code == 0
    assert shown in Path("result/result.json").read_text()
    files = [each for each in Path().rglob("*") if each.is_file()]
    assert not [each for each in files if SECRET.encode() in each.read_bytes()]
    monkeypatch.setattr(paths, "_urls", {})
    assert fuselog("evaluate", "estimates.mcap").err == (
        f"fuselog: {shown}: was stored without its password or key; give the complete URL\n"
    )


def test_a_log_that_changes_is_not_mixed(site, monkeypatch):
    """Neither while it is copied, nor between two readings, nor for another process."""
    log, place = located(f"{site.url}/large.mcap"), site.folder / "large.mcap"
    parts = open_log(partly(log))
    read_streams(parts, ["/range"], end_ns=1)
    other = pickle.dumps(log) if log.identity else b""
    fetch = backends.blocks_of

    def changing(*arguments):
        for number, block in enumerate(fetch(*arguments)):
            if number == 0:
                place.write_bytes(place.read_bytes())
            yield block

    monkeypatch.setattr("fuselog.recorders.remote.copies.blocks_of", changing)
    for read in (
        log.read_bytes,
        pickle.loads(other).read_bytes,
        lambda: read_streams(parts, ["/range"]),
    ):
        with pytest.raises(BadInput, match="large\\.mcap: changed while it was read"):
            read()
    monkeypatch.undo()


def test_nothing_is_asked_in_garbage_collection(site):
    """It may run while this thread holds a lock that the thread of the network needs."""
    path = partly(located(f"{site.url}/large.mcap"))

    def reading() -> Iterator[bytes]:
        with paths.open_binary(path) as file:
            yield file.read(10_000)

    held, begun = paths.open_binary(path), reading()
    assert next(begun) == held.read(10_000)
    site.asked.clear()
    del held, begun
    gc.collect()
    assert site.asked == []


def test_a_file_without_a_version_is_fetched_again(fuselog, site):
    """Whether a copy is still right cannot be known if the server states no version."""
    site.versions = False
    for _ in range(2):
        site.asked.clear()
        assert fuselog("lint", f"{site.url}/run.mcap").code == 0
        assert [each for each in site.asked if each.startswith("GET")] == ["GET /run.mcap"]


def test_the_cache_is_bounded(fuselog, site, copies, monkeypatch):
    sizes = [(site.folder / name).stat().st_size for name in ("run.mcap", "large.mcap")]
    large, small = f"{site.url}/large.mcap", f"{site.url}/run.mcap"
    monkeypatch.setenv("FUSELOG_REMOTE_GB", f"{sum(sizes) / 1e9:.9f}")
    for url in (large, small, large):
        fuselog("lint", url)
    assert copies() == sorted(sizes)
    shutil.copy(site.folder / "run.mcap", site.folder / "other.mcap")
    fuselog("lint", f"{site.url}/other.mcap")
    assert copies() == sorted(sizes)  # the copy used least recently was that of run.mcap
    site.asked.clear()
    fuselog("lint", large)
    assert all(each.startswith("HEAD") for each in site.asked)
    monkeypatch.setenv("FUSELOG_REMOTE_GB", "0.001")
    shutil.copy(site.folder / "large.mcap", site.folder / "new.mcap")
    assert "set FUSELOG_REMOTE_GB to a larger number" in fuselog("lint", f"{site.url}/new.mcap").err


def test_missing_file_systems_name_what_to_install(fuselog, monkeypatch):
    monkeypatch.setitem(
        known_implementations, "rare", {"class": "rarefs.RareFileSystem", "err": "install it"}
    )
    said = fuselog("info", "rare://bucket/run.mcap").err
    assert said.endswith("/run.mcap: needs rarefs, which is not installed; run: pip install rarefs\n")
    assert "fsspec has no file system of this name" in fuselog("info", "nosuch://x/run.mcap").err
    for name in [each for each in sys.modules if each.partition(".")[0] == "fsspec"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert "pip install 'fuselog[remote]'" in fuselog("info", "https://x/run.mcap").err


def test_a_catalog_of_urls(fuselog, site, copies):
    """Only summaries are fetched, at most 2 % of the data; of an unchanged log only its version."""
    place = f"{site.url}/"
    total = sum(each.stat().st_size for each in site.folder.glob("*.mcap"))
    assert fuselog("catalog", place, "-o", "logs.parquet").code == 0
    assert site.sent < 0.02 * total
    sent, again = site.sent, fuselog("catalog", place, "-o", "logs.parquet", "--json").json
    assert (again["unchanged"], copies()) == (2, [])
    assert site.sent - sent < 1000  # the list of the folder
    rows = {row["log"].rpartition("/")[2]: row for row in again["logs"]}
    assert rows["large.mcap"]["messages"] == 100_000
    replayed = fuselog("replay", "logs.parquet", "-e", "ekf", "--where", "fits_robot", "--json").json
    [row] = replayed["logs"]
    estimates = open_log(Path("out/replay") / row["estimates"])
    assert (row["log"], estimates.run.notes["log"]) == (f"{place}run.mcap", f"{place}run.mcap")
    shutil.copy(site.folder / "large.mcap", site.folder / "run.mcap")
    assert "run.mcap: changed after it was catalogued" in fuselog("lint", "logs.parquet").err
    site.login = True
    rows = fuselog("catalog", f"{place}run.mcap", "-o", "new.parquet", "--json").json["logs"]
    assert rows[0]["problem"].startswith("the server sent a web page instead of the log")
