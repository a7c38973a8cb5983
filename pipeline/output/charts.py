"""Charts as data: panels of series and bands over axes.

A study describes what to draw: series, bands, labels with units. The result folder keeps the description
as JSON, next to an SVG picture that this module draws. The report draws the description as an
interactive chart.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, PositiveInt, field_validator, model_validator

from fuselog.recorders.parameters import Parameters

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Largest number of points in a line; more are not visible.
MOST_POINTS = 1000
LINE_LETTERS = 100  # characters in a line of a picture's title
# Colours that differ clearly, with a contrast of at least 3:1 to white and black (WCAG 2.2, 1.4.11).
COLOURS = (
    *("#2f7fd1", "#d2640a", "#2a9147", "#d8433b", "#9461d6"),
    *("#138f97", "#d0459a", "#9c6b3f", "#878a12", "#5f78a8"),
)
REFERENCE_COLOUR = "#808080"
OUTSIDE_COLOUR = "#d6336c"
LARGEST = 1e100  # largest value that is drawn


def _on_an_axis(value: Any) -> Any:
    """Drop values that no axis can show: infinite, NaN, or huge because a filter diverged."""
    return value if not isinstance(value, float) or abs(value) < LARGEST else None


Number = Annotated[float | None, BeforeValidator(_on_an_axis)]
Numbers = list[Number]
Places = list[Number] | list[str]
# Triangles mark landmarks, an area is a closed polygon, and "outside" is drawn in red.
Style = Literal["line", "dashed", "markers", "dots", "line+markers", "triangles", "area", "outside"]


class Axis(Parameters):
    """An axis of a panel.

    Attributes:
        label: the quantity, with its unit.
        log: whether the axis is logarithmic.
        limits: ends of the axis; by default those of the data.
        ticks: tick labels by position, if the axis has its own ticks.
    """

    label: str = ""
    log: bool = False
    limits: tuple[float, float] | None = None
    ticks: dict[float, str] = {}

    @field_validator("limits", mode="before")
    @classmethod
    def _are_drawn(cls, limits: Sequence[float] | None) -> Sequence[float] | None:
        return limits and tuple(max(-LARGEST, min(LARGEST, end)) for end in limits)


class Drawn(Parameters):
    """Something that is drawn over x, an array of numbers or names.

    All items with the same label have the same colour in all panels, and are hidden together. A
    reference, such as the truth, is drawn for comparison with the other items.
    """

    label: str
    x: Places
    reference: bool = False


class Series(Drawn):
    """Values y over x."""

    y: Numbers
    style: Style = "line"

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        _check_lengths(self.x, self.y)
        return self


class Band(Drawn):
    """A range over x, such as the 95 % range of a value if the estimator is consistent."""

    low: Numbers
    high: Numbers

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        _check_lengths(self.x, self.low, self.high)
        return self


def _check_lengths(*columns: Sequence[Any]) -> None:
    if len(set(map(len, columns))) > 1:
        raise ValueError("x and the values over it must have the same length")


class Panel(Parameters):
    """Series and bands over two axes.

    Attributes:
        x, y: the axes.
        series: curves over the panel's axes.
        bands: ranges over x.
        title: the text above the panel.
        plane: whether both axes have the same scale.
    """

    x: Axis = Axis()
    y: Axis = Axis()
    series: list[Series] = []
    bands: list[Band] = []
    title: str = ""
    plane: bool = False


class Chart(Parameters):
    """Panels in rows, with a common legend unless the panel titles identify the curves.

    Attributes:
        panels: row by row.
        title: the text above all panels.
        columns: the number of panels in a row.
        legend: whether there is a legend.
    """

    panels: list[Panel]
    title: str = ""
    columns: PositiveInt = 1
    legend: bool = True

    def colours(self, first: Iterable[str] = ()) -> dict[str, str]:
        """Assign a colour to each label, first to those in `first`, so that charts can share colours."""
        drawn: list[Drawn] = [each for panel in self.panels for each in (*panel.series, *panel.bands)]
        own = dict.fromkeys([*first, *(each.label for each in drawn if _has_own_colour(each))])
        colours = {label: COLOURS[index % len(COLOURS)] for index, label in enumerate(own)}
        outside = {
            each.label: OUTSIDE_COLOUR
            for panel in self.panels
            for each in panel.series
            if each.style == "outside"
        }
        return {each.label: REFERENCE_COLOUR for each in drawn if each.reference} | colours | outside


def _has_own_colour(drawn: Drawn) -> bool:
    return not drawn.reference and not (isinstance(drawn, Series) and drawn.style == "outside")


def thinned(count: int, most: int = MOST_POINTS) -> slice:
    """Return a slice that selects every k-th of `count` points, at most `most` of them."""
    return slice(None, None, max(1, -(-count // most)))


def curve(
    label: str, x: ArrayLike, y: ArrayLike, style: Style = "line", *, reference: bool = False
) -> Series:
    """Make a series of values y over x.

    Args:
        label: name in the legend.
        x: (n,), numbers or names.
        y: (n,), values at x.
        style: how the series is drawn.
        reference: whether it is a reference with which the other curves and bands are compared.

    Returns:
        The series, for `Panel.series`.
    """
    return Series(label=label, x=_places(x), y=_numbers(y), style=style, reference=reference)


def curves(table: "pd.DataFrame", by: list[str], x: str, y: str, style: Style = "line") -> list[Series]:
    """Make a series of y over x for each group of a table's rows, in the table's order.

    Args:
        table: table with the columns below.
        by: the columns that group the rows and name the series.
        x: a column of numbers or names.
        y: a column of numbers.
        style: how all series are drawn.
    """
    return [
        curve(", ".join(map(str, key)), rows[x], rows[y], style)
        for key, rows in table.groupby(by, sort=False)
    ]


def path(
    label: str, points: NDArray[np.float64], style: Style = "line", *, reference: bool = False
) -> Series:
    """Make a series of points in the plane.

    Args:
        label: name in the legend.
        points: (n, 2), x and y.
        style: how the series is drawn.
        reference: whether it is a reference with which the other curves and bands are compared.

    Returns:
        The series, for `Panel.series`.
    """
    return curve(label, points[:, 0], points[:, 1], style, reference=reference)


def band(label: str, x: ArrayLike, low: ArrayLike, high: ArrayLike, *, reference: bool = False) -> Band:
    """Make a range over x.

    Args:
        label: name in the legend.
        x: (n,), numbers or names.
        low: (n,), lower end of the range at x.
        high: (n,), upper end of the range at x.
        reference: whether it is a reference with which the other curves and bands are compared.

    Returns:
        The band, for `Panel.bands`.
    """
    return Band(label=label, x=_places(x), low=_numbers(low), high=_numbers(high), reference=reference)


def level(label: str, x: ArrayLike, y: float) -> Series:
    """Make a horizontal reference line from end to end of x.

    Args:
        label: name in the legend.
        x: (n,), numbers or names; only the first and the last are used.
        y: the value.

    Returns:
        The series, for `Panel.series`.
    """
    ends = np.asarray(x)[[0, -1]]
    return curve(label, ends, [y, y], reference=True)


def interval(label: str, x: ArrayLike, low: float, high: float) -> Band:
    """Make a constant reference range from end to end of x.

    Args:
        label: name in the legend.
        x: (n,), numbers or names; only the first and the last are used.
        low: lower end of the range.
        high: upper end of the range.

    Returns:
        The band, for `Panel.bands`.
    """
    ends = np.asarray(x)[[0, -1]]
    return band(label, ends, [low, low], [high, high], reference=True)


def coverage(title: str, held: Mapping[str, Mapping[str, float]]) -> Chart:
    """Draw how many of a hundred 95 % intervals contain the truth, by block and quantity."""
    names = list(next(iter(held.values())))
    places = np.arange(len(names), dtype=float)
    panel = Panel(
        x=Axis(ticks=dict(enumerate(names))),
        y=Axis(label="intervals of 100 that contain the truth", limits=(80.0, 100.5)),
    )
    panel.bands.append(interval("90 to 99", places, 90.0, 99.0))
    for block, counts in held.items():
        panel.series.append(curve(block, places, list(counts.values()), "markers"))
    return Chart(title=title, panels=[panel])


def _places(values: ArrayLike) -> Places:
    array = np.asarray(values)
    return array.astype(str).tolist() if array.dtype.kind in "OSU" else _numbers(array)


def _numbers(values: ArrayLike) -> Numbers:
    """Round numbers to seven digits, more than a screen can show; NaN and infinity become null."""
    array = np.asarray(values, dtype=float)
    return [float(f"{value:.7g}") if np.isfinite(value) else None for value in array.tolist()]


def draw(chart: Chart) -> "Figure":
    """Draw the chart as a figure of matplotlib."""
    from matplotlib.figure import Figure

    rows = -(-len(chart.panels) // chart.columns)
    height_in = max(map(_height_in, chart.panels), default=2.8)
    size_in = (max(8.0, min(3.4 * chart.columns, 12.0)), height_in * rows + 0.5)
    figure = Figure(figsize=size_in, layout="constrained")
    colours = chart.colours()
    for place, panel in enumerate(chart.panels):
        _draw_panel(figure.add_subplot(rows, chart.columns, place + 1), panel, colours)
    if chart.title:
        title = fill(chart.title, LINE_LETTERS)
        figure.suptitle(title, fontsize=10, parse_math=False)
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles and chart.legend:
        columns = min(len(handles), 5)
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=columns, fontsize=8
        )
    return figure


def _height_in(panel: Panel) -> float:
    """Choose the height of a panel, from the ratio of the limits if its axes have the same scale."""
    if panel.plane and panel.x.limits and panel.y.limits:
        wide, high = panel.x.limits[1] - panel.x.limits[0], panel.y.limits[1] - panel.y.limits[0]
        return min(4.5, 7.0 * high / wide + 0.9)
    return 4.5 if panel.plane else 2.8


STYLES: dict[Style, dict[str, Any]] = {
    "line": {},
    "dashed": {"linestyle": "--"},
    "markers": {"linestyle": "", "marker": "o", "markersize": 4},
    "dots": {"linestyle": "", "marker": "o", "markersize": 1, "alpha": 0.5},
    "line+markers": {"marker": "o", "markersize": 3},
    "triangles": {"linestyle": "", "marker": "^", "markersize": 5, "fillstyle": "none"},
    "area": {"alpha": 0.7},
    "outside": {"linestyle": "", "marker": "s", "markersize": 2.5, "clip_on": False},
}


def _draw_panel(axes: "Axes", panel: Panel, colours: dict[str, str]) -> None:
    for each in panel.bands:
        x, low, high = map(_known, (each.x, each.low, each.high))
        colour = colours[each.label]
        axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0, label=each.label)
    for series in panel.series:
        x, y, look = _known(series.x), _known(series.y), STYLES[series.style]
        axes.plot(x, y, color=colours[series.label], label=series.label, linewidth=1.0, **look)
    # with y, matplotlib does not search for a factor above the y axis; a logarithmic axis never has one
    axes.set_title(panel.title, fontsize=9, y=1.0 if panel.y.log else None)
    axes.grid(alpha=0.3)
    for name, of, axis in (("x", panel.x, axes.xaxis), ("y", panel.y, axes.yaxis)):
        axes.set(**{f"{name}label": of.label, f"{name}scale": "log" if of.log else "linear"})
        if of.ticks:
            axis.set_ticks(list(of.ticks), list(of.ticks.values()))
            axis.set_ticks([], minor=True)
        if of.limits:
            axes.set(**{f"{name}lim": of.limits})
    if panel.plane:
        axes.set_aspect("equal", adjustable="box" if panel.x.limits and panel.y.limits else "datalim")


def _known(values: Places) -> list[Any]:
    """Convert values for matplotlib: NaN replaces None."""
    return [math.nan if value is None else value for value in values]


def show_names_as_they_are(figure: "Figure") -> None:
    """Prevent dollar signs in titles, labels and ticks from starting a formula."""
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    legends = [*figure.legends, *filter(None, (axes.get_legend() for axes in figure.axes))]
    texts = [text for legend in legends for text in legend.get_texts()]
    for axes in figure.axes:
        texts.append(axes.title)
        for axis in (axes.xaxis, axes.yaxis):
            texts.append(axis.label)
            if isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter):
                texts += axis.get_ticklabels()
    for text in texts:
        text.set_parse_math(False)
