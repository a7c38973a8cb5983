"""Keeps the numbers that tests find, as a plugin of pytest.

`numbers/FOLDER/test_NAME.txt` has what the tests of `tests/FOLDER/test_NAME.py` find. The first run of a
command is stated in full, others by what differs from it. A plain run of pytest fails a test whose
numbers moved, and reports numbers that a module no longer finds. `pytest --keep-numbers` stores what the
tests find and prints what changed.
"""

import json
import re
from collections import defaultdict
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

import pytest

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.parameters import flat
from fuselog.recorders.parsing import read_toml
from tests.goldens.numbers import PATHS, SPREAD, Name, Quantities, Statistics, brief, of_outcome

FOLDER = Path(__file__).with_name("numbers")
TESTS = Path(__file__).parents[1]
RELATIVE = 1e-5  # of the largest of a column's statistics: other CPUs round differently
ABSOLUTE = 1e-12
DIFFERING = (
    1e-3  # by so much a run differs from the first one: rounding must not decide which columns do
)
MOST_RUNS = 4  # of one command that a file has, unless it is of a part of a test
MOST_COLUMNS = 1  # of a topic or table by which a run differs from the first one
MOST_GROUPS = 6  # topics, tables and estimators by which it differs
MOST_LINES = 20  # of a message
MOST_LETTERS = 100  # of the settings in a run's name
SETTINGS = ("seed", "runs", "record", "import", "estimators", "alterations", "options")
NONE: Statistics = {"": "none"}
WORKER_LINES = "lines of kept numbers"
STATISTIC = re.compile(r'(?:([^\s"]+) )?("(?:[^"\\]|\\.)*"|[^\s",]+)(?:, |$)')

Runs = dict[str, Quantities]
Value = float | str | None


def difference(
    run: str,
    kept: Mapping[Name, Statistics],
    found: Mapping[Name, Statistics],
    relative: float = RELATIVE,
) -> list[str]:
    """Return a line for each number that moved, with its kept value, its new value and the difference.

    >>> kept, found = {Name("/truth", "x_m"): {"mean": 1.0}}, {Name("/truth", "x_m"): {"mean": -1.0}}
    >>> difference("landmarks", kept, found)
    ['landmarks | /truth | x_m mean: 1 -> -1 (difference -2)']
    """
    lines = []
    for name in dict.fromkeys([*kept, *found]):
        old, new = kept.get(name, {}), found.get(name, {})
        scale = max(
            (abs(x) for x in map(old.get, ("mean", *SPREAD)) if isinstance(x, float)), default=0.0
        )
        for key in dict.fromkeys([*old, *new]):
            before, now = old.get(key), new.get(key)
            if not _equal(before, now, scale if key in ("mean", *SPREAD) else 0.0, relative):
                where = " | ".join(filter(None, (run, name.of, f"{name.column} {key}".strip())))
                lines.append(f"{where}: {_text(before)} -> {_text(now)}{_distance(before, now)}")
    return lines


def _equal(before: Value, now: Value, scale: float, relative: float) -> bool:
    if isinstance(before, float) and isinstance(now, float) and isfinite(before):
        return abs(now - before) <= relative * max(scale, abs(before)) + ABSOLUTE
    return str(before) == str(now)


def _distance(before: Value, now: Value) -> str:
    if isinstance(before, float) and isinstance(now, float):
        return f" (difference {now - before:.3g})"
    return ""


def _text(value: Value) -> str:
    if value is None:
        return "none"
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _command(run: str) -> str:
    """Return what a run is of: the runs of one command have one base."""
    return re.split(r" --set | \(", run, maxsplit=1)[0]


def beside(base: Quantities, found: Quantities) -> Quantities:
    """Return what is kept of a run beside the first one of its command: how it differs from it.

    The first topics, tables and estimators that differ are stated, each with the number of rows and its
    last columns that differ; then how many more differ, and how many only the first run has.
    """
    base, found = brief(base), brief(found)
    moved: dict[str, dict[Name, Statistics]] = defaultdict(dict)
    for name in {**base, **found}:
        if difference("", {name: base.get(name, {})}, {name: found.get(name, {})}, DIFFERING):
            moved[name.of][name] = found.get(name, NONE)
    lost = {name.of for name in base} - {name.of for name in found}
    present = {of: columns for of, columns in moved.items() if of not in lost}
    stated: Quantities = {}
    for of, columns in [*present.items()][:MOST_GROUPS]:
        others = [name for name in columns if name.column]
        shown = others[-MOST_COLUMNS:]
        stated |= {name: each for name, each in columns.items() if name in shown or not name.column}
        stated |= _count(Name(of, "more that differ"), len(others) - len(shown))
    stated |= _count(Name("more that differ"), len(present) - MOST_GROUPS)
    return stated | _count(Name("only in the first run"), len(lost))


def _count(name: Name, number: int) -> Quantities:
    return {name: {"": float(number)}} if number > 0 else {}


def kept_of(runs: Runs, run: str, found: Quantities) -> Quantities:
    """Return what is kept of a run in a file with these runs."""
    first = next((each for each in runs if _command(each) == _command(run)), run)
    return found if run == first else beside(runs[first], found)


def written(runs: Runs) -> str:
    """Return the text of a file: below the name of each run, its quantities as `kept_of` has them."""
    return "\n".join("\n".join([f"[{run}]", *_stated(own), ""]) for run, own in runs.items())


def _stated(quantities: Quantities) -> Iterator[str]:
    """Yield a line for each quantity, those of one topic, table, chart or estimator below its name."""
    groups: dict[str, dict[str, Statistics]] = defaultdict(dict)
    for name, statistics in quantities.items():
        groups[name.of][name.column] = statistics
    for of, columns in groups.items():
        yield f"{of} = {_values(columns.pop(''))}" if "" in columns else of
        yield from (f"  {column} = {_values(statistics)}" for column, statistics in columns.items())


def _values(statistics: Statistics) -> str:
    return ", ".join(f"{key} {_text(value)}".lstrip() for key, value in statistics.items())


def read(text: str) -> Runs:
    """Read what `written` wrote."""
    runs: Runs = {}
    of = ""
    for line in filter(None, text.splitlines()):
        if line.startswith("["):
            own = runs[line[1:-1]] = {}
            continue
        name, has_values, stated = line.partition(" = ")
        is_column = name.startswith("  ")
        of = of if is_column else name
        if has_values:
            own[Name(of, name[2:] if is_column else "")] = _statistics(stated)
    return runs


def _statistics(stated: str) -> Statistics:
    pairs = STATISTIC.findall(stated)
    return {key: json.loads(text) if text.startswith('"') else float(text) for key, text in pairs}


@dataclass
class Session:
    """Holds what one run of pytest has found so far.

    Attributes:
        keeps: whether what is found shall be kept.
        found: by file, of the tests that passed.
        now: what the running test has found: file, run and quantities.
        finders: the running test, and the fixtures of modules that it is setting up, innermost last.
        wanted, passed: the tests that are to run, and those that passed, by module.
        selected: modules of which not all tests are to run.
        lines: what changed in the files, or is kept and no longer found.
    """

    keeps: bool = False
    found: dict[Path, Runs] = field(default_factory=lambda: defaultdict(dict))
    now: list[tuple[Path, str, Quantities]] = field(default_factory=list)
    finders: list[str] = field(default_factory=list)
    module: Path = FOLDER
    wanted: dict[Path, set[str]] = field(default_factory=lambda: defaultdict(set))
    passed: dict[Path, set[str]] = field(default_factory=lambda: defaultdict(set))
    selected: set[Path] = field(default_factory=set)
    lines: list[str] = field(default_factory=list)

    def is_whole(self, module: Path) -> bool:
        """Return whether all tests of a module have run and passed."""
        return module not in self.selected and self.wanted[module] == self.passed[module]

    def files(self) -> dict[Path, tuple[Runs, Runs]]:
        """Return what each file keeps and what it would: no run that a whole module no longer finds."""
        paths = {*self.found}
        for module in filter(self.is_whole, [*self.wanted]):
            of_module = FOLDER / module.relative_to(TESTS).with_suffix("")
            paths.update([of_module.with_suffix(".txt"), *of_module.glob("*.txt")])
        return {path: (kept(path), self._renewed(path)) for path in sorted(paths)}

    def _renewed(self, path: Path) -> Runs:
        found = self.found[path]
        runs = {**({} if self.is_whole(_module(path)) else kept(path)), **found}
        new = {run: kept_of(runs, run, own) if run in found else own for run, own in runs.items()}
        return {
            run: own
            for place, (run, own) in enumerate(new.items())
            if not is_beyond([*new][:place], run)
        }


def is_beyond(runs: Collection[str], run: str) -> bool:
    """Return whether enough is kept of the command that tests ran: no more runs are kept."""
    return run.endswith(")") and [_command(each) for each in runs].count(_command(run)) >= MOST_RUNS


def _module(path: Path) -> Path:
    """Return the test module that a file of kept numbers belongs to."""
    module = TESTS / path.relative_to(FOLDER).with_suffix(".py")
    return module if module.exists() else module.parent.with_suffix(".py")


@cache
def kept(path: Path) -> Runs:
    """Return the runs that a file keeps."""
    return read(path.read_text(encoding="utf-8")) if path.exists() else {}


def against(runs: Runs, run: str, found: Quantities) -> list[str]:
    """Return what moved of a run, or that nothing is kept of it."""
    if run not in runs:
        return [] if is_beyond(runs, run) else [f"{run}: nothing is kept of this run"]
    return difference(run, runs[run], kept_of(runs, run, found))


SESSION = Session()


def hold(command: str, settings: Mapping[str, Any], found: Quantities, part: str = "") -> None:
    """Compare quantities with those that are kept of this run, when the running test has ended.

    Args:
        command: the scenario, importer, experiment or command.
        settings: nested values that tell this run from others.
        found: its quantities.
        part: a file of its own for what a test finds about this part; runs there bear no test's name.
    """
    finder = SESSION.finders[-1]
    if not finder:  # a fixture of the session: which module finds it depends on which tests run
        return
    place = FOLDER / SESSION.module.relative_to(TESTS).with_suffix("") / part
    command = _plain(command)
    run = " ".join(filter(None, (command, _options(settings), "" if part else f"({finder})")))
    again = sum(each == run or each.startswith(f"{run[:-1]}, ") for _, each, _ in SESSION.now)
    if again and not part:
        run = f"{run[:-1]}, {again + 1})"
    SESSION.now.append((place.with_name(f"{place.name}.txt"), run, _cleared(found)))


def hold_outcome(
    command: str, settings: Mapping[str, Any], outcome: Outcome, *, in_full: bool = True
) -> None:
    """Hold what a command found, or without its charts and spreads; see `hold`.

    Settings of an experiment that ships with fuselog are named where they differ from those that it has.
    """
    names = [name for name in SETTINGS if not (command == "tune" and name == "estimators")]
    known = shipped("experiments")
    usual = dict(flat(read_toml(known[command]))) if command in known else {}
    given = flat({name: settings[name] for name in names if name in settings})
    changed = {key: value for key, value in given if usual.get(key) != value}
    study = settings.get("study", command)
    if study != command:
        changed = {"experiment": command, **changed}
    found = of_outcome(outcome)
    hold(study, changed, found if in_full else brief(found))


def _options(settings: Mapping[str, Any]) -> str:
    """Return settings as the command line has them, cut where they are long."""
    texts = {name: json.dumps(value, default=str) for name, value in flat(settings)}
    options = " ".join(f"--set {name}={text.strip(chr(34))}" for name, text in texts.items())
    options = PATHS.sub(lambda path: Path(path[0]).name, options)
    return _plain(options if len(options) <= MOST_LETTERS else f"{options[:MOST_LETTERS]}...")


def _plain(text: str) -> str:
    """Return a name as it may stand before an equals sign, in one line."""
    return " ".join(text.split()).replace(" = ", "=")


def _cleared(found: Quantities) -> Quantities:
    return {
        Name(_plain(name.of), _plain(name.column)): {
            _plain(key).replace(" ", "_"): value for key, value in each.items()
        }
        for name, each in found.items()
    }


def capped(lines: Sequence[str]) -> list[str]:
    """Return the first of the lines, and how many more there are."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([f"... and {more} more"] if more > 0 else [])]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --keep-numbers."""
    text = "store the numbers that tests find, and print what changed"
    parser.addoption("--keep-numbers", action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Begin with nothing found."""
    SESSION.keeps = config.getoption("--keep-numbers")


def pytest_deselected(items: Sequence[pytest.Item]) -> None:
    """Note modules of which some tests do not run."""
    SESSION.selected.update(item.path for item in items)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Note which tests run."""
    named = [each.partition("::")[0] for each in session.config.args if "::" in each]
    SESSION.selected.update((session.config.invocation_params.dir / each).resolve() for each in named)
    for item in session.items:
        SESSION.wanted[item.path].add(item.nodeid)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Tell apart what is found by which test."""
    SESSION.module, SESSION.finders = item.path, [item.name]
    SESSION.now.clear()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """Name what a fixture of a module finds after the fixture: any test may be the first to use it."""
    if fixturedef.scope == "function":
        return (yield)
    place = f"[{request.param_index}]" if hasattr(request, "param") else ""
    SESSION.finders.append("" if fixturedef.scope == "session" else fixturedef.argname + place)
    try:
        return (yield)
    finally:
        SESSION.finders.pop()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Fail a test whose numbers moved."""
    result = yield
    lines: list[str] = []
    for path, run, found in SESSION.now:
        SESSION.found[path][run] = found
        if not SESSION.keeps:
            lines += against(kept(path), run, found)
    if lines:
        told = (
            f"keep them, if this is meant: make keep-numbers TESTS={item.path.relative_to(TESTS.parent)}"
        )
        pytest.fail("\n".join([f"{len(lines)} kept numbers moved", *capped(lines), told]), pytrace=False)
    SESSION.passed[item.path].add(item.nodeid)
    return result


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Store what was found, or fail where whole modules no longer find what is kept."""
    for path, (old, new) in SESSION.files().items():
        if not SESSION.keeps:
            lost = [run for run in old if run not in new]
            SESSION.lines += [f"{run}: is kept, but no test finds it" for run in lost]
            continue
        SESSION.lines += changes(old, new)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(written(new), encoding="utf-8", newline="\n")
        if not new:
            path.unlink()
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput[WORKER_LINES] = SESSION.lines
    if SESSION.lines and not SESSION.keeps and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take over what a process of pytest-xdist found: it had whole modules (`--dist loadfile`)."""
    SESSION.lines += getattr(node, "workeroutput", {}).get(WORKER_LINES, [])


def changes(old: Runs, new: Runs) -> list[str]:
    """Return what new runs change in those that are kept: added and removed runs, numbers that moved."""
    lines: list[str] = []
    for run in {**old, **new}:
        if run not in old:
            lines.append(f"{run}: added, {sum(map(len, new[run].values()))} numbers")
        elif run not in new:
            lines.append(f"{run}: removed")
        elif new[run] is not old[run]:
            lines += capped(difference(run, old[run], new[run]))
    return lines


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what changed in the kept numbers, or which of them no test finds."""
    if SESSION.lines:
        terminalreporter.section("kept numbers")
        for line in SESSION.lines:
            terminalreporter.write_line(line)
        if not SESSION.keeps:
            terminalreporter.write_line("remove them: make keep-numbers")
