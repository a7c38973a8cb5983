"""Finds habits and terms of `words.toml` in the prose of pages, docstrings, comments and messages."""

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.house.sources import PATHS, ROOT

C_CODE = "pipeline/deploying/c_source/*.[ch]"  # its comments and messages
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**/*.md", C_CODE)
CODE = re.compile(
    r"```.*?```|``[^`]+``|`[^`\n]+`|<!--.*?-->|>>> [^\n]*|\]\([^)]*\)|\$[^$\n]+\$|https?://\S+",
    re.DOTALL,
)
STRING_OR_COMMENT = re.compile(r"""("{3}|'{3}|["'])(?:\\.|[^\\])*?\1|#[^\n]*""", re.DOTALL)
LEAST_BLANKS = 2  # of a string that counts as prose
LETTERS = re.compile("[a-z]{2}")


class Habit(NamedTuple):
    """A word or a way of writing to avoid: its pattern, what to write, and other senses."""

    pattern: re.Pattern[str]
    write: str
    other_sense: re.Pattern[str] | None


class Text(NamedTuple):
    """A piece of prose with the line of its file on which it begins."""

    line: int
    words: str


def habits() -> list[Habit]:
    """Read the list of habits and terms."""
    with (Path(__file__).parent / "words.toml").open("rb") as file:
        listed = tomllib.load(file)
    return [
        Habit(
            re.compile(each["pattern"], re.ASCII | re.IGNORECASE | re.MULTILINE),
            each["write"],
            re.compile(each["except"], re.IGNORECASE) if "except" in each else None,
        )
        for each in [*listed["term"], *listed["habit"]]
    ]


def texts_of_code(source: str) -> Iterator[Text]:
    """Yield the docstrings and other strings of several words, and the comments of a Python file."""
    waiting: list[ast.AST] = [ast.parse(source)]
    while waiting:
        node = waiting.pop()
        inner = list(ast.iter_child_nodes(node))
        words = ""
        if isinstance(node, ast.JoinedStr):
            words = "".join(each.value if isinstance(each, ast.Constant) else "{}" for each in inner)
            inner = [each for each in inner if not isinstance(each, ast.Constant)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            words = node.value
        if (words.count(" ") >= LEAST_BLANKS or words.endswith(".")) and LETTERS.search(words):
            yield Text(node.lineno, words)
        waiting += inner
    for found in STRING_OR_COMMENT.finditer(source):
        if found[0].startswith("#"):
            yield Text(source.count("\n", 0, found.start()) + 1, found[0].lstrip("# "))


def texts_of(path: Path) -> Iterable[Text]:
    """Return the prose of a file."""
    source = path.read_text(encoding="utf-8")
    return texts_of_code(source) if path.suffix == ".py" else [Text(1, source)]


def faults_of(text: Text, listed: Iterable[Habit]) -> Iterator[tuple[int, str, Habit]]:
    """Yield the line, the words and the habit of each place to rewrite. Code in the text is left out."""
    words = CODE.sub(lambda code: re.sub(r"[^\n]", "\0", code[0]), text.words)
    for habit in listed:
        for found in habit.pattern.finditer(words):
            around = words[max(found.start() - 40, 0) : found.end() + 40]
            if habit.other_sense is None or not habit.other_sense.search(around):
                yield text.line + words.count("\n", 0, found.start()), found[0].strip(), habit


def paths(names: Sequence[str]) -> Iterator[Path]:
    """Yield the given files and those below the given folders, or the product's code and all pages."""
    for each in (ROOT / name for name in names):
        yield from sorted(each.rglob("*.py")) if each.is_dir() else [each]
    if not names:
        yield from (ROOT / path for path in PATHS)
        for pattern in PAGES:
            yield from sorted(ROOT.glob(pattern))


def main(names: list[str]) -> int:
    """Print each place to rewrite; return 1 if there is one."""
    listed, counts = habits(), Counter[str]()
    for path in paths(names):
        for text in texts_of(path):
            for line, words, habit in faults_of(text, listed):
                counts[habit.pattern.pattern] += 1
                print(f'{path.relative_to(ROOT)}:{line}: "{words}": write {habit.write}')
    for pattern, count in counts.most_common():
        print(f"{count:6d} {pattern}")
    return int(bool(counts))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
