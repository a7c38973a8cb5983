"""The parameters of an import from ROS."""

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
    """The topics to import, and the clock to use.

    Attributes:
        clock: source of the publish time: the message's header, or the bag.
        topics: topics to import; by default all that can be imported.
        transforms: pairs of frames such as "map:base_link", whose poses are composed from TF; by default
            every transform is imported as it was sent.
        names: replaces namespaces: {"/amcl_pose" = "/robot1"} puts the streams of that topic under
            /robot1.
        truth: topic whose poses become the stream `truth`, with which estimates are compared.
        estimates: topics with the poses of another filter, such as /odometry/filtered: they become
            estimates, which `fuselog evaluate` judges, and not measurements.
        mapping: a TOML file for messages of your own.
        distribution: distribution whose definitions are used for messages that the bag does not define.
        clock_tolerance_s: largest difference between topics in the offset of the header's clock from the
            bag's; above it, their clocks are unrelated, and the import stops.
        origin: latitude and longitude (deg) and optionally height (m) of the origin of the local tangent
            plane of poses and positions, whatever their frames are called; it does not apply to
            transforms, nor to poses that odometry integrates.
        quaternions: what to do with messages whose quaternions are not of unit length: "refuse" stops
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
