"""What works with our estimators works with foreign filters; and none runs that nobody named."""

import json
import shutil
from pathlib import Path

import pytest

import fuselog as fl
from fuselog import BadInput
from pipeline.checking.golden import golden_of
from pipeline.checking.stored import write
from pipeline.command_line.process import main
from pipeline.output.results import read_result
from tests.replay.foreign.conftest import EXAMPLES, Compile

MINE = "lib:./robot_ekf.so"


@pytest.fixture
def here(compile_filter: Compile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log and the library."""
    library = compile_filter(EXAMPLES / "robot_ekf.c")
    monkeypatch.chdir(tmp_path)
    shutil.copy(library, tmp_path)
    fl.write("run.mcap", fl.record("landmarks", seed=4, duration_s=4.0))
    return tmp_path


def test_commands(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tuned, diagnosed, compared, held back for late messages, run by workers, swept."""
    free = ["--free", "sigma_range_m", "--set", "sigma_range_m=0.3", "--out", "tuned"]
    assert main(["tune", "run.mcap", "-e", MINE, *free]) == 0
    assert main(["replay", "run.mcap", "-e", MINE, "--settings", "tuned/settings.toml"]) == 0
    capsys.readouterr()
    biased = ["--set", "bias_range_m=1.0", "--set", "in_process=true"]
    assert main(["diagnose", "run.mcap", "-e", MINE, *biased, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hypotheses"] > 2
    assert main(["compare", "run.mcap", "-e", MINE, "-e", "ekf", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["differences"]
    assert {row["verdict"] for row in rows} <= {"unclear", "no difference"}
    late = ["--arrival-order", "--late", "wait:0.1"]
    assert main(["replay", "run.mcap", "-e", MINE, "-e", "ekf", "-o", "late.mcap", *late]) == 0
    Path("own.toml").write_text(
        'title = "mine"\nruns = 4\n[record]\nscenario = "landmarks"\nparameters = {duration_s = 2.0}\n'
        '[estimators.mine]\nkind = "lib"\npath = "robot_ekf.so"\n'
        "[estimators.ekf]\ngate_probability = 1.0\n"
    )
    assert main(["run", "own.toml", "--workers", "2", "--out", "two"]) == 0
    made = read_result(Path("two")).metrics
    assert made["mine.nees.robot1"] == pytest.approx(made["ekf.nees.robot1"], rel=1e-9)
    sweep = ["sweep", "own.toml", "--over", "mine.sigma_range_m=0.1,0.4", "--runs", "2", "--json"]
    capsys.readouterr()
    assert main(sweep) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]["mine.position_rmse_m.robot1"]
    assert found[0] < found[1]


CRAFTED = {"mine": {"kind": "exec", "command": "touch stolen"}}


def test_nothing_runs_that_nobody_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A golden, a result, a settings file, or a log that names a program does not start it."""
    golden = golden_of(settings={"estimators": CRAFTED})
    write(Path("crafted.golden.xz"), golden)
    Path("crafted.toml").write_text('[mine]\nkind = "exec"\ncommand = "touch stolen"\n')
    fl.replay("run.mcap", "dead-reckoning").save("result")
    stated = json.loads(Path("result/result.json").read_text())
    stated["settings"]["estimators"] = CRAFTED
    Path("result/result.json").write_text(json.dumps(stated))
    capsys.readouterr()
    for line in (
        "check run.mcap --against crafted.golden.xz",
        "check result --against new.golden.xz --update",
        "replay run.mcap -e ekf --settings crafted.toml",
        "replay run.mcap -e mine --settings crafted.toml",
        "tune run.mcap -e mine --free a --settings crafted.toml",
        "diagnose run.mcap -e mine --settings crafted.toml",
        "run run.mcap -e mine --settings crafted.toml",
        "compare result run.mcap",
    ):
        code, said = main(line.split()), capsys.readouterr().err
        assert code == 2, line
        assert said.count("\n") == 1
        assert not Path("stolen").exists(), line
    assert main(["check", "run.mcap", "--against", "crafted.golden.xz"]) == 2
    assert "names the program touch stolen, which runs only where you name it" in capsys.readouterr().err
    assert main(["check", "run.mcap", "--against", "crafted.golden.xz", "--allow-programs"]) == 2
    assert Path("stolen").exists()  # it is no filter, but it ran
    Path("stolen").unlink()
    assert main(["check", "run.mcap", "--against", "crafted.golden.xz"]) == 2  # the next does not


def test_a_golden_of_a_foreign_filter(here: Path) -> None:
    check = ["check", "run.mcap", "--against", "mine.golden.xz"]
    assert main([*check, "--update", "-e", MINE]) == 0
    assert main(check) == 2
    assert main([*check, "--allow-programs"]) == 0


def test_estimates_that_name_a_program_are_judged_without_it(here: Path) -> None:
    """What an estimates log says of its filter is not started either."""
    assert main(["replay", "run.mcap", "-e", MINE, "-o", "est.mcap"]) == 0
    Path("robot_ekf.so").unlink()
    assert main(["evaluate", "est.mcap"]) == 0
    with pytest.raises(BadInput, match="a program, which runs only where you name it"):
        fl.diagnose("est.mcap")
