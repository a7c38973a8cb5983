"""Every option of a command changes what is printed or written, or other tests have it, or none does."""

import os
import re
from contextlib import chdir
from hashlib import sha256
from inspect import Parameter, isfunction, signature
from pathlib import Path
from shutil import copytree, rmtree
from typing import NamedTuple

import click
import pytest

import fuselog as fl
from fuselog.pipeline.command_line import fuselog
from tests.pipeline.conftest import run_here

pytestmark = pytest.mark.usefixtures("blank_figures")

ROOT = Path(__file__).parents[2]
GROUP = click.Context(fuselog)
COMMANDS = {name: fuselog.get_command(GROUP, name) for name in fuselog.list_commands(GROUP)}


class Moves(NamedTuple):
    """A command line, and what is added to it to move each of its options."""

    usual: str
    options: dict[str, str]


OUT = "-o out.mcap"
RECORD = "record landmarks --set duration_s=3 --set fix.rate_hz=2"
TIMES = re.compile(r" *time \(s\)(?s:.*)")  # of which no two are alike, nor as wide
MOVES = [
    Moves(
        f"{RECORD} {OUT}",
        {
            "--out": "-o new.mcap",
            "--seed": "--seed 1",
            "--run": "--run 1",
            "--compression": "--compression lz4",
            "--foxglove": "--foxglove",
            "--set": "--set speed_mps=1",
        },
    ),
    Moves("record --again run.mcap -o out.mcap", {"--again": "--again other.mcap", "--run": "--run 1"}),
    Moves(
        f"replay run.mcap -e ekf {OUT}",
        {
            "--estimator": "-e ukf",
            "--every": "--every 0.03",
            "--arrival-order": "--arrival-order",
            "--end": "--end 1",
            "--save": "--save out.rrd",
            "--foxglove": "--foxglove",
            "--json": "--json",
            "--parameters": "--parameters",
            "--set": "--set ekf.gate_probability=0.5",
            "--settings": "--settings settings.toml",
        },
    ),
    Moves(f"replay run.mcap -e ekf --arrival-order {OUT}", {"--late": "--late drop"}),
    *(
        Moves(each, {"--gap-limit": "--gap-limit 0.001"})
        for each in (
            f"replay sparse.mcap -e ekf {OUT}",
            "diagnose sparse.mcap -e ekf",
            "tune sparse.mcap -e ekf --free sigma_range_m --by rmse --out out",
        )
    ),
    Moves(
        "stress run.mcap -e ekf",
        {
            "--json": "--json",
            "--seed": "--seed 1",
            "--set": "--set ekf.sigma_range_m=0.3",
            "--save": "--save fan.rrd",
        },
    ),
    Moves(
        "deploy run.mcap -e ekf --model robot -o robot_ekf",
        {"--json": "--json", "--set": "--set ekf.sigma_range_m=0.3", "--single": "--single"},
    ),
    Moves(
        f"replay run.mcap -e ekf --start 1 --start-from truth {OUT}",
        {"--start": "--start 2", "--start-sigma": "--start-sigma x_m=3"},
    ),
    Moves(
        "evaluate est.mcap",
        {
            "--align": "--align se2",
            "--metric": "--metric accuracy",
            "--out": "--out out",
            "--gap-limit": "--gap-limit 0.001",
            "--json": "--json",
        },
    ),
    Moves("evaluate est.mcap --out out", {"--errors": "--errors"}),
    Moves(
        "evaluate est.mcap --align se2 --delta 2",
        {
            "--delta": "--delta 1",
            "--delta-unit": "--delta-unit s",
            "--association": "--association nearest",
        },
    ),
    Moves(
        "evaluate est.txt --truth truth.txt",
        {
            "--truth": "--truth est.txt",
            "--time-offset": "--time-offset 0.05",
        },
    ),
    Moves(
        "evaluate est.txt --truth truth.txt --association nearest --time-offset 0.006",
        {"--max-difference": "--max-difference 0.005"},
    ),
    Moves("run landmarks --set duration_s=2 --runs 1 --out out", {"--parameters": "--parameters"}),
    Moves(
        "compare run.mcap -e ekf -e ukf",
        {
            "--estimator": "-e dead-reckoning",
            "--save": "--save out.rrd",
            "--stress": "--stress",
            "--set": "--set ekf.gate_probability=0.5",
        },
    ),
    Moves("compare five -e ekf -e ukf", {"--margin": "--margin 0.5"}),  # an interval needs five runs
    Moves("compare both.mcap est.txt --case robot1", {"--case": "--case left"}),
    Moves("compare est.mcap est-ukf.mcap", {"--gap-limit": "--gap-limit 0.001"}),
    Moves(
        f"cut run.mcap {OUT}",
        {
            "--out": "-o new.mcap",
            "--start": "--start 1",
            "--end": "--end 1",
            "--topics": "--topics /robot1/*",
            "--decimate": "--decimate /robot1/odometry=2",
        },
    ),
    Moves(
        f"merge left.mcap run.mcap {OUT}", {"--out": "-o new.mcap", "--offset": "--offset run.mcap=1"}
    ),
    Moves(
        f"relabel run.mcap --topic /robot1/=/left/ {OUT}",
        {
            "--out": "-o new.mcap",
            "--topic": "--topic /landmarks=/map",
            "--component": "--component x_m=east_m",
        },
    ),
    Moves(
        "export est.mcap --to csv --out out",
        {
            "--to": "--to tum",
            "--out": "--out other",
            "--topic": "--topic /estimates/ekf/robot1/pose -o new.csv",
        },
    ),
    Moves("info run.mcap", {"--all": "--all", "--json": "--json"}),
    Moves(
        "observability run.mcap",
        {
            "--window": "--window 1",
            "--scale": "--scale x_m=3",
            "--end": "--end 1",
            "--json": "--json",
            "--set": "--set sigma_range_m=3",
        },
    ),
    Moves(f"constrain drive.mcap {OUT}", {"--out": "-o new.mcap", "--set": "--set rolling_hz=10"}),
    Moves(f"constrain units.mcap --unit /body/inertial {OUT}", {"--unit": "--unit /second/inertial"}),
    Moves("models robot", {"--formulas": "--formulas", "--json": "--json"}),
    *(
        Moves(each, {"--json": "--json"})
        for each in ("estimators ekf", "experiments", "metrics", "scenarios")
    ),
    Moves(
        "sweep landmarks --set duration_s=2 --runs 1 --over speed_mps=0.5:1:2 --samples 1 --out out",
        {"--samples": "--samples 2", "--sampling": "--sampling random", "--seed": "--seed 2"},
    ),
]
# by command, what is run twice to see that nothing but an option changes what comes out
FIRST = {each.usual.split()[0]: each for each in reversed(MOVES) if " --out " not in each.usual}

# what is moved in another file: of all commands, and the commands whose other options are
OPTIONS_ELSEWHERE = {
    "--allow-programs": "tests/replay/foreign/test_everywhere.py",
    "--connect": "tests/replay/timeline/test_timeline.py",
    "--group": "tests/pipeline/test_catalog.py",
    "--model": "tests/pipeline/test_command_line.py",
    "--origin": "tests/pipeline/test_planes.py",
    "--recover": "tests/pipeline/test_command_line.py",
    "--scheduler": "tests/pipeline/test_campaigns.py",
    "--settings": "tests/pipeline/test_tuning.py",
    "--where": "tests/pipeline/test_catalog.py",
    "--workers": "tests/pipeline/test_campaigns.py",
}
COMMANDS_ELSEWHERE = {
    "cache": ("test_cache",),
    "calibrate": ("test_calibrating",),
    "catalog": ("test_catalog",),
    "check": ("test_catalog", "test_checking", "test_stored_goldens", "test_late"),
    "compare": ("test_comparing", "test_trajectories", "test_stressing"),
    "deploy": ("test_deploying",),
    "diagnose": ("test_battery", "test_diagnosing", "test_outputs"),
    "ellipsoid": ("test_ellipsoid",),
    "evaluate": ("test_trajectories", "test_command_line"),
    "explore": ("test_exploring",),
    "import": ("test_table_import", "test_ros_import", "../recorders/test_ulog"),
    "lint": ("test_catalog", "../recorders/test_linting"),
    "noise": ("test_noise", "test_outputs"),
    "replay": ("test_spans", "test_command_line"),
    "report": ("test_report", "test_outputs"),
    "run": ("test_experiments", "test_late", "test_report", "test_stressing"),
    "stress": ("test_stressing",),
    "sweep": ("test_sweeps", "test_campaigns", "test_outputs"),
    "tune": ("test_tuning",),
    "view": ("test_outputs", "test_spans", "test_presenting", "../replay/timeline/test_timeline"),
}


UNMOVED = {
    "calibrate --estimator": "no test moves it yet",
    "calibrate --folds": "no test moves it yet",
    "calibrate --gap-limit": "no test moves it yet",
    "calibrate --json": "no test moves it yet",
    "calibrate --out": "no test moves it yet",
    "calibrate --validate": "no test moves it yet",
    "evaluate --format": "it is found from the content, and another than that is refused",
    "evaluate --truth-format": "it is found from the content, and another than that is refused",
    "explore --gap-limit": "no test moves it yet",
    "stress --gap-limit": "tests/pipeline/test_stressing.py: of which errors a change counts",
    "view --gap-limit": "no two timelines have the same bytes",
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    with chdir(folder):
        (folder / "settings.toml").write_text("[ekf]\ngate_probability = 0.7\n")
        for line in (
            f"{RECORD} -o run.mcap --set range_bearing.latency_s=0.3",
            f"{RECORD} -o other.mcap --seed 3",
            *(f"{RECORD} -o five/{seed}.mcap --seed {seed}" for seed in range(5)),
            "record navigation --set duration_s=12 -o drive.mcap",
            "replay run.mcap -e ekf --every 0.03 -o est.mcap",
            "replay run.mcap -e ukf --every 0.03 -o est-ukf.mcap",
            "export est.mcap --to tum --topic /estimates/ekf/robot1/pose -o est.txt",
            "export run.mcap --to tum --topic /robot1/truth -o truth.txt",
            "relabel run.mcap --topic /robot1/=/left/ --topic /landmarks=/left/landmarks -o left.mcap",
            "merge left.mcap run.mcap -o both-robots.mcap",
            "replay both-robots.mcap -e ekf --every 0.03 -o both.mcap",
            "cut run.mcap --decimate /robot1/truth=3 -o sparse.mcap",
            "relabel drive.mcap --topic /body/=/second/ -o second.mcap",
            "merge drive.mcap second.mcap -o units.mcap",
        ):
            said = run_here(*line.split())
            assert said.code == 0, said.err
    return folder


def outcome(line: str, logs: Path, folder: Path) -> tuple[str, ...]:
    """What a command prints and writes."""
    copytree(logs, folder, dirs_exist_ok=True, copy_function=os.link)
    with chdir(folder):
        said = run_here(*line.split())
    assert said.code == 0, (line, said.err)
    new = sorted(each for each in folder.rglob("*") if each.is_file())
    found = (
        TIMES.sub("", said.out),
        *(f"{each.relative_to(folder)} {sha256(each.read_bytes()).hexdigest()}" for each in new),
    )
    rmtree(folder)
    return found


@pytest.mark.parametrize("moves", MOVES, ids=lambda moves: moves.usual)
@pytest.mark.paper
def test_every_option_changes_what_comes_out(
    moves: Moves, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # compiled for the memory in its certificate by tests of deploy
    monkeypatch.setattr("fuselog.pipeline.deploying.certificate._memory", lambda *_: None)
    place = tmp_path / "here"
    usual = outcome(moves.usual, logs, place)
    if moves in FIRST.values():
        assert outcome(moves.usual, logs, place) == usual
    same = {
        option
        for option, added in moves.options.items()
        if outcome(f"{moves.usual} {added}", logs, place) == usual
    }
    assert not same


def test_no_option_is_left_out():
    """Of one that is not moved above, the file that is to move it says its name."""
    moved = {(moves.usual.split()[0], option) for moves in MOVES for option in moves.options}
    left = {
        f"{name} {option}"
        for name, command in COMMANDS.items()
        for each in command.params
        if isinstance(each, click.Option)
        for option in [max(each.opts, key=len)]
        if (name, option) not in moved and not _is_named(name, option, each.opts)
    }
    assert left == set(UNMOVED)


def _is_named(command: str, option: str, spellings: list[str]) -> bool:
    paths = [ROOT / "tests" / "pipeline" / f"{each}.py" for each in COMMANDS_ELSEWHERE.get(command, ())]
    if option in OPTIONS_ELSEWHERE:
        paths = [ROOT / OPTIONS_ELSEWHERE[option]]
    spelt = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, spellings))})(?![\w-])")
    return any(spelt.search(path.read_text(encoding="utf-8")) for path in paths)


def test_what_is_not_stated_is_the_same_in_python_and_in_every_command():
    """One name has one default, but where results go; of commands the text that they parse."""
    found: dict[str, set[str]] = {}
    for name in dir(fl):
        if isfunction(function := getattr(fl, name)):
            for each in signature(function).parameters.values():
                found.setdefault(each.name, set()).add(str(each.default))
    shared = {name for name, defaults in found.items() if len(defaults) > 1}
    for command in COMMANDS.values():
        for option in command.params:
            if isinstance(option, click.Option) and option.default != click.Option(["--any"]).default:
                found.setdefault(option.name, set()).add(str(option.default))
    stated = {name: each - {"None", "()", "False", str(Parameter.empty)} for name, each in found.items()}
    assert {name for name, each in stated.items() if len(each) > 1} == {"out"}
    assert len(shared) > 10
    assert stated["gap_limit_s"] == {"0.2"}
