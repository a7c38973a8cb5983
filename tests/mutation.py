"""Tests the tests: cosmic-ray mutates a copy of the tree, in build/mutants, and lists what survives.

`make mutants` mutates the lines that differ from main, `make mutants ON=replay/inference` a folder
or a file. The tests are those of the same folders, or `TESTS=...`. At most `COUNT=100` mutants are
drawn, by a seed.

mutmut is faster, but puts the mutant into a function of another name, which compiled kernels do not
call: of seven mutants in `replay/inference/linear_algebra` that survived there, the same tests kill
five.
"""

import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import tomli_w
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkResult

ROOT = Path(__file__).parents[1]
BUILD = ROOT / "build"
TREE, CONFIG, SESSION = BUILD / "mutants", BUILD / "mutants.toml", BUILD / "mutants.sqlite"
# Nobody writes these by mistake; `|` is mostly part of a type.
UNLIKELY = [".*_(FloorDiv|Mod|Pow|RShift|LShift|BitOr|BitAnd|BitXor|UAdd|Is|IsNot)$", ".*_BitOr_.*"]


def main() -> None:
    """Mutate, test, and print each mutant that survives."""
    on, tests = (os.environ.get(name, "").split() for name in ("ON", "TESTS"))
    rooms = [f"{room}/*.py" for room in ("fuselog", "pipeline", "recorders", "replay")]
    paths = on or _lines("git", "diff", "--name-only", "--diff-filter=d", "main", "--", *rooms)
    if not paths:
        sys.exit("no code differs from main; name a folder or a file: make mutants ON=replay/inference")
    tests = tests or sorted({_tests_of(path) for path in paths})
    shutil.rmtree(TREE, ignore_errors=True)
    for name in _lines("git", "ls-files", "--cached", "--others", "--exclude-standard"):
        if (ROOT / name).is_file():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, TREE / name)
    settings = {
        "module-path": paths,
        "timeout": 600.0,
        "test-command": f'"{sys.executable}" -m pytest -x -p no:cacheprovider {" ".join(tests)}',
        "distributor": {"name": "local"},
        "filters": {
            "git-filter": {"branch": "main"},
            "operators-filter": {"exclude-operators": UNLIKELY},
        },
    }
    CONFIG.write_text(tomli_w.dumps({"cosmic-ray": settings}), encoding="utf-8")
    SESSION.unlink(missing_ok=True)
    _run("cosmic-ray", "init", CONFIG, SESSION)
    _run("cr-filter-operators", SESSION, CONFIG)
    if not on:
        _run("cr-filter-git", SESSION, "--config", CONFIG, folder=ROOT)
    with use_db(SESSION, WorkDB.Mode.open) as work:
        found = sorted(work.pending_work_items, key=lambda item: repr(item.mutations))
        count = min(len(found), int(os.environ.get("COUNT", "100")))
        drawn = {item.job_id for item in random.Random(1).sample(found, count)}
        for item in found:
            if item.job_id not in drawn:
                work.set_result(item.job_id, WorkResult(WorkerOutcome.SKIPPED))
    print(f"{count} of {len(found)} mutants of {' '.join(paths)}, by {' '.join(tests)}", flush=True)
    _run("cosmic-ray", "baseline", CONFIG)
    _run("cosmic-ray", "exec", CONFIG, SESSION)
    with use_db(SESSION, WorkDB.Mode.open) as work:
        survivors = [each.diff for job, each in work.results if job in drawn and not each.is_killed]
    print(*survivors, f"{len(survivors)} of {count} mutants survived", sep="\n")


def _tests_of(path: str) -> str:
    """Return the folder of tests that mirrors a folder or a file's folder, or the nearest above it."""
    mirrored = Path("tests") / path
    return next(each for each in (mirrored, *mirrored.parents) if (ROOT / each).is_dir()).as_posix()


def _lines(*command: str) -> list[str]:
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()


def _run(name: str, *arguments: object, folder: Path = TREE) -> None:
    """Run a command of cosmic-ray on the copy, whose kernels have a cache of their own."""
    own = {"PYTHONPATH": str(TREE), "FUSELOG_CACHE": str(BUILD / "mutants-cache")}
    environment = {"FUSELOG_DATA": str(ROOT.parent / "shared" / "data"), **os.environ, **own}
    command = [str(Path(sys.executable).with_name(name)), *map(str, arguments)]
    if subprocess.run(command, cwd=folder, env=environment, check=False).returncode:
        sys.exit(f"{name} failed; if it was the baseline, the tests fail without any mutant")


if __name__ == "__main__":
    main()
