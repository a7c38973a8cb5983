"""Pages that are worked from top to bottom: their files are written, their commands and code are run.

In a page, a block with a title is a file, a block of Python is run, and a line that begins with
`fuselog` or `python` is a command. Every line of a `text` block is something that was printed before it.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from rerun.chunk import RrdReader

import fuselog as fl
from fuselog.pipeline.diagnosing import diagnosis
from fuselog.pipeline.diagnosing.causes import seek
from fuselog.replay.timeline import show
from tests.pipeline.conftest import run_here

DOCS = Path(__file__).parents[2] / "docs"
WORKED = [
    "start",
    "inconsistent",
    "judge",
    "lint",
    "noise",
    "calibrate",
    "stress",
    "smooth",
    "contract",
    "from-filterpy",
    "from-stone-soup",
    "from-evo",
    "from-robot-localization",
    "from-matlab",
    "tracking",
    "your-log",
    "your-model",
    "timeline",
    "flight",
    "eight-hundred",
    pytest.param("navigation", marks=pytest.mark.paper),
]
FLIGHT = "sensors/sensors-data.tar.xz", "ulog/sample_logging_tagged_and_default_params.ulg"
PEERS = (
    "evo",
    "filterpy",
    "stonesoup",
)  # of the extra `bench`; without one its code is not run
MOST_CAUSES = 2  # the most that a page shows of a log
pytestmark = pytest.mark.usefixtures("blank_figures")
_BLOCK = re.compile(r"^```(\w*)(?: title=\"(.*?)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Fenced(NamedTuple):
    """A block of a page: its language, the file that it is, if any, and its text."""

    language: str
    file: str
    text: str


def blocks_of(name: str) -> list[Fenced]:
    """All blocks of a page, in order."""
    return [Fenced(*each) for each in _BLOCK.findall((DOCS / f"{name}.md").read_text(encoding="utf-8"))]


def commands_in(text: str) -> Iterator[list[str]]:
    """The commands of a block that are run: those of fuselog but the viewer's window, and Python."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:2] == ["fuselog", "view"] and not {"--save", "--screenshot"} & set(words):
            continue
        if words[:1] in (["fuselog"], ["python"]):
            yield words


def printed_by(words: list[str]) -> str:
    """What a command prints; it has to succeed."""
    if words[0] == "python":
        done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, check=True)
        return done.stdout
    if "--diagnose" in words:  # the page shows nothing of these runs
        words[words.index("--runs") + 1] = "2"
    said = run_here(*words[1:])
    assert said.code == 0 or words[1] == "lint", (words, said.err)  # lint finds something: exit code 1
    return said.out


def missing_peers(code: str, names: Mapping[str, Any]) -> list[str]:
    """The peers that code imports and that are not installed here, or "theirs", which they give."""
    missing = [name for name in PEERS if f"from {name}" in code and find_spec(name) is None]
    return missing or ["theirs"] * ("- theirs" in code and "theirs" not in names)


def flat(text: str) -> str:
    """Text without its line breaks and rules."""
    return " ".join(re.sub("[─│]", "", text).split())


@pytest.mark.paper
@pytest.mark.parametrize("name", WORKED)
def test_a_page_can_be_worked_through(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(diagnosis, "seek", lambda *given: seek(*given[:3], MOST_CAUSES))
    if name == "flight":
        _unpack_flight(request.getfixturevalue("real_data"))
    names: dict[str, Any] = {}
    printed, shown, left_out = "", 0, list[str]()
    for language, file, text in blocks_of(name):
        if file:
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            Path(file).write_text(text, encoding="utf-8")
        elif language == "python" and (missing := missing_peers(text, names)):
            left_out += missing
        elif language == "python":
            out = StringIO()
            with redirect_stdout(out):
                exec(text, names)
            printed = out.getvalue()
        elif language == "sh":
            printed = "\n".join(map(printed_by, commands_in(text)))
        elif language == "text":
            for line in text.splitlines():
                if line.strip() == "...":  # lines that the page leaves out
                    continue
                assert flat(line) in flat(printed), f"{name}.md shows\n{line}\nprinted was\n{printed}"
                shown += 1
    assert shown, "a worked page shows what its commands print"
    if left_out:
        pytest.skip(f"all but the code for {', '.join(left_out)}, which are not installed here")


def _unpack_flight(data: Path) -> None:
    archive, log = FLIGHT
    with tarfile.open(data / archive) as members:
        member = members.extractfile(f"./{log}")
        assert member is not None
        Path("flight.ulg").write_bytes(member.read())


def test_a_drawing_of_ones_own_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's function puts the distances of a replay on the timeline of its scenario."""
    names: dict[str, Any] = {}
    (code,) = (block.text for block in blocks_of("timeline") if "fl.Timeline" in block.text)
    exec(code, names)
    monkeypatch.setattr(show, "load", Mock(return_value=names["TIMELINE"]))
    log = fl.record("landmarks", seed=3, duration_s=2.0)
    fl.replay(log, "ekf").view(save=tmp_path / "own.rrd")
    drawn = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "own.rrd")).stream()}
    assert "/distance/robot1/ekf" in drawn


def test_readers_in_other_languages_read_what_fuselog_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The readers of the contract's page give every value of a log, bit for bit."""
    monkeypatch.chdir(tmp_path)
    for block in blocks_of("contract"):
        if block.file:
            Path(block.file).write_text(block.text, encoding="utf-8")
    assert run_here("record", "landmarks", "--set", "duration_s=2", "-o", "packed.mcap").code == 0
    plain = ["record", "landmarks", "--set", "duration_s=2", "--compression", "none", "-o", "plain.mcap"]
    assert run_here(*plain).code == 0
    names: dict[str, Any] = {}
    exec(Path("read_log.py").read_text(encoding="utf-8"), names)
    for path in ("packed.mcap", "plain.mcap"):
        _compare(names["read"](path), fl.open(path))
    if shutil.which("node") is None:
        pytest.skip("no node on this machine: the reader in JavaScript was not run")
    dump = "(name, value) => (typeof value === 'bigint' ? Number(value) : value)"
    Path("dump.mjs").write_text(
        "import { readFileSync } from 'node:fs'; import { read } from './read_log.mjs';\n"
        f"console.log(JSON.stringify(read(readFileSync(process.argv[2])), {dump}));\n"
    )
    done = subprocess.run(["node", "dump.mjs", "plain.mcap"], capture_output=True, text=True, check=True)
    listed, _, dumped = done.stdout.rstrip().rpartition("\n")
    columns = json.loads(dumped)
    assert listed.splitlines()[0] == f"/landmarks: {', '.join(sorted(columns['/landmarks']))}"
    _compare(columns, fl.open("plain.mcap"))


def _compare(read: dict[str, dict[str, list[Any]]], log: fl.LogSource) -> None:
    assert set(read) == set(log)
    for topic, columns in read.items():
        stream = log[topic]
        clocks = {"publish_time_ns": stream.publish_time_ns, "log_time_ns": stream.log_time_ns}
        ours = {**stream.columns, **clocks}
        assert set(columns) == set(ours)
        for name, values in columns.items():
            np.testing.assert_array_equal(np.array(values, ours[name].dtype), ours[name])
