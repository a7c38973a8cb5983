"""What a person reads is what was reviewed: the texts in `stored`, and how they are compared."""

from collections.abc import Mapping

import pytest

from tests.words.everything import everything
from tests.words.texts import FOLDER, differences, path_of

KEPT = sorted(path.stem for path in FOLDER.glob("*.txt"))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory, blank_figures: None) -> Mapping[str, str]:
    """The text of every command, as it is now."""
    return everything(tmp_path_factory.mktemp("words"))


@pytest.mark.paper
@pytest.mark.parametrize("command", KEPT)
def test_a_command_says_what_was_reviewed(command: str, found: Mapping[str, str]) -> None:
    if command == "explore":
        pytest.importorskip("bokeh")
    told = differences(path_of(command).read_text(encoding="utf-8"), found.get(command, ""))
    assert not told, f"{told}\nif it is meant: python -m tests.words --update"


@pytest.mark.paper
def test_all_that_is_said_was_reviewed(found: Mapping[str, str]) -> None:
    assert found.keys() == {*KEPT}, "python -m tests.words --update"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("it is 3.141 m", "it is  3.142 m"),
        ("0.2 (─── 1)", "0.3 (─ 1)"),  # either side of a border of rounding
        ("1,234.5 and 2e-07", "1,234.6 and 3e-07"),
    ],
)
def test_texts_that_say_the_same(before: str, after: str) -> None:
    assert not differences(before, after)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("it is 3.141 m", "it is 3.141 s"),
        ("it is 3.141 m", "it is 3.151 m"),
        ("it is 3.141 m", "it is -3.141 m"),
        ("5 of 6 runs", "6 of 6 runs"),
        ("robot1", "robot2"),
        ("a\nb", "b\na"),
        ("a\nb", "a"),
    ],
)
def test_texts_that_differ(before: str, after: str) -> None:
    assert differences(before, after)
