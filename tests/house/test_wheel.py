"""The wheel brings all that the demo needs, to an environment that holds nothing else."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.paper
def test_the_demo_runs_from_the_wheel_in_another_folder() -> None:
    """Built from the source distribution, installed with the versions of constraints.txt."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with TemporaryDirectory() as scratch:  # about a gigabyte, which pytest's own would keep
        dist, bare, elsewhere = (Path(scratch, name) for name in ("dist", "bare", "elsewhere"))
        elsewhere.mkdir()

        def run(*command: str | Path) -> str:
            done = subprocess.run(
                list(map(str, command)), cwd=elsewhere, env=clean, capture_output=True, text=True
            )
            assert done.returncode == 0, done.stderr
            return done.stdout

        run(sys.executable, "-m", "build", "--outdir", dist, ROOT)
        (wheel,) = dist.glob("*.whl")
        venv.create(bare, with_pip=True)
        scripts = Path(sysconfig.get_path("scripts", "venv", {"base": str(bare)}))
        run(
            scripts / "python",
            "-m",
            "pip",
            "install",
            "-q",
            "--no-compile",
            "-c",
            ROOT / "constraints.txt",
            wheel,
        )
        replayed = "fl.replay(fl.record('landmarks', duration_s=2.0), 'ekf')"
        door = f"import fuselog as fl; print(fl.__file__); print({replayed})"
        place, table = run(scripts / "python", "-c", door).split("\n", 1)
        assert Path(place).is_relative_to(bare)
        assert "position_rmse_m" in table
        assert run(scripts / "fuselog", "--version").split()[-1] in wheel.name
        told = run(scripts / "fuselog", "run", "landmarks", "--runs", "2", "--out", "demo", "--json")
        assert json.loads(told)["metrics"]["ekf.position_rmse_m.robot1"] < 1.0
        run(scripts / "fuselog", "report", "demo")
        assert (elsewhere / "report.html").stat().st_size > 100_000
