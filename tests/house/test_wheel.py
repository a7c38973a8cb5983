"""The wheel brings all that the demo needs, to an environment that holds nothing else."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
from importlib.metadata import distribution, distributions
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
# as `python -m build` does it, in one process: the source distribution, and the wheel from what is in it
BUILD = """
import os, sys, tarfile, tomllib, zlib
from importlib import import_module
compress = zlib.compressobj
zlib.compressobj = lambda level=0, *form: compress(0, *form)
_, root, dist = sys.argv
os.chdir(root)
backend = import_module(tomllib.load(open("pyproject.toml", "rb"))["build-system"]["build-backend"])
source = os.path.join(dist, backend.build_sdist(dist))
with tarfile.open(source) as archive:
    archive.extractall(dist, filter="data")
os.chdir(source.removesuffix(".tar.gz"))
backend.build_wheel(dist)
"""
# what an installer writes into the script
AS_THE_SCRIPT = """
import sys
from importlib.metadata import entry_points
[script] = entry_points(group="console_scripts", name="fuselog")
sys.exit(script.load()())
"""


@pytest.mark.paper
def test_the_demo_runs_from_the_wheel_in_another_folder() -> None:
    """Built from the source distribution; what it requires is linked to, as it is installed here.

    Unpacked is what an installer does with a wheel of Python, but for the script.
    """
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with TemporaryDirectory() as scratch:
        dist, bare, elsewhere = (Path(scratch, name) for name in ("dist", "bare", "elsewhere"))
        elsewhere.mkdir()

        def run(*command: str | Path) -> str:
            done = subprocess.run(
                list(map(str, command)), cwd=elsewhere, env=clean, capture_output=True, text=True
            )
            assert done.returncode == 0, done.stderr
            return done.stdout

        run(sys.executable, "-c", BUILD, ROOT, dist)
        (wheel,) = dist.glob("*.whl")
        venv.create(bare)
        scripts, packages = (
            Path(sysconfig.get_path(kind, "venv", {"base": str(bare)}))
            for kind in ("scripts", "purelib")
        )
        with ZipFile(wheel) as archive:
            archive.extractall(packages)
        python = scripts / "python"
        assert_holds_all_files(packages / "fuselog")
        link_to_what_is_required(packages)
        assert run(python, "-c", AS_THE_SCRIPT, "--version").split()[-1] in wheel.name
        demo = (
            "import fuselog as fl; from fuselog.pipeline.command_line import main; print(fl.__file__)\n"
            "from matplotlib.figure import Figure; Figure.draw = lambda *_: None\n"  # takes long
            "assert main('run landmarks --runs 2 --set duration_s=5 --out demo --json'.split()) == 0\n"
            "assert main('report demo'.split()) == 0"
        )
        place, _ = run(python, "-c", demo).split("\n", 1)
        assert Path(place).is_relative_to(bare)
        told = json.loads((elsewhere / "demo" / "result.json").read_text())
        assert told["metrics"]["ekf.position_rmse_m.robot1"] < 1.0
        assert (elsewhere / "report.html").stat().st_size > 100_000


def assert_holds_all_files(installed: Path) -> None:
    """Every file beside the modules, such as a template, is where its package is installed."""
    for room in ("pipeline", "recorders", "replay"):
        for path in (ROOT / room).rglob("*.*"):
            if path.parent.name != "__pycache__":
                assert (installed / path.relative_to(ROOT)).is_file(), path


def link_to_what_is_required(packages: Path) -> None:
    """What the wheel in this folder requires, and what that does, as it is installed here."""
    linked, asking = set[str](), list(distributions(path=[str(packages)]))
    while asking:
        for required in map(Requirement, asking.pop().requires or []):
            if required.name in linked or (
                required.marker and not required.marker.evaluate({"extra": ""})
            ):
                continue
            linked.add(required.name)
            asking.append(distribution(required.name))
            for top in {file.parts[0] for file in asking[-1].files or []} - {"..", "__pycache__"}:
                if not (packages / top).exists():
                    (packages / top).symlink_to(asking[-1].locate_file(top))
