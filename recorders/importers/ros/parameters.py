"""Defines the parameters of an import of ROS."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, PositiveFloat

from fuselog.recorders.importers.mapping import Place, Quaternions
from fuselog.recorders.parameters import Parameters

Clock = Literal["header", "bag"]
Distribution = Literal[
    "ros1_noetic", "ros2_dashing", "ros2_eloquent", "ros2_foxy", "ros2_galactic", "ros2_humble",
    "ros2_iron", "ros2_jazzy", "ros2_kilted", "ros2_lyrical",
]  # fmt: skip


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_as_list)]


class RosParameters(Parameters):
    """States which topics are imported, and by which clock.

    Attributes:
        clock: what gives the publish time: the message's header, or the bag.
        topics: the topics to import; without any, all that can be.
        transforms: pairs of frames such as "map:base_link", whose poses are composed from TF; without
            any, every transform is imported as it was sent.
        names: replaces namespaces: {"/amcl_pose" = "/robot1"} puts the streams of that topic under
            /robot1.
        truth: topic whose poses become the stream `truth`, with which estimates are compared.
        estimates: topics whose poses are those of another filter, such as /odometry/filtered: they
            become estimates, which `fuselog evaluate` judges, and are no measurements.
        mapping: a TOML file for messages of your own.
        distribution: which one's definitions hold for messages that the bag does not define.
        clock_tolerance_s: headers that differ by more are refused as those of several clocks.
        origin: latitude and longitude (deg) and perhaps height (m) of the origin of the plane that poses
            and positions are in, whatever their frames are called; not that of transforms, nor of what
            an odometry adds up to.
        quaternions: what becomes of messages whose quaternions are not of unit length: "refuse" stops
            the import, "normalise" scales them, "skip" leaves such messages out.
    """

    clock: Clock = "header"
    topics: Names = []
    transforms: Names = []
    names: dict[str, str] = {}
    truth: str | None = None
    estimates: Names = []
    mapping: str | None = None
    distribution: Distribution = "ros2_humble"
    clock_tolerance_s: PositiveFloat = 60.0
    origin: Place | None = None
    quaternions: Quaternions = "refuse"
