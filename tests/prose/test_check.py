"""The prose check finds ours and leaves other senses, code and numbers alone."""

import pytest

from tests.prose.check import Text, faults_of, habits, texts_of_code


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("Messages are kept out by the gate.", ["kept out"]),
        ("Of a walk, nothing is known.", ["Of"]),
        ("The filter is too sure of itself.", ["too sure"]),
        ("The rate of false alarms is 5 %.", []),
        ("An alarm is raised.", ["alarm"]),
        ("The sensor's data sheet states 0.5 deg.", []),
        ("The bearing has an error of .5 deg.", [".5"]),
        ("Run `keep out --where .5` first.", []),
        ("```\nanew\n```\nThen run it anew.", ["anew"]),
        ("What is it for?", []),
    ],
)
def test_ours_is_found_and_other_senses_are_not(words: str, found: list[str]) -> None:
    assert [each for _, each, _ in faults_of(Text(1, words), habits())] == found


def test_docstrings_comments_and_messages_are_read_and_names_are_not() -> None:
    source = (
        '"""Opens anew."""\nkept_out = f"it is kept out of {1} anew"  # lies beside it\nx = "anew"\n'
    )
    found = [
        (line, words) for text in texts_of_code(source) for line, words, _ in faults_of(text, habits())
    ]
    assert sorted(found) == [(1, "anew"), (2, "anew"), (2, "beside"), (2, "kept out")]
