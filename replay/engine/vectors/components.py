"""Matching of a vector's components by the names that its channel states, in any order."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import cast

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.orientation import conjugate, rotate
from fuselog.recorders.models.states import state_metadata
from fuselog.replay.engine.vectors.tangent import TANGENT_WIDTHS, Kind, are_kinds, manifold_blocks

Components = Mapping[str, Kind]
# In the metadata of Gaussian estimates: the axes of the rotation errors in their covariances.
ROTATION_AXES = "rotation_axes"


def components_of(names: Sequence[str]) -> Components:
    """Return the kinds of components by name: "angle" for components in rad, "linear" for others."""
    return stated_components(state_metadata(names), {}, "components")


def match_components(stated: Mapping[str, str], wanted: Components, where: str) -> list[int]:
    """Find the indices of the wanted components among the components that a channel states.

    Args:
        stated: metadata of the channel, with the names under `components` and optionally the kinds under
            `kinds`.
        wanted: names and kinds, in the wanted order.
        where: name of the channel in messages, such as `topic /prior`.

    Raises BadInput if the channel's names or kinds are invalid, or if a wanted component is missing or
    of another kind.
    """
    kinds = stated_components(stated, wanted, where)
    names = list(kinds)
    for name, kind in wanted.items():
        if name not in kinds:
            raise BadInput(
                f"{where}: the channel has no component {name}; it states "
                f"{', '.join(names) or 'no components'}, and {', '.join(wanted)} are needed in any "
                "order: use the same names in both"
            )
        if kinds[name] != kind:
            raise BadInput(
                f"{where}: component {name} has the kind {kinds[name]}; the kind must be {kind}"
            )
    return [names.index(name) for name in wanted]


def match_tangent(stated: Mapping[str, str], wanted: Components, where: str) -> list[int]:
    """Find the rows and columns of a stated covariance that belong to the wanted components, in order.

    A covariance is in the tangent space, in which an axis has one row and a quaternion has three; see
    `fuselog.replay.engine.vectors.tangent`. Arguments and errors are the same as for `match_components`.
    """
    columns = match_components(stated, wanted, where)
    rows_of: list[range] = []
    end = 0
    for kind, numbers in manifold_blocks(list(stated_components(stated, wanted, where).values())):
        begin, end = end, end + TANGENT_WIDTHS[kind]
        rows_of += [range(begin, end)] * (numbers.stop - numbers.start)
    return [
        row
        for _, numbers in manifold_blocks(list(wanted.values()))
        for row in rows_of[columns[numbers.start]]
    ]


def stated_components(stated: Mapping[str, str], wanted: Components, where: str) -> dict[str, Kind]:
    """Return the components' names and kinds in the channel's order, or {} if it names no components.

    If a channel states no kinds, a component has the wanted kind, or "linear" if it is not wanted.
    Raises BadInput if a name occurs twice, if a kind is unknown, or if there is not one kind for each
    name.

    Args:
        stated: metadata of the channel.
        wanted: components whose kinds are used if the channel states no kinds.
        where: name of the topic in messages.
    """
    listed = stated.get("components", ""), stated.get("kinds", "")
    found = _parsed(*listed, tuple(wanted.items()))
    if found is None:
        raise BadInput(
            f"{where}: invalid components '{listed[0]}' with kinds '{listed[1]}': give "
            "each component a unique name and a kind; an axis needs two adjacent components, a "
            "quaternion four"
        )
    return dict(found)


@lru_cache(maxsize=256)
def _parsed(
    components: str, listed: str, wanted: tuple[tuple[str, Kind], ...]
) -> tuple[tuple[str, Kind], ...] | None:
    """Parse names and kinds for `stated_components`; None if they are invalid."""
    names = [name for name in components.split(",") if name]
    asked = dict(wanted)
    kinds = listed.split(",") if listed else [asked.get(name, "linear") for name in names]
    if len(set(names)) < len(names) or len(kinds) != len(names) or not are_kinds(kinds):
        return None
    return tuple(zip(names, cast("list[Kind]", kinds), strict=True))


def in_body_axes(stream: Stream) -> Stream:
    """Convert Gaussian estimates so that rotation errors in their covariances are about body axes.

    Some channels state rotation errors about world axes, as in ROS: `rotation_axes` = "world". Raises
    BadInput if a channel states other axes, or no kinds.
    """
    return _in_axes(stream, "body")


def in_world_axes(stream: Stream) -> Stream:
    """Convert Gaussian estimates like `in_body_axes`, but to rotation errors about world axes."""
    return _in_axes(stream, "world")


def _in_axes(stream: Stream, wanted: str) -> Stream:
    axes = stream.metadata.get(ROTATION_AXES, "body")
    if axes == wanted:
        return stream
    where = f"topic {stream.topic}"
    if axes not in ("body", "world"):
        raise BadInput(f"{where}: its channel states {ROTATION_AXES} = {axes}; state body or world")
    kinds = list(stated_components(stream.metadata, {}, where).values())
    size = sum(TANGENT_WIDTHS[kind] for kind, _ in manifold_blocks(kinds))
    turn, row = np.tile(np.eye(size), (len(stream), 1, 1)), 0
    for kind, columns in manifold_blocks(kinds):
        if kind == "quaternion":  # its columns are the stated axes in coordinates of the wanted ones
            into = stream["mean"].reshape(len(stream), len(kinds))[:, None, columns]
            into = into if wanted == "world" else conjugate(into)
            turn[:, row : row + 3, row : row + 3] = rotate(into, np.eye(3)).swapaxes(1, 2)
        row += TANGENT_WIDTHS[kind]
    covariance = turn @ stream["covariance"].reshape(-1, size, size) @ turn.swapaxes(1, 2)
    return replace(
        stream,
        columns={**stream.columns, "covariance": covariance.reshape(len(stream), size * size)},
        metadata={**stream.metadata, ROTATION_AXES: wanted},
    )
