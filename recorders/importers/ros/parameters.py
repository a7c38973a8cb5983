"""The parameters of an import of ROS."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, PositiveFloat

from recorders.parameters import Parameters

Clock = Literal["header", "bag"]
Distribution = Literal[
    "ros1_noetic", "ros2_dashing", "ros2_eloquent", "ros2_foxy", "ros2_galactic", "ros2_humble",
    "ros2_iron", "ros2_jazzy", "ros2_kilted", "ros2_lyrical",
]  # fmt: skip


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_as_list)]


class RosParameters(Parameters):
    """Which topics are taken, and by which clock.

    `clock` says what the publish time is: the message's header, or the bag. Without `topics` all are
    taken that can be. `transforms` names pairs of frames, "map:base_link", whose poses are composed of
    what TF has; without any, every transform that is sent is taken as it is. `names` gives what stands
    in place of the namespace in the streams of a topic: {"/amcl_pose" = "/robot1"}. The poses of the
    topic `truth` are what estimates are compared with, as the stream `truth`. `mapping` is a TOML file
    for messages of one's own. `distribution` says whose definitions hold where the bag has none.
    Headers that differ by more than `clock_tolerance_s` from one another's clock are of several clocks.
    """

    clock: Clock = "header"
    topics: Names = []
    transforms: Names = []
    names: dict[str, str] = {}
    truth: str | None = None
    mapping: str | None = None
    distribution: Distribution = "ros2_humble"
    clock_tolerance_s: PositiveFloat = 60.0
