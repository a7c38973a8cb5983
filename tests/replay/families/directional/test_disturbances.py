"""A field that differs from that of the place is told with its span and size, and nothing else is."""

import numpy as np

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.orientation import conjugate, rotate
from fuselog.replay.families.directional.disturbances import COMPONENTS, disturbances

TIME_S = np.arange(0.0, 30.0, 0.1)
FIELD_UT = np.array([0.0, 18.0, -40.0])


def test_spans_are_where_the_field_differs():
    """The body turns; a magnet is near twice, and a weak one never tells; two seconds lack estimates."""
    half = 0.2 * TIME_S[:, None]
    orientation = np.hstack([np.cos(half), np.sin(half) * [0.6, 0.0, 0.8]])
    field = rotate(conjugate(orientation), FIELD_UT)
    field[(TIME_S >= 5.0) & (TIME_S < 9.0)] += [20.0, 0.0, 0.0]
    field[(TIME_S >= 12.0) & (TIME_S < 14.0)] += [5.0, 0.0, 0.0]
    field[(TIME_S >= 20.0) & (TIME_S < 21.0)] += [0.0, 30.0, 0.0]
    field[0] = np.nan
    time_ns = np.rint(TIME_S * 1e9).astype(np.int64)
    samples = make_stream(
        "/inertial",
        schemas.INERTIAL_SAMPLE,
        time_ns,
        specific_force_mps2=np.zeros((len(field), 3)),
        turn_rate_radps=np.zeros((len(field), 3)),
        magnetic_field_ut=field,
    )
    mean = np.hstack([np.ones((len(field), 1)), orientation, np.tile(FIELD_UT[1:], (len(field), 1))])
    estimates = make_stream(
        "/state",
        schemas.GAUSSIAN_ESTIMATE,
        time_ns,
        metadata={"components": ",".join(["x_m", *COMPONENTS])},
        mean=mean,
        covariance=np.zeros((len(field), 36)),
    )
    estimates = estimates.take((TIME_S < 23.0) | (TIME_S >= 25.0))
    found = disturbances(samples, estimates)
    np.testing.assert_array_equal(found.begin_ns, [5 * 10**9, 20 * 10**9])
    np.testing.assert_array_equal(found.end_ns, [9 * 10**9, 21 * 10**9])
    np.testing.assert_allclose(found.largest_ut, [20.0, 30.0])
    assert len(disturbances(samples, estimates, 50.0).begin_ns) == 0
