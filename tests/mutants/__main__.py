"""`make mutants`: do the tests notice faults? Each of a table is put into a copy of the tree, in turn.

`python -m tests.mutants WORD ...` tries the faults whose file or text holds one of the words.
"""

import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from pipeline.output.terminal import print_table
from tests.mutants.drawn import DRAWN
from tests.mutants.faults import FAULTS, Fault, faulty
from tests.mutants.fresh import FRESH
from tests.mutants.newest import NEWEST
from tests.mutants.redrawn import REDRAWN

ROOT = Path(__file__).parents[2]
FAULT_LIMIT_S = 600
WHOLE_LIMIT_S = 3600
WANTED_SHARE = 0.9
TESTS_FAILED = 1  # pytest's exit code; others say that it could not run them


def main() -> None:
    """Try the faults and print which were caught; exit code 1 where fewer than wanted were."""
    words = sys.argv[1:]
    every = FAULTS + DRAWN + REDRAWN + FRESH + NEWEST
    chosen = [each for each in every if not words or any(word in " ".join(each) for word in words)]
    cores = os.cpu_count() or 1
    deadline = time.monotonic() + WHOLE_LIMIT_S
    with TemporaryDirectory(prefix="fuselog-mutants-") as folder:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(cores):
            trees.put(_copy_of_the_tree(Path(folder) / f"tree{number}"))

        def attempt(fault: Fault) -> str:
            tree = trees.get()
            try:
                found = _attempt(fault, tree, Path(folder) / "cache", deadline)
            finally:
                trees.put(tree)
            print(f"{found:9}{fault.path}: {fault.old.strip()} -> {fault.new.strip()}", flush=True)
            return found

        with ThreadPoolExecutor(cores) as pool:
            found = list(pool.map(attempt, chosen))
    outcomes = list(dict.fromkeys(found))
    rows = Counter((_room(fault), what) for fault, what in zip(chosen, found, strict=True))
    rooms = sorted({_room(fault) for fault in chosen})
    print_table(
        ["room", *outcomes], [[room, *(rows[room, what] for what in outcomes)] for room in rooms]
    )
    share = found.count("caught") / max(len(chosen), 1)
    print(f"{found.count('caught')} of {len(chosen)} faults caught, {100 * share:.0f} %")
    sys.exit(share < WANTED_SHARE)


def _room(fault: Fault) -> str:
    """The replay's rooms are rooms of their own."""
    return "/".join(fault.path.split("/")[: 2 if fault.path.startswith("replay/") else 1])


def _copy_of_the_tree(place: Path) -> Path:
    """What git knows or would add, in a folder of its own."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, place / name)
    return place


def _attempt(fault: Fault, tree: Path, cache: Path, deadline: float) -> str:
    """What became of one fault: caught, survived, too late, or that its tests could not run."""
    limit_s = min(FAULT_LIMIT_S, deadline - time.monotonic())
    if limit_s <= 0:
        return "not tried"
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        # a file is compiled anew, however soon after its neighbour of the same size it was written
        "PYTHONDONTWRITEBYTECODE": "1",
        "FUSELOG_CACHE": str(cache),
        "FUSELOG_DATA": os.environ.get("FUSELOG_DATA", str(ROOT.parent / "shared" / "data")),
    }
    with _applied(fault, tree):
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
        try:
            done = subprocess.run(
                [*command, *fault.tests.split()],
                cwd=tree,
                env=environment,
                capture_output=True,
                timeout=limit_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return "too late"
    return {0: "survived", TESTS_FAILED: "caught"}.get(done.returncode, "broken")


@contextmanager
def _applied(fault: Fault, tree: Path) -> Iterator[None]:
    """The fault stands in the tree."""
    path = tree / fault.path
    sound = path.read_text(encoding="utf-8")
    path.write_text(faulty(fault, sound), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(sound, encoding="utf-8")


if __name__ == "__main__":
    main()
