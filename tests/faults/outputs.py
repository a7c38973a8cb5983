"""Commands with outputs at random places: inputs, links, results, the user's files, names of all kinds.

A ledger says who wrote what. What a command changes must be its own output, and before that nothing or
the output of the same command; a command that ends with 2 changes nothing.
"""

import contextlib
import hashlib
import io
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from fuselog.pipeline.command_line import main
from tests.faults import Tally

AIS = (
    "Time,MMSI,Latitude_degrees,Longitude_degrees,COG_degrees,SOG_knots\n"
    "2016-01-12 13:02:11.218,235070762,50.77,-1.09,90,10\n"
)
EXPERIMENT = """
title = "Dead reckoning"
record.scenario = "landmarks"
record.parameters = { duration_s = 1.0, robots = 1 }
estimators.dead-reckoning = {}
"""
# What each writes, by the kind of file that the ledger notes; ANY is any name, OUT one that it writes.
COMMANDS = {
    "record landmarks --set duration_s=1 -o OUT.mcap": "recorded",
    "record --again ANY -o OUT.mcap": "recorded",
    "import ais ANY -o OUT.mcap": "imported",
    "replay ANY -e dead-reckoning -o OUT.mcap": "estimates",
    "replay ANY -e dead-reckoning -o OUT": "estimates",
    "replay ANY -e dead-reckoning -o OUT.mcap --save OUT.rrd": "estimates timeline",
    "evaluate ANY --out OUT": "result",
    "view ANY --save OUT.rrd": "timeline",
    "run dead.toml --runs 1 --out OUT": "result",
    "run ais --data ANY --out OUT": "result",
    "report ANY -o OUT.html": "page",
    "cut ANY --end 0.5 -o OUT.mcap": "cut",
    "relabel ANY --component x_m=a -o OUT.mcap": "relabelled",
    "merge ANY ANY -o OUT.mcap": "merged",
    "run dead.toml --runs 1 --settings ANY --out OUT": "result",
    "sweep dead.toml --over duration_s=1,2 --runs 1 --out OUT": "result",
    "compare ANY ANY --out OUT --save OUT.rrd": "result timeline",
    "check ANY --update -e dead-reckoning --against OUT.golden.xz": "golden",
    "export ANY --to csv -o OUT": "tables",
}
NAMES = (
    *("a.mcap", "b.mcap", "c.mcap", "a.rrd", "b.rrd", "a.html", "r", "s", "data", "data/ais.csv"),
    *("user.mcap", "user.rrd", "user.html", "user", "link.mcap", "link", "hard.mcap", "dead.toml"),
    *(
        "r/estimates/run-0000.mcap",
        "r/logs/run-0000.mcap",
        "r/timeline.rrd",
        "r/result.json",
        "r/tables",
    ),
    *(
        ".",
        "..",
        "data/../a.mcap",
        "./r",
        "r/../s",
        "new/a.mcap",
        "none/../a.mcap",
        "none/../r",
        "none/../user.rrd",
        "none/../link",
        "a.mcap.part",
        "r.old",
        ".a.mcap.x.part",
    ),
)
FLAGS = ("-o", "--out", "--save", "--against")
LIKELY = {"mcap": "abc", "rrd": "ab", "html": "a", "golden.xz": "a", "": "rs"}


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Run random commands one after the other, for so long or so many."""
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as name, contextlib.chdir(name):
        Path("work").mkdir()
        with contextlib.chdir("work"):
            owners = _prepare()
            while time.monotonic() < end and tried != most:
                command, kinds = _command(rng)
                _meddle(rng, owners)
                before = _state()
                code, said = _run(command)
                wrong = _complaint(command, kinds.split(), code, said, before, owners)
                notes += [f"{' '.join(command)}: {wrong}"] if wrong else []
                tried += 1
    return Tally(tried, tried - len(notes), notes)


def _prepare() -> dict[str, str]:
    """The user's files; returns who owns what."""
    Path("data").mkdir()
    Path("data/ais.csv").write_text(AIS)
    Path("dead.toml").write_text(EXPERIMENT)
    Path("user").mkdir()
    for name in ("user/thesis.tex", "user/result.json", "user.rrd", "user.html", "a.mcap.part", "r.old"):
        Path(name).write_text("{}")
    _run(["record", "landmarks", "--set", "duration_s=1", "-o", "c.mcap"])
    raw = Path("c.mcap").read_bytes()
    Path("user.mcap").write_bytes(raw.replace(b"fuselog", b"another", 1))
    os.link("user.mcap", "hard.mcap")
    Path("link.mcap").symlink_to("user.mcap")
    Path("link").symlink_to("user")
    return {name: "recorded" if name == "c.mcap" else "user" for name in _state()}


def _command(rng: np.random.Generator) -> tuple[list[str], str]:
    """A command with names, mostly of a fitting suffix, and the kinds that it writes."""
    template = str(rng.choice(list(COMMANDS)))
    words = []
    for word in template.split():
        if word.startswith("OUT"):
            suffix = word.removeprefix("OUT")
            likely = f"{rng.choice(list(LIKELY[suffix.lstrip('.')]))}{suffix}"
            words.append(likely if rng.random() < 0.6 else str(rng.choice(NAMES)))
        else:
            words.append(str(rng.choice(NAMES)) if word == "ANY" else word)
    return words, COMMANDS[template]


def _meddle(rng: np.random.Generator, owners: dict[str, str]) -> None:
    """Now and then the user adds a note somewhere, edits a file, or clears a result away."""
    results = sorted({Path(name).parts[0] for name, owner in owners.items() if owner == "result"})
    files = [name for name in owners if Path(name).is_file() and not Path(name).is_symlink()]
    dice = rng.random()
    if dice < 0.05 and results:
        note = Path(str(rng.choice(results)), "notes.txt")
        note.write_text("mine")
        owners[str(note)] = "user"
    elif dice < 0.08 and files:
        edited = Path(str(rng.choice(files)))
        if edited.suffix in (".csv", ".html", ".json", ".svg"):
            edited.write_bytes(edited.read_bytes() + b" ")
            owners[str(edited)] = "user"
    elif dice < 0.2 and results:
        place = Path(str(rng.choice(results)))
        for path in sorted(place.rglob("*"), reverse=True):
            path.unlink() if path.is_symlink() or path.is_file() else path.rmdir()
        place.rmdir()
        for name in [each for each in owners if place in Path(each).parents or each == str(place)]:
            del owners[name]


def _run(command: list[str]) -> tuple[int, str]:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            return main(command), said.getvalue()
        except Exception as error:
            return 1, repr(error)


def _state() -> dict[str, str]:
    """All there is, the folder above included: links by their targets, files by their bytes."""
    here = Path()
    state = {f"../{path.name}": "" for path in here.resolve().parent.iterdir()}
    for path in here.rglob("*"):
        if path.is_symlink():
            state[str(path)] = str(path.readlink())
        else:
            state[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
    return state


def _complaint(
    command: list[str],
    kinds: list[str],
    code: int,
    said: str,
    before: dict[str, str],
    owners: dict[str, str],
) -> str | None:
    """What a command did that it must not; the ledger notes what it did."""
    after = _state()
    changed = [name for name in before | after if before.get(name) != after.get(name)]
    if code not in (0, 2):
        return f"ended with {code}: {said[-200:]}"
    if code == 2:
        return f"ended with 2 and changed {changed}" if changed else None
    places = [
        Path(os.path.normpath(command[index + 1])) for index, word in enumerate(command) if word in FLAGS
    ]
    if "estimates" in kinds:  # a link to a folder names that folder, and a new file of it may be written
        linked = {place.resolve() for place in places if place.is_symlink() and place.is_dir()}
        changed = [
            name for name in changed if name in before or Path(name).resolve().parent not in linked
        ]
    for name in changed:
        if not any(Path(name) == place or place in Path(name).parents for place in places):
            if name in before or after[name]:  # a folder that was made on the way is none of these
                return f"changed {name}, which is no output"
        elif before.get(name) and owners.get(name) not in kinds:
            return f"changed {name}, which is of {owners.get(name)}"
    for name in changed:
        owners.pop(name, None)
        if name in after:
            suffix = Path(name).suffix
            owners[name] = "timeline" if "timeline" in kinds and suffix == ".rrd" else kinds[0]
    return None
