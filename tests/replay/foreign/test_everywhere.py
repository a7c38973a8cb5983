"""What works with our estimators works with foreign filters; and none runs that nobody named."""

import json
import shutil
from pathlib import Path

import pytest

import fuselog as fl
from fuselog import BadInput
from fuselog.pipeline.checking.golden import golden_of
from fuselog.pipeline.checking.stored import write
from fuselog.pipeline.command_line.process import main
from tests.replay.foreign.conftest import EXAMPLES, Compile

pytestmark = pytest.mark.usefixtures("blank_figures")

MINE = "lib:./robot_ekf.so"


@pytest.fixture
def here(compile_filter: Compile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log and the library."""
    library = compile_filter(EXAMPLES / "robot_ekf.c")
    monkeypatch.chdir(tmp_path)
    shutil.copy(library, tmp_path)
    fl.write("run.mcap", fl.record("landmarks", seed=4, duration_s=4.0))
    return tmp_path


@pytest.mark.paper
def test_what_ours_have(here: Path) -> None:
    """Tuned, diagnosed, compared, held back for late messages, and run by workers."""
    mine = {"kind": "lib", "path": "robot_ekf.so", "in_process": True}
    tuned = [
        fl.tune("run.mcap", each, "sigma_range_m", set={"sigma_range_m": 0.3, "gate_probability": 1.0})
        for each in ({"mine": mine}, "ekf")
    ]
    values = [found.parameters["value"].tolist() for found in tuned]
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    found = fl.diagnose("run.mcap", {"mine": mine}, set={"bias_range_m": 1.0})
    assert found.sentences
    assert found.hypotheses > 2
    compared = fl.compare("run.mcap", estimators=[{"mine": mine}, "ekf"])
    assert set(compared.table["verdict"]) <= {"undecided", "tie"}
    late = {"arrival_order": True, "late": "wait:0.1"}
    done = fl.replay("run.mcap", {"mine": mine, "ekf": {"gate_probability": 1.0}}, **late)
    rmse = done.metrics.set_index("quantity").loc["position_rmse_m", "value"]
    assert rmse.iloc[0] == pytest.approx(rmse.iloc[1], rel=1e-9)
    Path("own.toml").write_text(
        'title = "mine"\nruns = 4\n[record]\nscenario = "landmarks"\nparameters = {duration_s = 2.0}\n'
        '[estimators.mine]\nkind = "lib"\npath = "robot_ekf.so"\n'
        "[estimators.ekf]\ngate_probability = 1.0\n"
    )
    made = fl.run("own.toml", workers=2, out="two").result.metrics
    assert made["mine.nees.robot1"] == pytest.approx(made["ekf.nees.robot1"], rel=1e-9)


CRAFTED = {"mine": {"kind": "exec", "command": "touch stolen"}}


@pytest.mark.paper
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
    assert "the program touch stolen is named in a file and therefore" in capsys.readouterr().err
    assert main(["check", "run.mcap", "--against", "crafted.golden.xz", "--allow-programs"]) == 2
    assert Path("stolen").exists()  # it is no filter, but it ran
    Path("stolen").unlink()
    assert main(["check", "run.mcap", "--against", "crafted.golden.xz"]) == 2  # the next does not


def test_a_golden_of_a_foreign_filter(here: Path) -> None:
    check = ["check", "run.mcap", "--against", "mine.golden.xz"]
    assert main([*check, "--update", "-e", MINE]) == 0
    assert main(check) == 2
    assert main([*check, "--allow-programs"]) == 0


def test_settings_with_the_program_that_is_named(here: Path) -> None:
    """As `fuselog tune` writes them: they say nothing that was not named."""
    Path("tuned.toml").write_text(
        '[robot_ekf]\nkind = "lib"\npath = "./robot_ekf.so"\nbias_range_m = 1.0\n'
    )
    replay = ["replay", "run.mcap", "-o", "est.mcap", "--settings", "tuned.toml"]
    assert main([*replay, "-e", MINE]) == 0
    Path("other.so").write_bytes(Path("robot_ekf.so").read_bytes())
    assert main([*replay, "-e", "robot_ekf"]) == 2


def test_estimates_that_name_a_program_are_judged_without_it(here: Path) -> None:
    """What an estimates log says of its filter is not started either."""
    assert main(["replay", "run.mcap", "-e", MINE, "-o", "est.mcap"]) == 0
    Path("robot_ekf.so").unlink()
    assert main(["evaluate", "est.mcap"]) == 0
    with pytest.raises(BadInput, match="a program that is named in a file does not run"):
        fl.diagnose("est.mcap")
