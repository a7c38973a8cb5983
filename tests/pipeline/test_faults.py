"""A slice of `make faults`: outputs, troubled files and cells, killed commands, mutants of formats."""

import importlib
import inspect
import subprocess
import sys

import numpy as np
import pytest

from tests.faults import campaigns, files, kills, outputs
from tests.faults.__main__ import PARTS

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]


@pytest.mark.parametrize(("part", "most"), [(outputs, 40), (kills, 1), (files, 5), (campaigns, 1)])
def test_a_slice_of_the_faults_holds(part, most):
    tally = part.run(60.0, np.random.default_rng(1), most)
    assert tally.notes == []
    assert tally.held == tally.tried > 0


@pytest.mark.parametrize("part", PARTS)
def test_every_part_takes_what_make_faults_gives_it(part: str) -> None:
    run = importlib.import_module(f"tests.faults.{part}").run
    inspect.signature(run).bind(50.0, np.random.default_rng(1), None)


def test_mutants_of_formats_are_read_or_refused_in_a_sentence() -> None:
    """In a process of its own, which has no threads when it forks.

    By this seed of half of the formats: logs, estimates, bags of both kinds, ULog, HDF5, CSV, Parquet.
    """
    command = [sys.executable, "-m", "tests.faults", "formats", "--most", "12", "--seed", "517"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "seed 517" in ended.stdout
