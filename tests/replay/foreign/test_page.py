"""The page on filters of one's own, worked through; and its filter in C++."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fuselog as fl
from fuselog import BadInput
from fuselog.pipeline.command_line.process import main
from fuselog.pipeline.exploring.session import numbers_of, open_session
from tests.docs.test_worked_pages import DOCS, blocks_of
from tests.replay.foreign.conftest import EXAMPLES, HEADER, Compile

EIGEN = ("/usr/include/eigen3", "/usr/local/include/eigen3", "/opt/homebrew/include/eigen3")


@pytest.fixture
def drifter(compile_filter: Compile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's filter, in a folder with its log."""
    monkeypatch.chdir(tmp_path)
    [source] = [block for block in blocks_of("your-filter") if block.file == "drifter.c"]
    Path("drifter.c").write_text(source.text, encoding="utf-8")
    return compile_filter(Path("drifter.c").resolve())


def test_the_page_is_worked_through(drifter: Path) -> None:
    """Its commands; so a new user has a judged filter."""
    shutil.copy(drifter, "drifter.so")
    for block in blocks_of("your-filter"):
        for line in block.text.splitlines() if block.language == "sh" else ():
            words = shlex.split(line)
            if words[:1] == ["fuselog"]:
                assert main(words[1:]) == 0, line
    done = fl.replay("run.mcap", {"drifter": {"kind": "lib", "path": "./drifter.so"}})
    metrics = done.metrics.set_index("quantity")["value"]
    assert metrics["position_rmse_m"] < 5.0
    assert metrics["failed_runs"] == 0


@pytest.mark.paper
def test_without_innovations_it_is_tuned_by_the_truth(drifter: Path, compile_filter: Compile) -> None:
    """It is said; what it gives is what RMSE gives with them, and by the likelihood is refused."""
    said = ' \\"innovation\\": {\\"x_m\\": \\"linear\\", \\"y_m\\": \\"linear\\"},'
    text = Path("drifter.c").read_text(encoding="utf-8")
    assert said in text
    Path("silent.c").write_text(text.replace(said, ""), encoding="utf-8")
    silent = compile_filter(Path("silent.c").resolve())
    log = fl.record("vehicles", seed=7, vehicles=1, duration_s=4.0, stochastic=False)
    given = {"kind": "lib", "in_process": True}
    loud, mute = ({"mine": given | {"path": str(path)}} for path in (drifter, silent))
    tuned = [fl.tune(log, loud, "drift_density", by="rmse"), fl.tune(log, mute, "drift_density")]
    values = [each.parameters["value"].tolist() for each in tuned]
    assert values[0] == values[1]
    notes = [[each for each in of.notes if "mine gives no innovations" in each] for of in tuned]
    assert [len(each) for each in notes] == [0, 1]
    with pytest.raises(
        BadInput, match="mine has no innovations with a likelihood on this log; tune by one of"
    ):
        fl.tune(log, mute, "drift_density", by="likelihood")
    assert 1.0 < values[0][0] < 100.0


def test_it_is_explored(drifter: Path) -> None:
    """Sliders are of its own parameters alone; the command that does the same names the library."""
    log = fl.record("vehicles", seed=7, vehicles=1, duration_s=4.0)
    session = open_session(log, f"lib:{drifter}")
    assert [each.name for each in session.sliders] == ["drift_density"]
    played = [session.play("drifter", {"drift_density": each}).cases["vehicle1"] for each in (5.0, 50.0)]
    replayed = [
        fl.replay(log, f"lib:{drifter}", set={"drift_density": each}).metrics.set_index("quantity")
        for each in (5.0, 50.0)
    ]
    for case, metrics in zip(played, replayed, strict=True):
        assert numbers_of(case)["error, RMS"][0] == pytest.approx(metrics["value"]["position_rmse_m"])
    assert played[0].log_likelihood != played[1].log_likelihood
    assert f" -e lib:{drifter} --set drift_density=5.0" in session.command({"drift_density": 5.0})


def test_a_state_by_other_names_is_told_those_of_the_truth(
    drifter: Path, compile_filter: Compile, capsys: pytest.CaptureFixture[str]
) -> None:
    fl.write("run.mcap", fl.record("vehicles", vehicles=1, duration_s=3.0))
    both = "east, north are not judged: /vehicle1/truth lacks them; it has x_m, vx_mps, y_m, vy_mps"
    one = (
        "north is not judged: /vehicle1/truth lacks it; position_rmse_m covers only x_m; "
        "/vehicle1/truth also has y_m"
    )
    for label, renamed, said in (
        ("east", {"x_m": "east", "y_m": "north"}, both),
        ("north", {"y_m": "north"}, one),
    ):
        text = Path("drifter.c").read_text(encoding="utf-8").replace('\\"prior\\": \\"prior\\",', "")
        for own, other in renamed.items():
            text = text.replace(f'\\"{own}\\":', f'\\"{other}\\":')
        Path(f"{label}.c").write_text(text, encoding="utf-8")
        compile_filter(Path(f"{label}.c").resolve()).rename(f"{label}.so")
        assert main(["replay", "run.mcap", "-e", f"lib:./{label}.so", "--set", "in_process=true"]) == 0
        assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("what", ["prior", "truth"])
def test_a_prior_or_truth_by_another_name_is_refused(
    drifter: Path, compile_filter: Compile, what: str
) -> None:
    text = Path("drifter.c").read_text(encoding="utf-8")
    named = f'\\"{what}\\": \\"'
    assert named in text
    Path(f"no_{what}.c").write_text(text.replace(named, named + "my_"), encoding="utf-8")
    path = str(compile_filter(Path(f"no_{what}.c").resolve()))
    log = fl.record("vehicles", vehicles=1, duration_s=1.0)
    said = f"names the {what} /vehicle1/my_{what}, which is not in the log; it has /vehicle1/{what}"
    with pytest.raises(BadInput, match=said):
        fl.replay(log, {"mine": {"kind": "lib", "path": path, "in_process": True}})


def test_the_page_states_what_messages_were_measured_to_cost() -> None:
    """By `make bench`, to two digits."""
    speed = json.loads((DOCS / "speed.json").read_text(encoding="utf-8"))["foreign"]["rows"]
    loop, around, apart, *programs = (float(row[1].split()[0]) / 1000 for row in speed)
    page = (DOCS / "your-filter.md").read_text(encoding="utf-8")
    stated = (
        f"{loop:.2g} µs for the call in this process, {around:.2g} µs with all overhead; "
        f"{apart:.2g} µs in a separate process",
        f"{min(programs):.2g} to {max(programs):.2g} µs",
    )
    for each in stated:
        assert each in page


@pytest.mark.paper
def test_the_client_in_cpp_gives_the_same(drifter: Path) -> None:
    if shutil.which("c++") is None:
        pytest.skip("there is no compiler: c++")
    command = [
        "c++",
        "-std=c++17",
        "-O2",
        "-Wall",
        "-Werror",
        str(EXAMPLES / "drifter.cpp"),
        "-o",
        "drifter",
    ]
    subprocess.run(command, check=True)
    log = fl.record("vehicles", seed=7, vehicles=1, duration_s=15.0)
    ways = {
        "lib": {"kind": "lib", "path": str(drifter), "in_process": True},
        "stream": {"kind": "exec", "command": "./drifter"},
    }
    if sys.byteorder == "big":
        pytest.skip("frames are little-endian")
    for settings in ways.values():
        settings |= {"every_s": 0.3, "drift_density": 12.0}
    done = fl.replay(log, ways)
    [estimates] = done.estimates
    for leaf in ("state", "innovation"):
        lib, stream = (estimates[f"/estimates/{label}/vehicle1/{leaf}"] for label in ways)
        assert len(lib) > 10
        for name, column in lib.columns.items():
            np.testing.assert_allclose(stream[name], column, rtol=1e-12, err_msg=name)


def test_the_filter_with_eigen_gives_the_same(drifter: Path, tmp_path: Path) -> None:
    found = [place for place in EIGEN if Path(place).is_dir()]
    if not found or shutil.which("c++") is None:
        pytest.skip("Eigen is not installed (libeigen3-dev)")
    made = tmp_path / "drifter_eigen.so"
    flags = ["-std=c++17", "-O2", "-shared", "-fPIC", "-I", found[0], "-I", str(HEADER)]
    subprocess.run(["c++", *flags, str(EXAMPLES / "drifter_eigen.cpp"), "-o", str(made)], check=True)
    log = fl.record("vehicles", seed=7, vehicles=1, duration_s=15.0)
    paths = {"c": drifter, "eigen": made}
    given = {
        label: {"kind": "lib", "path": str(path), "in_process": True} for label, path in paths.items()
    }
    done = fl.replay(log, given)
    [estimates] = done.estimates
    c, eigen = (estimates[f"/estimates/{label}/vehicle1/state"] for label in paths)
    np.testing.assert_allclose(eigen["mean"], c["mean"], rtol=1e-9)
