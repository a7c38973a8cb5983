"""A timeline's file read back: what moves, what stays, and which views show what.

`compare` holds it against what it should show; `check_views` against what all families have in common.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np
import pytest
import rerun.chunk as rc
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fuselog.recorders.log import Stream
from fuselog.replay.judging.errors.evaluation import Errors, Floats, chi_square_interval
from fuselog.replay.timeline.drawing.canvas import MUTED, PALETTE, TRUTH, Colour
from tests.replay.timeline.test_timeline import Columns, read, told

# Kinds of containers, as Rerun numbers them, and the view that names colours.
VERTICAL, GRID = 3, 4
LEGEND = "Legend"
SIGMA_95 = chi2.ppf(0.95, 2)
# How a unit of a component is shown, and how many of that one of its own is.
UNITS = {"m": ("m", 1.0), "rad": ("deg", 180 / np.pi), "mps": ("m/s", 1.0), "-": ("-", 1.0)}


# What views are called, and what the first that each shows is below.
Titles = set[tuple[str, str]]


class View(NamedTuple):
    """A view of the layout: what it shows is below its roots, without a slash before them.

    Its height is a share of the layout's.
    """

    kind: str
    name: str
    roots: list[str]
    span: list[float] | None
    bounds: dict[str, list[float]] | None
    trails: list[str]
    has_legend: bool
    height: float


class Picture(NamedTuple):
    """All of a file; `shared` has for each part that shares its room how much of it which views get.

    Legends are views as well, but in no part of `shared`. `strips` is the largest number of
    plots that are one below another at the same time.
    """

    moving: dict[str, Columns]
    still: dict[str, Columns]
    views: list[View]
    shared: list[list[tuple[float, set[str]]]]
    strips: int


class Wanted(NamedTuple):
    """What an entity should hold: how it is read, at which stamps (n,), and what (n, ...)."""

    how: str
    time_ns: Any
    values: Any


def picture_of(path: Path) -> Picture:
    """Read a file back."""
    reader = rc.RrdReader(str(path))
    parts: dict[str, dict[str, list]] = {}
    containers: dict[str, dict[str, list]] = {}
    trails: dict[str, list[str]] = {}
    root = ""
    for chunk in reader.stream(store=reader.blueprints()[0]):
        kind, _, rest = chunk.entity_path.strip("/").partition("/")
        number, _, detail = rest.partition("/")
        if kind == "viewport":
            batch = chunk.to_record_batch()
            if "ViewportBlueprint:root_container" in batch.schema.names:
                [held] = batch.column("ViewportBlueprint:root_container")[0].as_py()
                root = str(UUID(bytes=bytes(held)))
        if kind in ("view", "container"):
            batch = chunk.to_record_batch()
            named = {name: batch.column(name)[0].as_py() for name in batch.schema.names}
            (parts if kind == "view" else containers).setdefault(number, {}).update(named)
            overridden = detail.removeprefix("ViewContents/overrides/").removesuffix("/visualizers")
            if overridden != detail:
                trails.setdefault(number, []).append(f"/{overridden}")
    heights = _heights(root, containers)
    views = []
    for number, part in parts.items():
        [origin], query = part["ViewBlueprint:space_origin"], part["ViewContents:query"]
        roots = [each.replace("$origin", origin.strip("/")).removesuffix("/**") for each in query]
        [kind], [name] = part["ViewBlueprint:class_identifier"], part["ViewBlueprint:display_name"]
        span, bounds = (
            (part.get(each) or [None])[0] for each in ("ScalarAxis:range", "VisualBounds2D:range")
        )
        has_legend = part.get("PlotLegend:visible", [True]) != [False]
        own = (trails.get(number, []), has_legend, heights[number])
        views.append(View(kind, name, roots, span, bounds, *own))
    kinds = {number: part["ViewBlueprint:class_identifier"][0] for number, part in parts.items()}
    legends = {n for n, part in parts.items() if part["ViewBlueprint:display_name"] == [LEGEND]}
    shared = [
        [
            (share, _kinds_of(each, kinds, containers))
            for share, each in zip(shares, contents, strict=True)
            if each.partition("/")[2] not in legends
        ]
        for container in containers.values()
        if (contents := container["ContainerBlueprint:contents"])
        for axis in ("col", "row")
        if (shares := container.get(f"ContainerBlueprint:{axis}_shares"))
    ]
    strips = _strips_below(root, kinds, containers)
    return Picture(read(path), read(path, static=True), views, shared, strips)


def _heights(root: str, containers: Mapping[str, Any], height: float = 1.0) -> dict[str, float]:
    """How high each view within a container is, by its number."""
    if root not in containers:
        return {root: height}
    part = containers[root]
    within, [kind] = part["ContainerBlueprint:contents"], part["ContainerBlueprint:container_kind"]
    rows = len(within) if kind == VERTICAL else 1
    if kind == GRID:
        columns = part.get("ContainerBlueprint:grid_columns") or [np.ceil(len(within) ** 0.5)]
        rows = int(np.ceil(len(within) / columns[0]))
    shares = part.get("ContainerBlueprint:row_shares") or [1.0] * rows
    found: dict[str, float] = {}
    for number, each in enumerate(within):
        row = number if kind == VERTICAL else number // -(-len(within) // rows)
        found |= _heights(each.partition("/")[2], containers, height * shares[row] / sum(shares))
    return found


def _strips_below(root: str, kinds: Mapping[str, str], containers: Mapping[str, Any]) -> int:
    """How many plots over time are one below another at once."""
    if root not in containers:
        return int(kinds[root] == "TimeSeries")
    part = containers[root]
    within = [
        _strips_below(each.partition("/")[2], kinds, containers)
        for each in part["ContainerBlueprint:contents"]
    ]
    return sum(within) if part["ContainerBlueprint:container_kind"] == [VERTICAL] else max(within)


def _kinds_of(part: str, kinds: Mapping[str, str], containers: Mapping[str, Any]) -> set[str]:
    """Of which kinds the views within a part of the layout are."""
    number = part.partition("/")[2]
    if number in kinds:
        return {kinds[number]}
    within = containers[number]["ContainerBlueprint:contents"]
    return set().union(*(_kinds_of(each, kinds, containers) for each in within))


def _each(columns: Columns, name: str) -> list:
    return [each for row in columns[name] for each in row or []]


def _strips(columns: Columns, archetype: str = "LineStrips2D") -> Floats:
    return np.array(_each(columns, f"{archetype}:strips"))


def _moments(columns: Columns) -> Floats:
    """Centre and covariance (n, 6) of what closed outlines hold with 95 %."""
    corners = _strips(columns)[:, :-1]
    centre = corners.mean(axis=1)
    away = corners - centre[:, None]
    spread = 2.0 / SIGMA_95 * np.einsum("nvi,nvj->nij", away, away) / corners.shape[1]
    return np.concatenate([centre, spread.reshape(-1, 4)], axis=1)


def _directed(lines: Floats) -> Floats:
    """Where lines (n, 2, d) begin and their directions (n, 2 d)."""
    way = lines[:, 1] - lines[:, 0]
    return np.concatenate([lines[:, 0], way / np.linalg.norm(way, axis=1, keepdims=True)], axis=1)


def _arrows(columns: Columns) -> Floats:
    begin, way = (np.array(_each(columns, f"Arrows2D:{name}")) for name in ("origins", "vectors"))
    return _directed(np.stack([begin, begin + way], axis=1))


def _ellipsoids(columns: Columns) -> Floats:
    """Centres and covariances (n, 12), the latter up to a factor that is one for all."""
    names = ("centers", "half_sizes", "quaternions")
    centre, half, turn = (np.array(_each(columns, f"Ellipsoids3D:{name}")) for name in names)
    axes = Rotation.from_quat(turn).as_matrix() * half[:, None, :]
    spread = axes @ axes.transpose(0, 2, 1)
    return np.concatenate([centre, (spread / np.trace(spread[0])).reshape(-1, 9)], axis=1)


def _far_ends(columns: Columns) -> Floats:
    """The directions in which outlines about the origin reach farthest: unit vectors (n, 2) of twice."""
    outlines = _strips(columns)
    tip = np.linalg.norm(outlines, axis=2).argmax(axis=1)
    x, y = outlines[np.arange(len(tip)), tip].T
    twice = 2.0 * np.arctan2(y, x)
    return np.stack([np.cos(twice), np.sin(twice)], axis=1)


def _brightest(columns: Columns) -> Floats:
    """The brightest pixels (n, 2) of square pictures, their middles in pixels."""
    pictures = [np.frombuffer(bytes(row[0]), np.uint8) for row in columns["Image:buffer"]]
    width = round((len(pictures[0]) / 3) ** 0.5)
    sums = [each.reshape(width, width, 3).sum(axis=2, dtype=int) for each in pictures]
    return np.array([np.unravel_index(each.argmax(), each.shape)[::-1] for each in sums]) + 0.5


READERS = {
    "curve": lambda columns: np.array(_each(columns, "Scalars:scalars")),
    "band": lambda columns: np.stack(
        [_each(columns, "Measurements:values"), np.sqrt(_each(columns, "Measurements:variances"))],
        axis=1,
    ),
    "dots": lambda columns: np.array(_each(columns, "Points2D:positions")),
    "places": lambda columns: np.array(_each(columns, "GeoPoints:positions")),
    "lines": _strips,
    "lines in space": lambda columns: _strips(columns, "LineStrips3D"),
    "rays": lambda columns: _directed(_strips(columns)),
    "rays in space": lambda columns: _directed(_strips(columns, "LineStrips3D")),
    "arrows": _arrows,
    "places in space": lambda columns: np.array(_each(columns, "Points3D:positions")),
    "ellipses": _moments,
    "ellipsoids": _ellipsoids,
    "turns": lambda columns: np.array(_each(columns, "Transform3D:quaternion")),
    "far ends": _far_ends,
    "brightest": _brightest,
    "told": told,
}
# Curves are double precision, and what is in a scene is single; a picture has its pixels, an outline
# its corners.
TOLERANCES = {
    "curve": (1e-9, 1e-9),
    "band": (1e-9, 1e-9),
    "places": (1e-12, 0.0),
    "brightest": (0.0, 1.5),
    "far ends": (0.0, 0.05),
}
# These are in colours of their own, below whatever estimator.
OF_NO_ESTIMATOR = {
    *("detections", "axes", "grid", "genuine", "impostor", "threshold", "reports", "circle", "names"),
    "without_fixes",
}
# What a view has beside its data, and the names of columns that are data.
FRAMES = ("grid", "decades", "bounds", "circle", "cells", "names", "numbers", "threshold")
VALUES = ("scalars", "values", "strips", "positions", "centers", "vectors", "text", "buffer", "instance")
SIZES = (
    "LineStrips2D:strips",
    "Points2D:positions",
    "Ellipsoids3D:centers",
    "LineStrips3D:strips",
    "Points3D:positions",
)


def compare(moving: Mapping[str, Columns], wanted: Mapping[str, Wanted]) -> None:
    """Nothing is drawn but what is wanted, and all of that, at its stamps."""
    assert set(moving) == set(wanted), set(moving) ^ set(wanted)
    for entity, (how, time_ns, values) in wanted.items():
        columns, found = moving[entity], READERS[how](moving[entity])
        counted = next((columns[name] for name in SIZES if name in columns), None)
        sizes = 1 if counted is None else [len(row or []) for row in counted]
        stamps = np.repeat(columns["utc"], sizes)
        if how == "band" and len(found) == 2 * len(stamps):
            stamps = np.repeat(stamps, 2)
        assert np.array_equal(stamps, time_ns), entity
        if how == "told":
            assert found == values, entity
            continue
        values = np.asarray(values, float)
        relative, absolute = TOLERANCES.get(how, (1e-4, 1e-5 * max(np.abs(values).max(), 1.0)))
        np.testing.assert_allclose(found, values, relative, absolute, err_msg=entity)


def check_clocks(moving: Mapping[str, Columns], epoch_ns: int, made: Sequence[Stream]) -> None:
    """All that moves is on three clocks: stamps, time since the epoch, and the number of estimates."""
    steps_ns = np.unique(np.concatenate([[0], *(each.publish_time_ns for each in made)]))[1:]
    for entity, columns in moving.items():
        stamps = np.array(columns["utc"])
        assert np.array_equal(columns["sim_time"], stamps - epoch_ns), entity
        before = np.searchsorted(steps_ns, stamps, side="right")
        assert np.array_equal(columns["step"], np.maximum(before - 1, 0)), entity


def consistent(degrees: int, time_ns: Any) -> Wanted:
    """The band that holds 95 % of chi-square values, from end to end."""
    low, high = chi_square_interval(degrees, 1)
    return Wanted("band", [time_ns[0], time_ns[-1]], [[0.5 * (low + high), 0.5 * (high - low)]] * 2)


def quality(errors: Sequence[Errors], case: str) -> tuple[dict[str, Wanted], Titles]:
    """The plots of errors and NEES of a case, and the titles of their views."""
    wanted: dict[str, Wanted] = {}
    titles: Titles = set()
    plots = f"/plots/{case}/".replace("//", "/")
    for each in (each for each in errors if each.case == case):
        time_ns, zero = each.time_ns, np.zeros(len(each.time_ns))
        for column, component in enumerate(each.components):
            quantity, _, unit = component.rpartition("_") if "_" in component else (component, "", "-")
            shown, factor = UNITS[unit]
            error = factor * each.error[:, column]
            bound = factor * 2.0 * np.sqrt(each.covariance[:, column, column])
            rows = np.stack([error, zero, zero, bound], axis=1).reshape(-1, 2)
            plot = f"{plots}error_{component}"
            wanted[f"{plot}/{each.estimator}"] = Wanted("band", np.repeat(time_ns, 2), rows)
            titles.add((f"Error of {quantity.replace('_', ' ')} ({shown}), bands ±2 sigma", plot[1:]))
        count = len(each.components)
        plot = f"{plots}nees_{count}"
        wanted[f"{plot}/{each.estimator}"] = Wanted("curve", time_ns, each.nees)
        wanted[f"{plot}/bounds"] = consistent(count, time_ns)
        titles.add((f"NEES of this run, {count} component{'s' * (count > 1)} (-)", plot[1:]))
        events = f"/events/{case}".rstrip("/")
        wanted[f"{events}/{each.estimator}/worst"] = _worst(each)
        titles.add(("Events", events[1:]))
    return wanted, titles


def _worst(errors: Errors) -> Wanted:
    """The events of the largest NEES and of the largest error, in order of time."""
    units = [name.rpartition("_")[2] for name in errors.components]
    alike = [column for column, unit in enumerate(units) if unit == units[0]]
    quantity, columns, scale = f"error_{units[0]}", alike, 1.0
    if errors.position:
        quantity, columns = "position_error_m", errors.position
    elif errors.rotation:
        quantity, columns, scale = "orientation_error_deg", errors.rotation, 180.0 / np.pi
    elif len(alike) == 1:
        quantity = f"error_{errors.components[0]}"
    length = scale * np.linalg.norm(errors.error[:, columns], axis=1)
    found = [("NEES", errors.nees), (quantity, length)]
    rows = sorted((int(np.nanargmax(values)), name, np.nanmax(values)) for name, values in found)
    of = f" of {errors.case}" * bool(errors.case)
    texts = [f"{errors.estimator}: largest {name} {value:.3g}{of}" for _, name, value in rows]
    return Wanted("told", errors.time_ns[[row for row, *_ in rows]], texts)


def check_views(picture: Picture, titles: Titles, estimators: Sequence[str] = ("one", "two")) -> None:
    """Each view has its title over what that names, and shows it; an estimator has one colour.

    A title's grid has its steps and y up, paths with a trail are there, and ranges hold curves. What
    moves in the plane or in space comes first and has the most room.
    """
    for shares in picture.shared:
        is_space = [bool(kinds & {"2D", "3D"}) for _, kinds in shares]
        assert sorted(is_space, reverse=True) == is_space
        if is_space[0]:
            assert shares[0][0] == max(share for share, _ in shares)
    drawn = {*picture.moving, *picture.still}
    shown = [view for view in picture.views if view.name != LEGEND]
    named = [(_title_of(view), view.roots[0]) for view in shown]
    assert sorted(named) == sorted(titles), {*named} ^ titles
    for view in picture.views:
        for root in view.roots:
            assert any(f"{entity}/".startswith(f"/{root}/") for entity in drawn), (view.name, root)
        assert set(view.trails) <= set(picture.moving), view.name
        _, is_grid, step = view.name.partition(", grid ")
        if is_grid:
            lines = np.array(picture.still[f"/{view.roots[0]}/grid"]["LineStrips2D:strips"][0])
            across = np.unique(lines[lines[:, 0, 0] == lines[:, 1, 0], 0, 0])
            np.testing.assert_allclose(np.diff(across), float(step.removesuffix(" m")), rtol=1e-4)
            assert picture.still["/map"]["Transform3D:mat3x3"] == [[[1, 0, 0, 0, -1, 0, 0, 0, 1]]]
            _check_bounds(picture, view)
        if view.span:
            _check_span(picture, view)
    for entity, columns in picture.still.items():
        _check_style(entity, columns, estimators)


def check_first_view(picture: Picture) -> None:
    """No view is empty, plots are high enough to be read and name units, every colour has a name."""
    assert picture.strips <= 6
    names: dict[int, str] = {}
    for view in picture.views:
        shown = _shown(picture, view)
        names |= _legend_of(view, shown)
        if view.name == LEGEND:
            continue
        assert any(_has_data(entity, columns) for entity, columns in shown.items()), view
        assert 1000 * view.height >= 60, view
        if view.kind == "TimeSeries":
            assert re.search(r"\([^)]+\)", view.name), view
            assert "NEES" not in view.name or "NEES of this run" in view.name
    for view in picture.views:
        for entity, columns in _shown(picture, view).items():
            assert _is_named(entity, columns, view, names), (view, entity, names)


def _legend_of(view: View, shown: Mapping[str, Columns]) -> dict[int, str]:
    """What colours stand for by a view: a legend, or a plot that shows its own."""
    if view.name == LEGEND:
        kinds = [("Points2D:colors", "Points2D:labels")]
    elif view.kind == "TimeSeries" and view.has_legend:
        kinds = [(f"{each}:colors", f"{each}:names") for each in ("SeriesLines", "SeriesPoints")]
    else:
        return {}
    return {
        colour >> 8: name
        for columns in shown.values()
        for colours, labels in kinds
        if colours in columns
        for colour, name in zip(columns[colours][0], columns[labels][0], strict=True)
    }


def _shown(picture: Picture, view: View) -> dict[str, Columns]:
    """What a view shows of all entities, what moves with what stays."""
    hidden = [root.removeprefix("- ") for root in view.roots if root.startswith("- ")]

    def is_below(entity: str, roots: Sequence[str]) -> bool:
        return any(f"{entity}/".startswith(f"/{root}/".replace("//", "/")) for root in roots)

    entities = [*picture.still, *(each for each in picture.moving if each not in picture.still)]
    return {
        entity: picture.still.get(entity, {}) | picture.moving.get(entity, {})
        for entity in entities
        if is_below(entity, view.roots) and not is_below(entity, hidden)
    }


def _has_data(entity: str, columns: Columns) -> bool:
    """Whether an entity is something to see, and no frame for it."""
    if entity.rpartition("/")[2] in FRAMES or entity.startswith("/legend"):
        return False
    values = [name for name in columns if name.partition(":")[2] in VALUES]
    return any(each for name in values for each in columns[name])


def _is_named(entity: str, columns: Columns, view: View, names: Mapping[int, str]) -> bool:
    """Whether an entity's colours are in a legend, it is in the title, or labels stand beside it."""
    rows = [row or [] for name, row in columns.items() if name.endswith(":colors") for row in row]
    labels = [row for name, rows in columns.items() if name.endswith(":show_labels") for row in rows]
    words = [part.replace("\\", "") for part in entity.split("/") if part]
    return (
        words[-1] in (*FRAMES, "axes")
        or [True] in labels
        or {colour >> 8 for row in rows for colour in row} <= set(names)
        or any(word.rstrip("0123456789") in view.name for word in words)
    )


def _title_of(view: View) -> str:
    """The title of a view without the numbers in it, which are right."""
    title = view.name.partition(", grid")[0]
    found = re.search(r", axis to ±([^,]+)", title)
    if found:
        assert view.span is not None
        assert float(found[1]) == view.span[1] == -view.span[0]
    within = re.search(r"(\d+) components? \(-\).*; 95 % within (\S+) to ([^;]+)", title)
    if within:
        low, high = chi_square_interval(int(within[1]), 1)
        assert (float(within[2]), float(within[3])) == pytest.approx((low, high), rel=1e-2)
    return re.sub(r", axis to ±[^,]+|; (?:95 % within|outside:) [^;]+", "", title)


def _check_bounds(picture: Picture, view: View) -> None:
    """What is true is within the bounds of its map, in which y points down."""
    assert view.bounds is not None
    for entity, columns in picture.moving.items():
        is_shown = any(entity.startswith(f"/{root}/") for root in view.roots)
        if is_shown and "truth" in entity.split("/") and "LineStrips2D:strips" in columns:
            places = _strips(columns)[:, -1] * (1.0, -1.0)
            low, high = zip(view.bounds["x_range"], view.bounds["y_range"], strict=True)
            assert np.mean(((places >= low) & (places <= high)).all(axis=1)) > 0.8, view.name


def _check_span(picture: Picture, view: View) -> None:
    """Most of the best curve is within the range of its plot."""
    assert view.span is not None
    low, high = view.span
    shares = []
    for entity, columns in picture.moving.items():
        if entity.startswith(f"/{view.roots[0]}/") and "Scalars:scalars" in columns:
            values = np.array(_each(columns, "Scalars:scalars"))
            shares.append(np.mean((values >= low) & (values <= high)))
    assert max(shares, default=1.0) > 0.8, view.name


def _check_style(entity: str, columns: Columns, estimators: Sequence[str]) -> None:
    """Legends name the curve, and truth and estimators have their colours."""
    *_, last = parts = entity.replace("\\", "").split("/")
    for name in ("SeriesLines", "SeriesPoints", "Measurements"):
        if f"{name}:names" in columns:
            names = columns[f"{name}:names"][0]
            assert names in ([last], [last.replace("_", " ")], [last, f"{last} band"]) or (
                last,
                names,
            ) == ("bounds", ["95 %"])
    colours = next((rows[0] for name, rows in columns.items() if name.endswith(":colors")), None)
    of = {each: PALETTE[number] for number, each in enumerate(estimators)} | {
        "truth": TRUTH,
        "bounds": MUTED,
    }
    named = [of[part] for part in parts if part in of]
    if colours and named and last not in OF_NO_ESTIMATOR:
        assert {colour >> 8 for colour in colours} == {_packed(named[-1])}, entity


def _packed(colour: Colour) -> int:
    red, green, blue = colour
    return (red << 16) + (green << 8) + blue
