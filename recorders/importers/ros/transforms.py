"""Transforms between frames (TF): sent transforms as poses, and named pairs composed from them.

A transform is the pose of a child frame in its parent frame. A named pair is composed at the stamps of
the transform in its chain that is sent most often. The other transforms are interpolated between the two
nearest stamps, linearly and along the shortest rotation, as in tf2, and never extrapolated. Transforms
are kept only until they are no longer needed, so that memory stays bounded.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.mapping import (
    NOT_UNIT,
    SCALED,
    Quaternions,
    off_unit,
    with_unit_quaternions,
)
from fuselog.recorders.importers.ros.layouts import Messages
from fuselog.recorders.importers.ros.messages import quaternion, stamps_ns, vector
from fuselog.recorders.log import schemas
from fuselog.recorders.models.orientation import compose, conjugate, rotate

Floats = NDArray[np.float64]
Pair = tuple[str, str]

BASES = ("base_link", "base_footprint", "base")
LEAST = 1e-4  # m and rad; smaller values get no setting
FIX, UNIT = schemas.GEODETIC_FIX.full_name, schemas.INERTIAL_SAMPLE.full_name


@dataclass(frozen=True)
class Transforms:
    """Poses (n,) of a child frame in its parent frame, with the stamps of sensor and recorder.

    `rows` states from which message of the topic each pose comes.
    """

    stamp_ns: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    rows: NDArray[np.int64]
    position_m: Floats
    quaternion: Floats

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, rows: NDArray | slice) -> "Transforms":
        """Select some of the transforms."""
        return Transforms(*(each[rows] for each in vars(self).values()))


def transforms_of(
    messages: Messages,
    log_time_ns: NDArray[np.int64],
    where: str,
    quaternions: Quaternions,
    tell: Callable[[str, int], None],
) -> Iterator[tuple[Pair, Transforms]]:
    """Yield the transforms in messages, by parent and child.

    Args:
        messages: n messages.
        log_time_ns: (n,), stamps of the recorder, in ns.
        where: beginning of error messages.
        quaternions: what to do with quaternions that are not of unit length.
        tell: function called with a fact about transforms, and their number.

    Raises BadInput if a quaternion is not of unit length, and is neither scaled nor left out.
    """
    for number in range(messages.layout.counts["transforms"]):
        path = f"transforms.{number}"
        stamp_ns = stamps_ns(messages, f"{path}.header.stamp")
        parents = messages.text(f"{path}.header.frame_id")
        children = messages.text(f"{path}.child_frame_id")
        for parent, child in dict.fromkeys(zip(parents.tolist(), children.tolist(), strict=True)):
            rows = (parents == parent) & (children == child)
            pair = _frame(parent), _frame(child)
            what = f"{where}: frame {pair[1]} in {pair[0]}"
            rotation = {"quaternion": quaternion(messages, f"{path}.transform.rotation")}
            off = off_unit(what, rotation, "", rows, quaternions)
            tell(f"transforms dropped: {NOT_UNIT}", int(off.left_out.sum()))
            tell(f"transforms kept with {SCALED}", int(off.scaled.sum()))
            kept = rows & ~off.left_out
            if not kept.any():
                continue
            yield (
                pair,
                Transforms(
                    np.asarray(stamp_ns)[kept],
                    log_time_ns[kept],
                    messages.rows[kept],
                    vector(messages, f"{path}.transform.translation")[kept],
                    with_unit_quaternions({"quaternion": rotation["quaternion"][kept]}, "")[
                        "quaternion"
                    ],
                ),
            )


def _frame(name: bytes) -> str:
    return name.decode(errors="replace").lstrip("/")


def join(parts: Sequence[Transforms]) -> Transforms:
    """Join transforms in the order of their stamps."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    joined = Transforms(*map(np.concatenate, columns))
    return joined.take(np.argsort(joined.stamp_ns, kind="stable"))


class Chain:
    """A pair of frames, and the transforms that lead from one to the other.

    Args:
        pair: parent and child.
        sent: number of messages of each transform.
        static: transforms that never change.

    `left_out` counts the stamps at which a part of the chain is unknown, or that come too late. Raises
    BadInput if no transforms lead from one frame to the other.
    """

    def __init__(self, pair: Pair, sent: Mapping[Pair, int], static: Mapping[Pair, Transforms]) -> None:
        self.pair = pair
        self._static = {each: static[each].take(slice(-1, None)) for each in static}
        self._links = path_between(pair, [*sent, *static])
        moving = [link for link, _ in self._links if link not in static]
        self._leader = max(moving, key=lambda each: sent[each], default=None)
        self._held: dict[Pair, list[Transforms]] = {link: [] for link in moving}
        self._done_ns = -1
        self.left_out = 0

    def add(self, pair: Pair, found: Transforms) -> None:
        """Add transforms, if they belong to the chain."""
        if pair in self._held and len(found):
            self._held[pair].append(found)
            self.left_out += int((found.stamp_ns <= self._done_ns).sum()) if pair == self._leader else 0

    def composed(self, *, is_last: bool = False) -> Transforms | None:
        """Compose the pair's poses since the last call, up to where all links of the chain are known."""
        if self._leader is None or not all(self._held.values()):
            return None
        held = {link: join(parts) for link, parts in self._held.items()}
        known_ns = min(part.stamp_ns[-1] for part in held.values())
        if is_last:
            known_ns = max(part.stamp_ns[-1] for part in held.values())
        leader = held[self._leader]
        wanted = leader.take((leader.stamp_ns > self._done_ns) & (leader.stamp_ns <= known_ns))
        self._done_ns = max(self._done_ns, int(known_ns))
        for link, part in held.items():
            # keep the last earlier one for interpolation
            first = max(int(np.searchsorted(part.stamp_ns, known_ns, side="right")) - 1, 0)
            self._held[link] = [part.take(slice(first, None))]
        inside = np.ones(len(wanted), bool)
        for part in held.values():
            inside &= (wanted.stamp_ns >= part.stamp_ns[0]) & (wanted.stamp_ns <= part.stamp_ns[-1])
        self.left_out += int((~inside).sum())
        wanted = wanted.take(inside)
        if not len(wanted):
            return None
        return self._product(
            {link: interpolated(part, wanted.stamp_ns) for link, part in held.items()}, wanted
        )

    @property
    def static(self) -> Transforms | None:
        """Return the pair's pose if it never changes, else None."""
        if self._held:
            return None
        zero = np.zeros(1, np.int64)
        return self._product({}, Transforms(zero, zero, zero, np.zeros((1, 3)), np.zeros((1, 4))))

    def _product(self, moving: Mapping[Pair, Transforms], wanted: Transforms) -> Transforms:
        """Compose the chain's transforms in turn, at the wanted stamps."""
        position = np.zeros((len(wanted), 3))
        orientation = np.tile([1.0, 0.0, 0.0, 0.0], (len(wanted), 1))
        for link, is_forward in self._links:
            part = moving[link] if link in moving else self._static[link]
            step, turn = part.position_m, part.quaternion
            if not is_forward:
                turn = conjugate(turn)
                step = -rotate(turn, step)
            position = position + rotate(orientation, step)
            orientation = compose(orientation, turn)
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        return replace(wanted, position_m=position, quaternion=orientation)


def interpolated(given: Transforms, stamp_ns: NDArray[np.int64]) -> Transforms:
    """Interpolate transforms at other stamps, linearly and along the shortest rotation.

    Args:
        given: transforms in the order of their stamps.
        stamp_ns: (n,), stamps within the span of `given`.

    Returns:
        n transforms at these stamps; their `log_time_ns` and `rows` are meaningless.
    """
    last = len(given) - 1
    after = np.clip(np.searchsorted(given.stamp_ns, stamp_ns), 0, last)
    before = np.maximum(after - (given.stamp_ns[after] > stamp_ns), 0)
    gap_ns = np.maximum(given.stamp_ns[after] - given.stamp_ns[before], 1)
    share = ((stamp_ns - given.stamp_ns[before]) / gap_ns)[:, None]
    begin, end = given.quaternion[before], given.quaternion[after]
    cosine = (begin * end).sum(axis=1, keepdims=True)
    end, angle = np.where(cosine < 0.0, -end, end), np.arccos(np.minimum(np.abs(cosine), 1.0))
    is_small = angle < 1e-8
    sine = np.where(is_small, 1.0, np.sin(angle))
    first = np.where(is_small, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    second = np.where(is_small, share, np.sin(share * angle) / sine)
    position = given.position_m[before] * (1.0 - share) + given.position_m[after] * share
    return Transforms(stamp_ns, stamp_ns, stamp_ns, position, first * begin + second * end)


def path_between(pair: Pair, links: Sequence[Pair]) -> list[tuple[Pair, bool]]:
    """Find the links from one frame to the other, and whether each is followed from parent to child."""
    above = {child: parent for parent, child in links}
    parent, child = pair
    for frame in pair:
        if frame not in above and frame not in above.values():
            frames = sorted({each for link in links for each in link})
            raise BadInput(
                f"no transform has the frame '{frame}'; the frames are {', '.join(frames) or 'none'}"
            )
    up, down = _ancestors(parent, above), _ancestors(child, above)
    common = next((frame for frame in up if frame in down), None)
    if common is None:
        raise BadInput(
            f"no transforms lead from '{parent}' to '{child}': from '{parent}' they end at '{up[-1]}', "
            f"from '{child}' at '{down[-1]}'; record the missing transform, or name another pair"
        )
    upwards = [((above[frame], frame), False) for frame in up[: up.index(common)]]
    downwards = [((above[frame], frame), True) for frame in down[: down.index(common)]]
    return [*upwards, *reversed(downwards)]


def _ancestors(frame: str, above: Mapping[str, str]) -> list[str]:
    """List the frame, its parent, and so on to the root."""
    found = [frame]
    while (parent := above.get(found[-1])) is not None and parent not in found:
        found.append(parent)
    return found


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
            streams: the name of the messages, and the metadata, by topic.
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
        """Return a note if a frame moves relative to the body; empty if no base frame leads to it."""
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
