"""The table of faults stays true: a fault that no longer fits its file would be reported as caught."""

import ast
from functools import cache
from pathlib import Path

import pytest

from tests.mutants.drawn import DRAWN
from tests.mutants.faults import FAULTS, Fault, faulty
from tests.mutants.fresh import FRESH
from tests.mutants.newest import NEWEST
from tests.mutants.redrawn import REDRAWN

ROOT = Path(__file__).parents[2]


@cache
def sound(path: str) -> tuple[str, str]:
    """A file's text and its syntax."""
    text = (ROOT / path).read_text(encoding="utf-8")
    return text, ast.dump(ast.parse(text))


@pytest.mark.parametrize(
    "fault",
    FAULTS + DRAWN + REDRAWN + FRESH + NEWEST,
    ids=lambda fault: f"{fault.path}:{fault.old[:40]!r}",
)
def test_a_fault_stands_in_its_file_and_is_python(fault: Fault):
    text, syntax = sound(fault.path)
    assert ast.dump(ast.parse(faulty(fault, text))) != syntax
    assert all((ROOT / path).is_file() for path in fault.tests.split())


def test_faults_are_many_and_in_all_rooms():
    for faults in (FAULTS, DRAWN, REDRAWN, FRESH, NEWEST):
        assert len(set(faults)) == len(faults) >= 60
        assert {"recorders", "replay", "pipeline"} <= {fault.path.partition("/")[0] for fault in faults}
    with pytest.raises(ValueError, match=r"README.md has 'no such text' 0 times; state it anew"):
        faulty(Fault("README.md", "no such text", "", ""), (ROOT / "README.md").read_text("utf-8"))
