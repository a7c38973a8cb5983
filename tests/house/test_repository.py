"""What the repository says of itself: the rooms, the commands, the systems it is tried on."""

import ast
import os
import re
import tomllib
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from fuselog.replay.timeline.viewer import PACKAGES
from tests.house.sources import PATHS, text_of, tree_of
from tests.replay.engine.processes import printed

ROOT = Path(__file__).parents[2]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_picture_of_the_house_is_what_is_checked() -> None:
    """Rooms in the order of import-linter's contracts, and every room that there is."""
    (picture,) = re.findall(r"```\n(fuselog .*?)```", CONTRIBUTING, re.DOTALL)
    shown = re.findall(r"^ *(\w+)", picture, re.MULTILINE)
    outer, inner, *_ = PYPROJECT["tool"]["importlinter"]["contracts"]
    rooms = [room for layer in inner["layers"] for room in layer.split(" | ")]
    assert shown == [
        "fuselog",
        *(each for top in outer["layers"] for each in [top, *(rooms if top == "replay" else [])]),
    ]
    assert set(rooms) == {path.parent.name for path in ROOT.glob("replay/*/__init__.py")}


def test_families_are_the_same_everywhere_and_no_part_of_the_core_may_import_one() -> None:
    rooms = ("pipeline", "recorders", "replay")
    named = [
        {each.parent.name for each in (ROOT / room / "families").glob("*/__init__.py")} for room in rooms
    ]
    named += [
        {each.stem for each in (ROOT / "docs" / "families").glob("*.md")},
        {each.name for each in (ROOT / "data" / "experiments").iterdir() if each.is_dir()},
    ]
    assert all(each == named[0] for each in named)
    (contract,) = [
        each for each in PYPROJECT["tool"]["importlinter"]["contracts"] if each["type"] == "forbidden"
    ]
    parts = {
        f"fuselog.{room}.{each.stem}"
        for room in rooms
        for each in (ROOT / room).glob("[a-z]*")
        if each.suffix == ".py" or (each / "__init__.py").exists()
    }
    families = {f"fuselog.{room}.families" for room in rooms}
    assert {*contract["forbidden_modules"]} == families
    assert {*contract["source_modules"]} == parts - families


WITHOUT_FAMILIES = """
import sys
from pathlib import Path
from fuselog.recorders import registry

class Nowhere:
    def find_spec(self, name, path=None, target=None):
        if ".families" in name:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Nowhere())
everywhere = registry.available
registry.available = lambda kind: {
    name: each for name, each in everywhere(kind).items() if ".families." not in each.value
}
import fuselog as fl
from fuselog.replay.timeline.show import show

run = fl.record("landmarks", duration_s=3.0)
done = fl.replay(run, ["ekf", "dead-reckoning"])
rmse_m = done.metrics[done.metrics["quantity"] == "position_rmse_m"]["value"].tolist()
print(0.0 < rmse_m[0] < rmse_m[1])
show(run, {}, [], save=Path("run.rrd"))
print(Path("run.rrd").exists())
"""


@pytest.mark.paper
def test_the_core_works_without_any_family(tmp_path: Path) -> None:
    """A robot is recorded, followed, judged and drawn where no family can be imported."""
    [said] = printed([WITHOUT_FAMILIES], tmp_path, os.environ, "ignore")
    assert said.split() == ["True", "True"]


def test_the_groups_of_entry_points_are_those_that_are_told() -> None:
    design = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    told = re.findall(r"`(fuselog\.\w+)`(?=[^|\n]*\| [a-z])", design)
    assert {*PYPROJECT["project"]["entry-points"]} <= {*told}


@pytest.mark.parametrize(
    "name", ["README.md", "CONTRIBUTING.md", "docs/design.md", ".pre-commit-config.yaml"]
)
def test_what_is_named_is_there(name: str) -> None:
    """Targets of make, and files."""
    text = (ROOT / name).read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))
    named = set(re.findall(r"(?:`|^|entry: )make ([a-z-]+)", text, re.MULTILINE))
    assert named
    assert named <= targets
    for path in re.findall(r"`((?:replay|recorders|pipeline|tests|data|docs|\.github)/[^` <]*)`", text):
        assert "gliders" in path or (ROOT / path).exists(), path


def test_the_types_that_one_meets_are_where_it_says() -> None:
    """And in the picture of the way of data, what makes them."""
    design = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    glossary = re.findall(r"^\| `(\w+)` \| .* \| `(\S+)` \|$", design, re.MULTILINE)
    (picture,) = re.findall(r"```\n +what flows .*?\n(.*?)```", design, re.DOTALL)
    assert len(glossary) >= 12
    for name, path in glossary:
        assert f"class {name}" in (ROOT / path).read_text(encoding="utf-8"), (name, path)
    for line in picture.splitlines():
        *_, makers, path = re.split(r"  +", line)
        for name in re.findall(r"\w+", makers):
            assert re.search(rf"\b{name}\b", (ROOT / path).read_text(encoding="utf-8")), (name, path)


def test_ci_runs_the_two_commands_everywhere() -> None:
    workflow: dict[str, Any] = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text("utf-8"))
    job = workflow["jobs"]["commands"]
    matrix = job["strategy"]["matrix"]
    assert matrix["system"] == ["ubuntu-latest", "macos-latest", "windows-latest"]
    assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"]
    assert f">={matrix['python'][0]}" == PYPROJECT["project"]["requires-python"]
    assert job["defaults"]["run"]["shell"] == "bash"
    driver, demo, older, test = [step for step in job["steps"] if "run" in step][-4:]
    assert driver["if"] == "runner.os == 'Linux'"
    assert set(PACKAGES.split()) <= set(driver["run"].split())  # else tests of pictures are skipped
    assert [demo["run"], test["run"]] == ["make demo PYTHON=python", "make test PYTHON=python"]
    [own], [one] = matrix["cpu"], matrix["include"]
    assert one["cpu"] != own
    assert older["if"] == f"matrix.cpu == '{one['cpu']}'"
    assert "python -m tests.older_cpu" in older["run"]


@cache
def texts() -> dict[Path, str]:
    """What is written in code, pages and data."""
    return {
        path: path.read_text(encoding="utf-8")
        for folder in ("fuselog", "recorders", "replay", "pipeline", "tests", "docs", "data")
        for path in (ROOT / folder).rglob("*.*")
        if path.suffix in (".py", ".pyi", ".md", ".toml", ".ipynb")
    }


def test_no_file_cites_what_is_outside_the_repository() -> None:
    cited = re.compile(r"\b(?:shared|spec|tech)/[a-z]|\bpapers/[a-z-]+\.txt")
    for path, text in texts().items():
        if path.suffix in (".py", ".md", ".toml") and path != Path(__file__):
            found = cited.search(text)
            assert not found, f"{path}: {found}"


def test_rooms_are_named_as_parts_of_fuselog() -> None:
    """In strings and pages too: under a name of its own a room would be loaded twice, in a clone."""
    alone = re.compile(r"(?:-m|(?:^|[\"';])\s*(?:from|import)) (?:pipeline|recorders|replay)\b", re.M)
    for path, text in texts().items():
        found = alone.search(text)
        assert not found, f"{path}: {found}"


def test_one_version_everywhere() -> None:
    """The package, its citation and the last release in the changelog have that of pyproject.toml."""
    stated = PYPROJECT["project"]["version"]
    assert version("fuselog") == stated
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == stated
    assert cited["license"] == PYPROJECT["project"]["license"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\d\S+)", changelog, re.MULTILINE)[0] == stated


# What starts a process, by the name that is called.
STARTS = {
    *(
        "Popen",
        "run",
        "call",
        "check_call",
        "check_output",
        "getoutput",
        "system",
        "popen",
        "Process",
        "Pool",
    ),
    *(
        "ProcessPoolExecutor",
        "LocalCluster",
        "fork",
        "forkpty",
        "posix_spawn",
        "startfile",
        "get_context",
    ),
    *("create_subprocess_exec", "create_subprocess_shell", "spawn_main", "start_module"),
}
MODULES = {"subprocess", "os", "multiprocessing", "asyncio", "concurrent", "distributed"}
IMPORTS = re.compile(
    rf"^\s*(?:import|from) (?:{'|'.join(MODULES)}|fuselog\.recorders\.processes)\b", re.MULTILINE
)


def test_processes_are_started_in_known_places() -> None:
    """Python by `start_module`, whose `-P` keeps the current folder off the path, or `safe_spawning`."""
    found = set()
    for path in PATHS:
        if not IMPORTS.search(text_of(path)):
            continue  # nothing that starts a process has a name there
        nodes = list(ast.walk(tree_of(path)))
        starting = {
            alias.asname or alias.name
            for node in nodes
            if isinstance(node, ast.ImportFrom) and node.module
            if node.module.partition(".")[0] in MODULES or node.module == "fuselog.recorders.processes"
            for alias in node.names
        }
        for node in nodes:
            called = [node.func] if isinstance(node, ast.Call) else getattr(node, "bases", [])
            for each in called:
                *of, name = ast.unparse(each).rsplit(".", 1)
                is_start = name in STARTS and (of[0] in MODULES if of else name in starting)
                if is_start or (of == ["os"] and name.startswith(("exec", "spawn"))):
                    found.add((path.as_posix(), name))
    assert found == {
        ("pipeline/deploying/certificate.py", "run"),  # GCC, and a filter that it compiled
        ("pipeline/runs/executors.py", "LocalCluster"),
        ("pipeline/runs/executors.py", "ProcessPoolExecutor"),
        ("pipeline/runs/executors.py", "get_context"),
        ("recorders/processes.py", "Popen"),
        ("replay/foreign/processes/isolation.py", "start_module"),
        ("replay/foreign/processes/orphans.py", "start_module"),
        ("replay/foreign/processes/isolation.py", "Popen"),  # a program that the user names
        ("recorders/compiling/trial.py", "start_module"),
        ("replay/timeline/viewer.py", "start_module"),
    }
    python = {path.as_posix() for path in PATHS if "sys.executable" in text_of(path)}
    assert python == {"recorders/processes.py"}


def test_environment_variables_are_read_in_one_place() -> None:
    """Or handed on to a process; the text of `native.py` is in the key of every kernel, and stays."""
    reads = {path.as_posix() for path in PATHS if re.search(r"\bos\.(environ|getenv)", text_of(path))}
    assert reads == {
        "fuselog/testing.py",
        "pipeline/output/terminal.py",
        "recorders/environment.py",
        "recorders/processes.py",
        "recorders/compiling/compile.py",
        "recorders/compiling/kernels/native.py",
        "replay/timeline/viewer.py",
    }


def test_every_promise_of_security_names_tests_that_there_are() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.*) \| (.*) \|$", text, re.MULTILINE)[1:]
    assert len(rows) >= 10
    for promise, kept in rows:
        named = re.findall(r"((?:`test_\w+`(?:, | and )?)+) in `(tests/\S+\.py)`", kept)
        assert named, promise
        for tests, path in named:
            there = (ROOT / path).read_text(encoding="utf-8")
            for test in re.findall(r"test_\w+", tests):
                assert f"def {test}(" in there, (path, test)
