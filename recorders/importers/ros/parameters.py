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
    """Which topics are imported, and by which clock.

    `clock` is the one that gives the publish time: that of the message's header, or the bag's. `topics`
    are those to import; without any, all that can be. `transforms` are pairs of frames such as
    "map:base_link", whose poses are composed from TF; without any, every transform is imported as it
    was sent. `names` replaces namespaces: {"/amcl_pose" = "/robot1"} puts the streams of that topic
    under /robot1. The poses of the topic `truth` become the stream `truth`, with which estimates are
    compared. `mapping` is a TOML file for messages of your own. `distribution` has the definitions of
    messages that the bag does not define. Headers that differ by more than `clock_tolerance_s` are
    refused as those of several clocks.
    """

    clock: Clock = "header"
    topics: Names = []
    transforms: Names = []
    names: dict[str, str] = {}
    truth: str | None = None
    mapping: str | None = None
    distribution: Distribution = "ros2_humble"
    clock_tolerance_s: PositiveFloat = 60.0
