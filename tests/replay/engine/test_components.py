"""Components by name: any order, covariances with them, and what is refused."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.vectors.components import match_components, match_tangent
from fuselog.replay.engine.vectors.tangent import Kind

PLANE: dict[str, Kind] = {"x_m": "linear", "vx_mps": "linear", "y_m": "linear", "vy_mps": "linear"}
BODY: dict[str, Kind] = {
    **dict.fromkeys(("q_w", "q_x", "q_y", "q_z"), "quaternion"),
    "height_m": "linear",
}


def test_components_are_found_by_name_in_any_order() -> None:
    stated = {"components": "x_m,y_m,z_m,vy_mps,vx_mps"}
    assert match_components(stated, PLANE, "/prior") == [0, 4, 1, 3]
    assert match_tangent(stated, PLANE, "/prior") == [0, 4, 1, 3]


def test_a_covariance_keeps_a_quaternions_three_rows_together() -> None:
    """Stated with w last; the errors are about x, y, z all the same."""
    stated = {
        "components": "heading_rad,height_m,q_x,q_y,q_z,q_w",
        "kinds": "angle,linear,quaternion,quaternion,quaternion,quaternion",
    }
    assert match_components(stated, BODY, "/prior") == [5, 2, 3, 4, 1]
    rows = match_tangent(stated, BODY, "/prior")
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0])
    assert np.diag(covariance[np.ix_(rows, rows)]).tolist() == [3.0, 4.0, 5.0, 2.0]


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({}, "no component x_m; it states no components"),
        ({"components": "x_m,y_m,vx_mps"}, "no component vy_mps; it states x_m, y_m, vx_mps"),
        (
            {"components": "x_m,y_m,vx_mps,vy_mps", "kinds": "linear,angle,linear,linear"},
            "y_m has the kind angle; the kind must be linear",
        ),
        ({"components": "x_m,y_m,x_m"}, "a unique name"),
        ({"components": "x_m,y_m", "kinds": "linear"}, "with kinds 'linear'"),
        ({"components": "x_m", "kinds": "straight"}, "with kinds 'straight'"),
        ({"components": "a,b,c", "kinds": "axis,linear,axis"}, "an axis needs two adjacent components"),
    ],
)
def test_what_is_missing_or_stated_badly_is_refused(stated: dict[str, str], words: str) -> None:
    with pytest.raises(BadInput, match=f"topic /prior: .*{words}"):
        match_components(stated, PLANE, "topic /prior")
