"""Jets: exact derivatives of plain functions, the same in plain Python and compiled."""

import numpy as np
from numpy.testing import assert_allclose

from recorders.models.planar import range_bearing, range_bearing_jacobian
from replay.compile import compile_over_runs
from replay.inference.jets import jet, slope_of, value_of


def fill(run: int, x: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> None:
    pose = (
        jet(x[run, 0], (1.0, 0.0, 0.0)),
        jet(x[run, 1], (0.0, 1.0, 0.0)),
        jet(x[run, 2], (0.0, 0.0, 1.0)),
    )
    seen = range_bearing(pose, (3.0, 4.0))
    for row in range(2):
        values[run, row] = value_of(seen[row])
        slopes[run, row, 0] = slope_of(seen[row], 0)
        slopes[run, row, 1] = slope_of(seen[row], 1)
        slopes[run, row, 2] = slope_of(seen[row], 2)


def test_a_kernel_with_jets_gives_the_jacobian_compiled_and_plain():
    x = np.random.default_rng(1).normal(size=(5, 3))
    expected = [range_bearing_jacobian(pose, (3.0, 4.0)) for pose in x]
    for do in (
        lambda *a: [fill(run, *a) for run in range(5)],
        lambda *a: compile_over_runs(fill, allocates=False)(5, *a),
    ):
        values, slopes = np.empty((5, 2)), np.empty((5, 2, 3))
        do(x, values, slopes)
        assert_allclose(slopes, expected, rtol=1e-14, atol=1e-16)
        assert_allclose(values, np.transpose(range_bearing(x.T, (3.0, 4.0))), rtol=1e-15)
