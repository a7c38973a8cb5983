"""Every command that the help or a page shows is one that fuselog understands."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from fuselog.pipeline.command_line import fuselog
from fuselog.pipeline.command_line.help import EXAMPLES, example_of
from fuselog.pipeline.runs.inputs import shipped

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = sorted(fuselog.commands)


def understand(line: str) -> None:
    """Parse a command as the shell and click do, and run nothing; raises where it is none of ours."""
    with fuselog.make_context("fuselog", shlex.split(line, comments=True)[1:]) as context:
        name, command, rest = fuselog.resolve_command(context, context._protected_args + context.args)
        assert command is not None
        parsed = command.make_context(name, rest, parent=context)
    if name in ("run", "sweep"):
        for each in parsed.params["experiment"]:
            assert each in shipped("experiments") or not re.fullmatch(r"[a-z0-9-]+", each), each


def commands_in(page: str) -> Iterator[str]:
    """The commands of a page's blocks of code, each in one line."""
    fenced = re.findall(r"^```(?:sh|text)?\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    indented = re.findall(
        r"(?:^    .*\n)+", re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    for block in [*fenced, *indented]:
        for line in re.split(r"\n|  (?=fuselog )", block.replace("\\\n", " ")):
            if command := re.match(r" *(?:\$ )?(fuselog [a-z]+(?: .*|$))", line):
                yield command[1]


def test_what_is_understood() -> None:
    understand("fuselog run landmarks --runs 5  # five")
    for wrong in (
        "fuselog rnu landmarks",
        "fuselog run landmarks --rnus 5",
        "fuselog run landmarks --runs x",
    ):
        with pytest.raises(click.UsageError):
            understand(wrong)
    with pytest.raises(AssertionError, match="landmark"):
        understand("fuselog run landmark")


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_the_commands_of_a_page_are_understood(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    for line in commands_in(page):
        understand(line)
    for name, rest in re.findall(r"`fuselog ([a-z]+)\b([^`]*)`", page):
        options = {option for each in fuselog.commands[name].params for option in each.opts}
        assert set(re.findall(r"(?<!\S)--?[a-z][\w-]*", rest)) <= options | {"--help"}, (name, rest)


def test_readmes_and_pages_have_commands() -> None:
    assert sum(len([*commands_in(path.read_text(encoding="utf-8"))]) for path in PAGES) > 100


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_the_help_ends_with_examples(name: str) -> None:
    """Of this command, each on a line that a terminal of 80 columns does not break."""
    text = (fuselog.commands[name] if name else fuselog).help or ""
    examples = text.partition("\b\n")[2].splitlines()
    assert examples
    for line in examples:
        assert len(line) <= 78
        assert line.split()[1] == name or not name
        understand(line)


def test_the_help_has_every_command_in_one_section() -> None:
    """And begins with the ten that one starts with."""
    with click.Context(fuselog, info_name="fuselog") as context:
        _, start, *others = re.split(r"^(?=\S.*:$)", fuselog.get_help(context), flags=re.MULTILINE)[1:]
    assert start.startswith("Start here:\n")
    assert len(named := re.findall(r"^  ([a-z]+) ", start, re.MULTILINE)) == 10
    assert sorted(named + re.findall(r"^  ([a-z]+) ", "".join(others), re.MULTILINE)) == COMMANDS


def test_every_option_has_an_example_that_is_understood() -> None:
    used = set()
    for name, command in fuselog.commands.items():
        for option in (each for each in command.params if isinstance(each, click.Option)):
            if (example := example_of(name, option)) is None:
                continue
            assert (option.help or "").endswith(f" Example: {example}")
            _, value = shlex.split(example)
            with click.Context(command) as context:
                option.type.convert(value, option, context)
            long = option.opts[-1]
            used.add(own if (own := f"{name} {long}") in EXAMPLES else long)
    assert used == EXAMPLES.keys()
