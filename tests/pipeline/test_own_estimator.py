"""docs/your-estimator.md: its code is a package that is installed here, and its commands are run."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.command_line import main
from fuselog.recorders.log import Clock, open_log, read_streams
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.replaying.late import parse_late
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

PAGE = (Path(__file__).parents[2] / "docs" / "your-estimator.md").read_text()

# More entry points, for what goes wrong in the code of others.
BROKEN = """
from fuselog import BadInput, Simulator, batch, each_run, schemas
from radio import BeaconsParameters, LocateParameters, SIGNAL_STRENGTH, locate, simulate


def make(solve):
    return batch(
        "raises", parameters=LocateParameters, streams={"signal_strength": SIGNAL_STRENGTH},
        static={"/landmarks": schemas.LANDMARK}, components={"x_m": "linear", "y_m": "linear"},
        truth="truth", solve=each_run(solve),
    )


def divide(streams, parameters):
    return 1 / 0


def choosy(streams, parameters):
    if len(streams["/landmarks"]) < 4:
        raise BadInput("fewer than 4 beacons")
    return locate(streams, parameters)


def twice(parameters, rng):
    recording = simulate(parameters, rng)
    return type(recording)(recording.streams * 2)


DIVIDE, CHOOSY, NUMBER = make(divide), make(choosy), 7
TWICE = Simulator("records a topic twice", BeaconsParameters, twice)
"""


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's package as pip would install it, in a folder to work in."""
    folder = tmp_path_factory.mktemp("radio")
    project, *experiment = _blocks("toml")
    stated = tomllib.loads(project)["project"]
    code = "\n\n".join(_blocks("python"))
    (folder / "radio.py").write_text(code)
    for name, option in (("plain", "compiled=False"), ("arrays", "allocates=True")):
        changed = code.replace("    allocates=False,\n", f"    {option},\n")
        assert changed != code
        (folder / f"{name}.py").write_text(changed)
    (folder / "radio.toml").write_text("\n".join(experiment))
    (folder / "broken.py").write_text(BROKEN)
    groups = stated["entry-points"]
    groups["fuselog.estimators"] |= {
        "plain": "plain:NEAREST",
        "arrays": "arrays:NEAREST",
        "divide": "broken:DIVIDE",
        "choosy": "broken:CHOOSY",
        "number": "broken:NUMBER",
        "gone": "gone:GONE",
    }
    groups["fuselog.recorders"]["twice"] = "broken:TWICE"
    lines = [
        f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in each.items())
        for group, each in groups.items()
    ]
    information = folder / "radio-0.1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: radio\nVersion: 0.1\n")
    (information / "entry_points.txt").write_text("\n".join(lines))
    return folder


def _late_log(schema: fl.Schema) -> MemorySource:
    """Two of six messages come after the next one, whose stamp is a second newer."""
    stamps_s, arrived_s = np.array([1, 2, 3, 4, 5, 6]), np.array([1, 2, 4.1, 4, 6.9, 6])
    order = np.argsort(arrived_s)
    heard = fl.make_stream(
        "/walker/signal_strength",
        schema,
        (stamps_s[order] * 1e9).astype(int),
        log_time_ns=(arrived_s[order] * 1e9).astype(int),
        beacon_id=np.zeros(6, int),
        power_dbm=-50.0 - 7.0 * stamps_s[order] ** 2,
    )
    return memory_source(fl.Recording([heard]), fl.RunMetadata("late"))


def test_the_page_goes_back_for_late_messages() -> None:
    """What its recursion says last is what it says in order, unless a message was later than that."""
    code: dict[str, Any] = {}
    exec("\n\n".join(_blocks("python")), code)
    sources = [_late_log(code["SIGNAL_STRENGTH"])] * 2

    def last(late: str | None) -> list[float]:
        bound = code["LOUDNESS"].bind("own", sources[0].topics, fl.Parameters())
        policy = None if late is None else parse_late(late, arrival_order=True)
        order: Clock = "publish_time" if late is None else "log_time"
        said = collect(replay(sources, bound, order=order, late=policy, block_messages=2))
        loudness = said["/estimates/own/walker/loudness"]
        assert len(loudness) == 12 - len(said.get("/estimates/own/walker/skipped", ()))
        return loudness["power_dbm"][loudness.offsets[1:] - 1].tolist()

    in_order = last(None)
    assert last("rewind:2") == in_order == last("wait:2")
    assert last("rewind:1") == in_order
    assert last("rewind:0.5") != in_order


def test_ours_are_made_as_those_of_others() -> None:
    """By `recursive`, `batch`, or a model and a method; not so are libraries and programs.

    Those of nine axes are made by `recursive`, and then find their magnetometer.
    """
    makers = set()
    for name in set(available("estimators")) - {"exec", "lib"}:
        bind = load("estimators", name, fl.Estimator).bind
        makers.add(getattr(bind, "func", bind).__module__)
    nine_axes = "fuselog.replay.families.directional.orientation.magnetometers"
    assert makers == {
        "fuselog.replay.engine.api.binding",
        "fuselog.replay.inference.estimators",
        nine_axes,
    }


def _run(package: Path, commands: list[str], *, without: str = "") -> list[dict[str, Any]]:
    """Run commands in one process that has the package: exit code, output and errors of each.

    Figures are written without being drawn, as by `blank_figures`; a library may be missing.
    """
    code = (
        "import sys, json, io, shlex; from contextlib import *\n"
        f"sys.modules |= dict.fromkeys({without.split()})\n"
        "from fuselog.pipeline.command_line import main\n"
        "from matplotlib.figure import Figure; Figure.draw = lambda *_: None\n"
        "for line in json.load(sys.stdin):\n"
        "    out, err = io.StringIO(), io.StringIO()\n"
        "    with redirect_stdout(out), redirect_stderr(err): code = main(shlex.split(line)[1:])\n"
        "    print(json.dumps({'code': code, 'out': out.getvalue(), 'err': err.getvalue()}))\n"
    )
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        cwd=package,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(package), *sys.path])},
    )
    assert process.stderr == ""
    return [json.loads(line) for line in process.stdout.splitlines()]


COMMANDS = [line for block in _blocks("sh") for line in block.splitlines()]
COMMANDS.append("fuselog replay beacons.mcap -e locate -e nearest --json --out again.mcap")
COMPARED = [
    "fuselog record beacons --set duration_s=10 --out b.mcap",
    "fuselog replay b.mcap -e nearest -e plain --out both.mcap",
]
_FAILING = "fuselog replay {} -e {} --out out --json"
# with the words that standard error has
WRONG = {
    "fuselog record beacons --set duration_s=5 --out few.mcap --set beacons=3": "",
    "fuselog record beacons --set duration_s=5 --out enough.mcap": "",
    _FAILING.format(
        "enough.mcap", "divide"
    ): "estimator divide/walker raised ZeroDivisionError: division by zero",
    _FAILING.format("enough.mcap", "gone"): "estimator 'gone' (gone:GONE) raised ModuleNotFoundError",
    _FAILING.format("enough.mcap", "number"): "estimator 'number' (broken:NUMBER) is int",
    _FAILING.format("few.mcap", "choosy"): "fewer than 4 beacons",
    "fuselog record twice": "/landmarks: has 2 streams",
    _FAILING.format(
        "few.mcap enough.mcap", "choosy"
    ): "few.mcap: choosy walker failed at 4.500 s: fewer than 4 beacons",
    "fuselog estimators": "",
}


@pytest.fixture(scope="module")
def said(package: Path) -> dict[str, dict[str, Any]]:
    """What all commands said, in one process."""
    commands = [*COMMANDS, *COMPARED, *WRONG]
    return dict(zip(commands, _run(package, commands), strict=True))


@pytest.mark.paper
def test_the_page_works_as_written(package: Path, said: dict[str, dict[str, Any]]) -> None:
    """Every command of the page runs with its package; its model serves every method as it should."""
    assert len(COMMANDS) >= 9
    for command in COMMANDS:
        assert said[command]["code"] == 0, (command, said[command])
        assert said[command]["err"] == "", command
    metrics = json.loads((package / "walk/result.json").read_text())["metrics"]
    for method in ("ekf", "ukf", "iekf"):
        assert metrics[f"{method}.position_rmse_m.walker"] < 1.2
        assert (
            metrics[f"{method}.position_rmse_m.walker"] < 0.7 * metrics["locate.position_rmse_m.walker"]
        )
        assert metrics[f"{method}.nis_per_component.walker"] == pytest.approx(1, abs=0.1)
        assert metrics[f"{method}.nees.walker"] == pytest.approx(2, abs=0.5)
        within = metrics[f"{method}.within_1m_share.walker"]
        assert 0 < metrics["locate.within_1m_share.walker"] < within < 1
    assert metrics["locate.position_rmse_m.walker"] < metrics["nearest.position_rmse_m.walker"] < 4
    assert metrics["nearest.nees.walker"] == pytest.approx(2, abs=0.5)
    assert metrics["deaf.nis_per_component.walker"] < 0.3
    (evaluated,) = (said[command]["out"] for command in COMMANDS if "fuselog evaluate" in command)
    assert "within_1m_share" in evaluated
    assert "signal_strength" in said["fuselog models walker"]["out"]
    assert (package / "beacons.rrd").stat().st_size > 1000
    schema = open_log(package / "beacons.mcap").topics["/walker/signal_strength"].schema_name
    assert schema == "radio.SignalStrength"


@pytest.mark.paper
def test_what_the_page_compiles_is_what_it_says(package: Path, said: dict[str, dict[str, Any]]) -> None:
    """The compiled recursion equals the same function in plain Python, as the page promises."""
    assert [said[command]["code"] for command in COMPARED] == [0, 0]
    log = open_log(package / "both.mcap")
    of = {
        name: [topic for topic in log.topics if topic.startswith(f"/estimates/{name}/")]
        for name in ("nearest", "plain")
    }
    assert of["nearest"]
    assert of["plain"] == [topic.replace("/nearest/", "/plain/") for topic in of["nearest"]]
    for topics in zip(of["nearest"], of["plain"], strict=True):
        one, two = (read_streams(log, [each])[each] for each in topics)
        for name, column in one.columns.items():
            np.testing.assert_allclose(column, two[name], rtol=1e-9, atol=1e-12)


@pytest.mark.paper
def test_only_a_recursion_that_makes_arrays_needs_numba(package: Path) -> None:
    """Without numba all else works, also reading several chunks; what needs it says so in a sentence."""
    commands = [
        "fuselog record landmarks --set duration_s=90 --set robots=5 --compression none -o long.mcap",
        "fuselog info long.mcap",
        "fuselog replay long.mcap -e dead-reckoning",
        "fuselog record landmarks --set duration_s=3 --out robot.mcap",
        "fuselog replay robot.mcap -e ekf -e ukf",
        "fuselog diagnose robot.mcap -e ekf",
        "fuselog record beacons --set duration_s=5 --out heard.mcap",
        "fuselog replay heard.mcap -e nearest",
        "fuselog replay heard.mcap -e arrays --out arrays.mcap",
    ]
    *others, last = _run(package, commands, without="numba")
    assert len(open_log(package / "long.mcap").container.regions) > 2
    assert [each["code"] for each in others] == [0] * 8, others
    assert last["code"] == 2
    assert re.fullmatch(
        r"fuselog: estimator arrays/walker: follow is compiled by numba, which cannot be imported "
        r"\(.*\); pip install 'fuselog\[numba\]', or set .*\n",
        last["err"],
    )
    assert not (package / "arrays.mcap").exists()


@pytest.mark.paper
def test_the_code_of_others_that_fails_is_named(said: dict[str, dict[str, Any]]) -> None:
    """A plugin's mistake is one sentence that says whose it is, and hurts no other plugin."""
    for command, words in WRONG.items():
        assert words in said[command]["err"], command
        assert said[command]["err"].count("\n") == bool(words)
    codes = [said[command]["code"] for command in WRONG]
    assert codes == [0, 0, 2, 2, 2, 2, 2, 0, 0]
    ensemble = json.loads(said[_FAILING.format("few.mcap enough.mcap", "choosy")]["out"])
    assert ensemble["metrics"]["choosy.failed_runs.walker"] == 1
    listed = said["fuselog estimators"]["out"]
    assert "raised ModuleNotFoundError" in listed
    assert " ekf " in listed


def test_the_page_brings_a_log_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's snippet writes a log and its command replays it; a renamed field would break both."""
    page = (Path(__file__).parents[2] / "docs" / "your-log.md").read_text()
    (code,) = (
        each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "own.mcap" in each
    )
    (command,) = re.findall(r"```sh\n(fuselog replay own\.mcap .*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert main(shlex.split(command.replace("\\\n", ""))[1:]) == 0
    pose = "/estimates/ekf/robot1/pose"
    assert len(read_streams(open_log(tmp_path / "own.estimates.mcap"), [pose])[pose]["mean"]) == 100
    assert (tmp_path / "own.rrd").exists()
