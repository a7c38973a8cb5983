"""What `run` prints of claims, and of metrics that have many cases."""

from collections.abc import Iterator

from pipeline.output.claims import Claim
from pipeline.output.terminal import print_claims, print_metrics, print_pose_errors
from tests.words.made.printing import printed


def claims() -> Iterator[str]:
    """Claims: decided, and of another recording."""
    made = [
        Claim("A is 1", "1 m", "1 m", "confirmed"),
        Claim("B is 2", "2 m", "3 m", "refuted", "by 1 m"),
    ]
    elsewhere = Claim("C is 3", "3 m", "4 m", "no verdict", "claimed of first, not of these data")
    yield from printed(print_claims, made)
    yield from printed(print_claims, [*made, elsewhere])


def cases() -> Iterator[str]:
    """Six cases, each with its table, and seven, as one of medians."""
    for count in (6, 7):
        metrics = {f"ekf.rmse_m.case{number}": 0.1 * number for number in range(1, count + 1)}
        metrics["ukf.rmse_m.case1"] = 0.7
        yield from printed(print_metrics, metrics, {"ekf.rmse_m.case1": (0.05, 0.2)})


def poses() -> Iterator[str]:
    """Errors of a trajectory."""
    metrics = {
        "ape_translation_rmse_m": 1.0,
        "ape_translation_max_m": 2.0,
        "rpe_rotation_rmse_deg": 3.0,
        "rpe_rotation_max_deg": 4.0,
        "poses": 7.0,
        "pairs_of_poses": 6.0,
    }
    yield from printed(print_pose_errors, metrics)


CLAIMED = (claims, cases, poses)
