"""A slice of `make faults`: outputs at random places, troubled files and cells, killed commands."""

import numpy as np
import pytest

from tests.faults import campaigns, files, kills, outputs

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]


@pytest.mark.parametrize(("part", "most"), [(outputs, 40), (kills, 1), (files, 5), (campaigns, 1)])
def test_a_slice_of_the_faults_holds(part, most):
    tally = part.run(60.0, np.random.default_rng(1), most)
    assert tally.notes == []
    assert tally.held == tally.tried > 0
