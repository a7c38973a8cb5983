"""What the tests of the command line share: ways to run it, and a folder of good and of broken input."""

import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.writer import Writer

from fuselog.pipeline.command_line import main
from fuselog.pipeline.output.report import write_report
from fuselog.pipeline.output.report.kinds import run_sentences
from fuselog.pipeline.output.results import Outcome, Result, write_outcome
from fuselog.recorders.log import (
    Field,
    Schema,
    Stream,
    make_stream,
    open_log,
    read_streams,
    schemas,
    write_log,
)
from fuselog.recorders.recording import record_run
from tests.claims.few_runs import opposite
from tests.conftest import heeding_interrupts, without_drawing
from tests.goldens import keeping

SHORT = ["--set", "duration_s=2"]
# the modules whose outcomes become folders
WRITERS = (
    "fuselog.pipeline.api.estimates",
    "fuselog.pipeline.api.replays",
    "fuselog.pipeline.api.trajectories",
    "fuselog.pipeline.calibrating.ellipsoid",
    "fuselog.pipeline.comparing.comparing",
    "fuselog.pipeline.diagnosing.diagnosis",
    "fuselog.pipeline.runs.experiment",
    "fuselog.pipeline.sensing.outcome",
    "fuselog.pipeline.tuning.outcome",
)
# modules of tests that look at something else than numbers, by commands that others hold
ABOUT_OTHERS = (
    "bad_input",
    "campaigns",
    "catalog",
    "checkpoints",
    "faults",
    "impossible",
    "json",
    "known_answers",
    "outputs",
    "presenting",
    "remote",
    "report",
    "shipped_experiments",
)


class Said(NamedTuple):
    """What a command did: its exit code and its two streams."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Standard output as JSON."""
        return json.loads(self.out)


def run_here(*arguments: str | Path) -> Said:
    """The command line in this process: quick, and no warning goes unseen."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(each) for each in arguments])
    return Said(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def fuselog() -> Callable[..., Said]:
    """Run a command in this process."""
    return run_here


@pytest.fixture(scope="module", autouse=True)
def kept_numbers(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hold what any command finds to the numbers that are kept of it; those of studies in full."""
    in_full = "stud" in request.module.__name__
    if request.module.__name__.rpartition("test_")[2] in ABOUT_OTHERS:
        yield
        return

    def written(folder: Path, name: str, settings: dict[str, Any], outcome: Outcome) -> Result:
        hold(name, settings, outcome, in_full=in_full)
        assert opposite(name, settings, outcome.claims) == []
        result = write_outcome(folder, name, settings, outcome)
        if in_full and is_new(name, settings, outcome):
            assert_whole(result, told(result, folder))
        viewed(name, folder)
        return result

    def held(
        command: str, settings: Mapping[str, Any], outcome: Outcome, *, in_full: bool = True
    ) -> None:
        hold(command, settings, outcome, in_full=in_full)
        if in_full and is_new(command, settings, outcome):
            stated = {"study": command, "estimators": {}, **settings}
            with TemporaryDirectory() as place, without_drawing():
                told(write_outcome(Path(place), command, stated, outcome), Path(place))

    hold = keeping.hold_outcome
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keeping, "hold_outcome", held)
        for module in WRITERS:
            patch.setattr(f"{module}.write_outcome", written)
        yield


_TOLD: set[tuple[str, ...]] = set()


def is_new(name: str, settings: Mapping[str, Any], outcome: Outcome) -> bool:
    """Whether nothing was told of an experiment or study with these tables and figures."""
    key = name, settings.get("study", name), *outcome.tables, *outcome.figures
    is_known = key in _TOLD
    _TOLD.add(key)
    return not is_known


def told(result: Result, folder: Path) -> str:
    """Have `run`'s sentences and the report of what a study found; return the page."""
    run_sentences(result, folder)
    with TemporaryDirectory() as place:
        page = Path(place, "report.html")
        write_report([folder], page)
        return page.read_text(encoding="utf-8")


def assert_whole(result: Result, page: str) -> None:
    """A result has metrics, none of them of more runs than it has, and its page a value in each cell."""
    assert result.metrics
    stated = re.findall(r"first-(\d+)-runs", " ".join(result.metrics))
    assert max(map(int, stated), default=0) <= result.settings["runs"]
    assert not re.search(r">\s*-?((?i:nan|inf)|None)\s*<", page)


_VIEWED: set[tuple[str, bool]] = set()


def viewed(name: str, folder: Path) -> None:
    """Save a timeline with `view`, once per experiment; without one, `view` says so in a line."""
    has_timeline = (folder / "timeline.rrd").is_file()
    if (name, has_timeline) not in _VIEWED:
        _VIEWED.add((name, has_timeline))
        with TemporaryDirectory() as place:
            saved = Path(place, "saved.rrd")
            said = run_here("view", folder, "--save", saved)
            assert saved.is_file() == has_timeline, said.err
            assert (said.code, said.err.count("\n")) == ((0, 0) if has_timeline else (2, 1)), said.err


@pytest.fixture
def first_cause_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A diagnosis ends with its first cause, which takes a fraction of the time."""
    monkeypatch.setattr("fuselog.pipeline.diagnosing.diagnosis.MOST_SENTENCES", 1)


@pytest.fixture(scope="session")
def start_fuselog() -> Callable[..., subprocess.Popen[str]]:
    """Start a command as a process of its own."""

    def start(*arguments: str, **options: Any) -> subprocess.Popen[str]:
        command = [str(Path(sys.executable).with_name("fuselog")), *arguments]
        with heeding_interrupts():
            return subprocess.Popen(
                command, text=True, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
            )

    return start


# Names of modules that Python, a library or fuselog imports sooner or later.
SHADOWS = (
    *(
        "abc",
        "argparse",
        "click",
        "collections",
        "distributed",
        "fuselog",
        "json",
        "logging",
        "matplotlib",
    ),
    *("numba", "numpy", "pandas", "pickle", "pipeline", "psutil", "pydantic", "random", "recorders"),
    *("replay", "reprlib", "rerun", "rerun_cli", "rich", "scipy", "sitecustomize", "socket", "struct"),
    *("subprocess", "threading", "usercustomize"),
)
SHADOW = """
import os, sys
with open(os.environ["SHADOWED"], "a") as told:
    print(__file__, *sys.argv, file=told)
"""


@contextmanager
def shadowed(folder: Path) -> Iterator[None]:
    """Work in a folder with modules of these names, of which neither we nor a process may import one."""
    with TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        told = Path(place, "told")
        patch.setenv("SHADOWED", str(told))
        patch.chdir(folder)
        # what runs the tests may have the current folder on its path
        patch.setattr(sys, "path", [each for each in sys.path if each])
        for name in SHADOWS:
            (folder / f"{name}.py").write_text(SHADOW)
        yield
        assert not told.exists(), told.read_text()
        assert not {"", ".", str(folder)} & {*sys.path}
        for name in SHADOWS:
            (folder / f"{name}.py").unlink()


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of good and of broken input; tests read it and write nothing there."""
    folder = tmp_path_factory.mktemp("world")
    with chdir(folder), without_drawing():
        for command in (
            ["record", "landmarks", *SHORT, "-o", "log.mcap"],
            ["record", "landmarks", *SHORT, "--seed", "1", "-o", "other.mcap"],
            ["record", "landmarks", *SHORT, "--set", "robots=2", "-o", "two-robots.mcap"],
            [
                "record",
                "landmarks",
                *SHORT,
                "--set",
                "range_bearing.sigma_range_m=1",
                "-o",
                "noisy.mcap",
            ],
            ["replay", "log.mcap", "-e", "ekf"],
            ["run", "landmarks", *SHORT, "--runs", "2", "--out", "result"],
        ):
            assert run_here(*command).code == 0
        _break_files()
        _break_streams()
        _break_results()
        _write_experiments()
        _write_mrclam()
        Path("line.tum").write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in range(9)))
    return folder


def _break_files() -> None:
    whole = Path("log.mcap").read_bytes()
    Path("empty.mcap").touch()
    Path("text.mcap").write_text("no log\n")
    Path("cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    Path("damaged.mcap").write_bytes(damaged)
    Path("folder").mkdir()
    Path("moved").mkdir()
    shutil.copy("log.estimates.mcap", "moved")


def _break_streams() -> None:
    recording, run = record_run("landmarks", {"duration_s": 2.0}, 0)
    streams = {stream.topic: stream for stream in recording.streams}

    def write(path: str, changes: dict[str, Stream | None]) -> None:
        changed = {**streams, **changes}
        write_log(path, [stream for stream in changed.values() if stream is not None], run)

    for topic in (
        "/robot1/odometry",
        "/robot1/prior",
        "/robot1/range_bearing",
        "/landmarks",
        "/robot1/truth",
    ):
        name = topic.rpartition("/")[2]
        write(f"no-{name}.mcap", {topic: None})
        write(f"empty-{name}.mcap", {topic: streams[topic].take(slice(0, 0))})
    still = [streams["/robot1/odometry"], streams["/robot1/range_bearing"]]
    write("still.mcap", {stream.topic: stream.take(slice(0, 0)) for stream in still})
    covariance = -np.eye(3).reshape(1, 9)
    bad_prior = replace(
        streams["/robot1/prior"], columns={**streams["/robot1/prior"].columns, "covariance": covariance}
    )
    write("bad-prior.mcap", {"/robot1/prior": bad_prior})
    odometry = streams["/robot1/odometry"]
    times_ns, noise = odometry.publish_time_ns, odometry.metadata
    zeros = np.zeros(len(odometry))
    fields = (Field("sensor_time_ns", "time_ns"), Field("knots", "real"))
    knots = make_stream(
        odometry.topic, Schema("Odometry", "", fields), times_ns, metadata=noise, knots=zeros
    )
    write("other-fields.mcap", {odometry.topic: knots})
    bearing = make_stream(odometry.topic, schemas.BEARING, times_ns, target_id=zeros, bearing_rad=zeros)
    write("other-schema.mcap", {odometry.topic: bearing})
    _write_elsewhere("nan.mcap", "protobuf")
    _write_elsewhere("json.mcap", "json")


def _write_elsewhere(path: str, encoding: str) -> None:
    """A log by the official writer, which checks nothing: its odometry is NaN, or JSON."""
    log = open_log("log.mcap")
    with Path(path).open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, stream in read_streams(log, list(log.topics)).items():
            is_odometry = topic == "/robot1/odometry"
            schema = stream.schema
            own = encoding if is_odometry else "protobuf"
            schema_id = writer.register_schema(schema.full_name, own, schema.descriptor_set)
            channel = writer.register_channel(topic, own, schema_id, dict(stream.metadata))
            for row, time_ns in enumerate(stream.publish_time_ns.tolist()):
                values = {name: column[row].tolist() for name, column in stream.columns.items()}
                if is_odometry:
                    values["turn_radps"] = float("nan")
                message = schema.message_class(**values).SerializeToString()
                data = message if own == "protobuf" else json.dumps(values).encode()
                writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()


def _break_results() -> None:
    for name, text in {
        "garbled": "{",
        "list": "[]",
        "newer": '{"format": 2, "claims": {}, "new": 1}',
        "older": '{"format": 0, "fuselog": "0.0.1"}',
        "foreign": '{"experiment": "x", "metrics": {}, "claims": []}',
    }.items():
        Path(f"result-{name}").mkdir()
        Path(f"result-{name}/result.json").write_text(text)
    shutil.copytree("result", "result-damaged")
    Path("result-damaged/tables/steps.parquet").write_text("no table")


def _write_experiments() -> None:
    for name, text in {
        "garbled": "title = ",
        "untitled": 'study = "localization"',
        "unknown": 'title = "t"\nrnus = 3',
        "nothing": 'title = "t"\n[estimators.ekf]',
        "both": 'title = "t"\n[record]\nscenario = "landmarks"\n[import]\nsource = "mrclam"',
        "no-scenario": 'title = "t"\n[record]\nscenario = "landmark"',
        "label": 'title = "t"\n[record]\nscenario = "landmarks"\n[estimators."a/b"]\nkind = "ekf"',
        "misfit": 'title = "t"\n[record]\nscenario = "landmarks"\n[record.parameters]\n'
        "range_bearing = { rate_hz = 0.0 }\n[estimators.ekf]",
        "scenario": "[parameters]\nduration_s = 1",
        "deep": "title = " + "[" * 100_000,
        "digits": "title = " + "1" * 5000,
    }.items():
        Path(f"{name}.toml").write_text(text)


MRCLAM = {
    "Barcodes.dat": "1 5\n2 14\n6 63\n",
    "Landmark_Groundtruth.dat": "6 1.0 2.0 0.0 0.0\n",
    "Robot1_Groundtruth.dat": "".join(f"{time / 10} 0.0 0.0 0.0\n" for time in range(100, 121)),
    "Robot1_Odometry.dat": "".join(f"{time / 10} 0.0 0.0\n" for time in range(100, 120)),
    "Robot1_Measurement.dat": "10.5 63 2.2 1.1\n10.5 99 2.0 1.0\n",
}


def _write_mrclam() -> None:
    def write(folder: str, changes: dict[str, str | None]) -> None:
        Path(folder).mkdir()
        for name, text in {**MRCLAM, **changes}.items():
            if text is not None:
                Path(folder, name).write_text(text)

    write("mrclam", {})
    for name in MRCLAM:
        stem = name.partition(".")[0]
        write(f"mrclam-no-{stem}", {name: None})
        write(f"mrclam-empty-{stem}", {name: "# nothing\n"})
    write("mrclam-words", {"Robot1_Odometry.dat": "10.0 fast 0.0\n"})
    write("mrclam-columns", {"Robot1_Odometry.dat": "10.0 0.0\n"})
    write("mrclam-ragged", {"Robot1_Odometry.dat": "10.0 0.0 0.0\n10.1 0.0 0.0 0.0 7\n"})
    write("mrclam-past", {"Robot1_Odometry.dat": "-10.0 0.0 0.0\n"})
    write("mrclam-nan", {"Robot1_Groundtruth.dat": "10.0 nan 0.0 0.0\n"})
    write("mrclam-barcode", {"Barcodes.dat": "1 5\n"})
