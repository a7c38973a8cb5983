"""Poses composed of transforms between frames: a known chain each way, and between stamps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fuselog.recorders.importers.ros.transforms import Chain, Pair, Transforms

MS = 10**6
MAP, ODOM, MAST = ("map", "odom"), ("odom", "base"), ("map", "mast")


def transforms(
    stamps_ms: list[int], place: list[list[float]], turn_deg: list[list[float]]
) -> Transforms:
    """Poses at stamps; turns are rotation vectors. The recorder is 3 ms late."""
    stamps = np.array(stamps_ms) * MS
    turns = np.roll(Rotation.from_rotvec(np.radians(turn_deg)).as_quat(), 1, axis=1)
    return Transforms(stamps, stamps + 3 * MS, np.arange(len(stamps)), np.array(place), turns)


PARTS: dict[Pair, Transforms] = {
    MAP: transforms([0, 400], [[0.0, 0.0, 0.0], [8.0, 4.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, 40.0]]),
    ODOM: transforms(
        [100, 200, 300], [[1.0, 2.0, 0.5], [2.0, 2.0, 0.5], [3.0, 1.0, 0.5]], [[20.0, 0.0, 90.0]] * 3
    ),
    MAST: transforms([0], [[5.0, 6.0, 7.0]], [[0.0, 30.0, 60.0]]),
}


def matrix(place: list[float], turn_deg: list[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix(), place
    return pose


def of_matrices(share: float, row: int) -> dict[str, np.ndarray]:
    """Poses of the frames in the map, of 4 x 4 matrices."""
    drift = matrix([8.0 * share, 4.0 * share, 0.0], [0.0, 0.0, 40.0 * share])
    place = PARTS[ODOM].position_m[row].tolist()
    return {
        "map": np.eye(4),
        "odom": drift,
        "base": drift @ matrix(place, [20.0, 0.0, 90.0]),
        "mast": matrix([5.0, 6.0, 7.0], [0.0, 30.0, 60.0]),
    }


@pytest.mark.parametrize(
    "pair", [("map", "base"), ("base", "map"), ("mast", "base"), ("base", "mast"), ("base", "odom")]
)
def test_a_chain_is_the_product_of_its_matrices(pair: Pair) -> None:
    chain = Chain(pair, {MAP: 2, ODOM: 3}, {MAST: PARTS[MAST]})
    for link in (MAP, ODOM):
        chain.add(link, PARTS[link])
    found = chain.composed(is_last=True)
    assert found is not None
    assert found.stamp_ns.tolist() == [100 * MS, 200 * MS, 300 * MS]
    assert (found.log_time_ns - found.stamp_ns).tolist() == [3 * MS] * 3
    for row, share in enumerate([0.25, 0.5, 0.75]):
        frames = of_matrices(share, row)
        wanted = np.linalg.inv(frames[pair[0]]) @ frames[pair[1]]
        assert found.position_m[row] == pytest.approx(wanted[:3, 3])
        turn = Rotation.from_quat(np.roll(found.quaternion[row], -1)).as_matrix()
        assert turn == pytest.approx(wanted[:3, :3])
    assert chain.left_out == 0


def test_between_stamps_a_rotation_takes_the_short_way_and_never_goes_beyond() -> None:
    """From 170 to -170 degrees is 20 degrees; stamps outside those of a part are left out."""
    slow = transforms([100, 200], [[0.0] * 3] * 2, [[0.0, 0.0, 170.0], [0.0, 0.0, -170.0]])
    fast = transforms([50, 100, 125, 200, 225], [[1.0, 0.0, 0.0]] * 5, [[0.0] * 3] * 5)
    for sign in (1.0, -1.0):
        slow.quaternion[1] *= sign
        chain = Chain(("map", "base"), {MAP: 2, ODOM: 5}, {})
        chain.add(MAP, slow)
        chain.add(ODOM, fast)
        found = chain.composed(is_last=True)
        assert found is not None
        assert (found.stamp_ns // MS).tolist() == [100, 125, 200]
        yaw = np.degrees(np.arctan2(found.position_m[:, 1], found.position_m[:, 0]))
        assert yaw == pytest.approx([170.0, 175.0, -170.0])
        assert chain.left_out == 2
