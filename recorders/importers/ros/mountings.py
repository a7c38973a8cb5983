"""Notes on the mounting of sensors from a bag's transforms, with the settings that use it."""

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.transforms import Chain, Floats, Pair, Transforms, path_between
from fuselog.recorders.log import schemas

BASES = ("base_link", "base_footprint", "base")
LEAST = 1e-4  # m and rad; smaller values get no setting
FIX, UNIT = schemas.GEODETIC_FIX.full_name, schemas.INERTIAL_SAMPLE.full_name


class Mountings:
    """The transforms that never change, whether sent once or repeatedly."""

    def __init__(self) -> None:
        self._fixed: dict[Pair, Transforms] = {}
        self._moving: set[Pair] = set()

    def add(self, pair: Pair, found: Transforms) -> None:
        """Add transforms of a pair of frames."""
        if not len(found) or pair in self._moving:
            return
        first = self._fixed.setdefault(pair, found.take(slice(0, 1)))
        same = np.abs(found.position_m - first.position_m).max() < LEAST
        if not (same and np.abs(found.quaternion - first.quaternion).max() < LEAST):
            self._moving.add(pair)
            del self._fixed[pair]

    def notes(self, streams: Mapping[str, tuple[str, Mapping[str, str]]]) -> Iterator[tuple[str, str]]:
        """Yield notes on fixes and inertial samples whose frames are not the body's, by subject.

        Args:
            streams: names of messages and metadata, by topic.
        """
        odometry = schemas.ODOMETRY.full_name
        bodies = [each.get("child_frame_id") for name, each in streams.values() if name == odometry]
        bases = [base.lstrip("/") for base in (*filter(None, bodies), *BASES)]
        units = [self._pose(bases, stated) for name, stated in streams.values() if name == UNIT]
        unit = next(filter(None, units), None)
        for topic, (name, stated) in streams.items():
            pose = self._pose(bases, stated) if name in (FIX, UNIT) else None
            if pose is None:
                if name in (FIX, UNIT) and (note := self._note_of_moving(bases, stated)):
                    yield f"{topic}, mounting", note
                continue
            base, place_m, turn = pose
            frame = f"its frame {stated['frame_id']}"
            if name == FIX:
                robot = _settings(["lever_x_m", "lever_y_m"], place_m)
                from_unit = place_m - (unit[1] if unit else 0.0)
                inertial = _settings([f"lever_{axis}_m" for axis in "xyz"], from_unit)
                uses = [f"{robot} for the model robot"] * bool(robot)
                uses += [f"{inertial} for the model inertial"] * bool(inertial)
                where = "{:.4g}, {:.4g}, {:.4g} m".format(*place_m)
                what = f"{frame} is {where} forward, left and up of {base}"
            else:
                angles = turn.as_euler("xyz")
                turns = ("roll", "pitch", "yaw")
                mounting = _settings([f"mounting_{each}_rad" for each in turns], angles)
                uses = [f"{mounting} for the model inertial"] * bool(mounting)
                where = "{:.4g}, {:.4g}, {:.4g} deg".format(*np.degrees(angles))
                what = f"{frame} is rotated by roll, pitch, yaw {where} in {base}"
            if uses:
                yield f"{topic}, mounting", f"{what}; used by {', or '.join(uses)}"

    def _note_of_moving(self, bases: list[str], stated: Mapping[str, str]) -> str:
        """Write that a frame moves on the body; empty if it is not connected to a base frame."""
        frame = stated.get("frame_id", "").lstrip("/")
        for base in bases:
            try:
                links = path_between((base, frame), [*self._fixed, *self._moving])
            except BadInput:  # no transforms lead there
                continue
            if links and all(is_forward for _, is_forward in links):
                return (
                    f"its frame {frame} moves in {base}, but lever arms and mountings are constant: its "
                    f"messages are treated as those of {base}; --set "
                    f"'transforms=[\"{base}:{frame}\"]' imports the motion"
                )
        return ""

    def _pose(self, bases: list[str], stated: Mapping[str, str]) -> tuple[str, Floats, Rotation] | None:
        """Find the pose of a stream's frame relative to the first base frame to which it is fixed."""
        frame = stated.get("frame_id", "").lstrip("/")
        for base in bases:
            try:
                found = Chain((base, frame), {}, self._fixed).static
            except BadInput:  # no fixed transforms lead there
                continue
            if found is not None:
                turn = Rotation.from_quat(found.quaternion[0], scalar_first=True)
                return base, found.position_m[0], turn
        return None


def _settings(names: list[str], values: Floats) -> str:
    given = zip(names, values.tolist(), strict=False)
    return " ".join(f"--set {name}={value:.6g}" for name, value in given if abs(value) > LEAST)
