"""The plots of the page, which are Bokeh figures with data that change during a drag."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTicker,
    BasicTickFormatter,
    ColumnDataSource,
    FixedTicker,
    NumeralTickFormatter,
    Range1d,
    Span,
)
from bokeh.plotting import figure

from fuselog.pipeline.exploring.curves import (
    Case,
    Path,
    extremes,
    fewer,
    map_points,
    true_path,
)
from fuselog.pipeline.exploring.session import Played
from fuselog.pipeline.exploring.sliders import Slider, ticks_between
from fuselog.pipeline.output.words import label_of, quantity
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.consistency.consistency import ellipses

# The report's black, grey and crimson; each filter has its own colour, and pinned results are grey.
INK, QUIET, RED, GHOST, TINT = "#1c1f24", "#5b6470", "#b3123f", "#8b939e", "#e3e7eb"
COLOURS = ("#a35c00", "#1f7a4d")
PINNED = "pinned"
SHIFTS: Mapping[int | str, float] = {PINNED: 0.3, 1: 0.15, 0: 0.0}  # wide enough to distinguish lags
HEIGHT, HEIGHT_OVER_TIME = 220, 235
LEAST_DROP = 10.0  # smallest range of log-likelihood in its plot
CORNERS = 60  # number of corners of an ellipse
ABOUT_PEAK = 3  # number of values that are shown on each side of the peak
LEAST_CORRELATION = 0.25
TICKS = [0.0, 0.25, 0.5, 0.75, 1.0]  # positions of the marks of a slider, from end to end


@dataclass
class Plot:
    """A figure with the data that change.

    Attributes:
        figure: the Bokeh figure.
        sources: data that change, by filter (0, 1, or `PINNED`) and by content, such as "line".
    """

    figure: Any
    sources: dict[tuple[int | str, str], ColumnDataSource] = field(default_factory=dict)

    def source(self, of: int | str, what: str, *columns: str) -> ColumnDataSource:
        """Add an empty source."""
        made = ColumnDataSource({name: [] for name in columns}, name=f"{self.figure.name}-{what}-{of}")
        self.sources[of, what] = made
        return made

    def say(self, title: str) -> None:
        """Set the title."""
        self.figure.title.text = title

    def name(self) -> None:
        """Set the title for screen readers; this is slow, so it waits until a slider stops moving."""
        self.figure.html_attributes = {"role": "img", "aria-label": self.figure.title.text}

    def show_if_drawn(self) -> None:
        """Show the figure if it has data of a filter, and otherwise hide it."""
        self.figure.visible = any(len(x) for of in self.sources.values() for x in of.data.values())

    def clear(self, of: int | str) -> None:
        """Remove the data of a filter."""
        for own, what in self.sources:
            if own == of:
                self.fill(of, what, **{name: [] for name in self.sources[own, what].data})

    def fill(self, of: int | str, what: str, **columns: Any) -> None:
        """Set the data of a source if the source exists and the data are different."""
        if (of, what) not in self.sources:
            return
        source = self.sources[of, what]
        if not all(np.array_equal(each, source.data[name]) for name, each in columns.items()):
            source.data = {name: np.asarray(each) for name, each in columns.items()}


def blank(name: str, title: str, *, over_time: Range1d | None = None, **options: Any) -> Plot:
    """Make an empty figure in the style of the page, without a tool bar."""
    ranges = {} if over_time is None else {"x_range": over_time}
    made = figure(
        name=name,
        title=title,
        height=HEIGHT if over_time is None else HEIGHT_OVER_TIME,
        sizing_mode="stretch_width",
        toolbar_location=None,
        tools="",
        output_backend="canvas",
        min_border_right=20,  # room for the last number of the axis
        **ranges,
        **options,
    )
    made.outline_line_color = None
    made.grid.grid_line_color = TINT
    made.axis.axis_line_color = TINT
    made.axis.major_tick_line_color = None
    made.axis.minor_tick_line_color = None
    made.axis.major_label_text_color = QUIET
    made.title.text_color = INK
    made.title.text_font_style = "normal"
    made.axis.axis_label_text_font_style = "normal"
    made.axis.axis_label_text_color = QUIET
    made.background_fill_alpha = 0.0
    made.border_fill_alpha = 0.0
    if over_time is not None:
        made.xaxis.axis_label = over_time.name
    plot = Plot(made)
    plot.name()
    return plot


def error_plot(over_time: Range1d, cursor: Span) -> Plot:
    """Make the plot of a component's errors, in which the filter's 95 % interval is tinted."""
    plot = blank("error", "Error", over_time=over_time, y_range=Range1d(-1.0, 1.0))
    plot.figure.yaxis.ticker = FixedTicker(ticks=[])
    for of in (1, 0):
        plot.figure.varea("t", "low", "high", source=plot.source(of, "band", "t", "low", "high"),
                          fill_color=COLOURS[of], fill_alpha=0.16)  # fmt: skip
    _lines(plot)
    plot.figure.add_layout(cursor)
    _foot(plot)
    return plot


def ratio_plot(name: str, title: str, over_time: Range1d, cursor: Span) -> Plot:
    """Make a logarithmic plot of NEES or NIS over time, with the consistent interval in grey."""
    plot = blank(name, title, over_time=over_time, y_range=Range1d(0.1, 100.0), y_axis_type="log")
    interval = plot.source(0, "interval", "t", "low", "high")
    plot.figure.varea("t", "low", "high", source=interval, fill_color=TINT, fill_alpha=1.0)
    plot.figure.yaxis.formatter = BasicTickFormatter(use_scientific=False)
    _lines(plot)
    plot.figure.add_layout(cursor)
    _foot(plot)
    return plot


def scene_plot(log: MemorySource, topics: Sequence[str]) -> Plot:
    """Make the view from above, with map, truth and estimates."""
    plot = blank("scene", "Scene from above (m)", match_aspect=True)
    plot.figure.axis.ticker = BasicTicker(desired_num_ticks=4)
    points = map_points(log)
    plot.figure.scatter(points[:, 0], points[:, 1], marker="triangle", size=8, line_color=QUIET,
                        fill_color=None)  # fmt: skip
    for topic in topics:
        path = true_path(log, topic)
        if path is not None:
            rows = fewer(len(path.points))
            plot.figure.line(*path.points[rows].T, line_color=INK, line_width=1.5)
    _lines(plot, "x", "y")
    plot.figure.scatter("x", "y", size=9, source=plot.source(0, "here", "x", "y"), line_color=RED,
                        fill_color=None, line_width=2)  # fmt: skip
    return plot


def lens_plot() -> Plot:
    """Make the plot of one instant, magnified so that errors of centimetres are visible."""
    plot = blank("lens", "Lens", x_range=Range1d(0, 1), y_range=Range1d(0, 1))
    plot.figure.axis.ticker = BasicTicker(desired_num_ticks=4)
    plot.figure.xaxis.ticker = BasicTicker(desired_num_ticks=2)  # its numbers have many digits
    plot.figure.match_aspect = True
    plot.figure.line("x", "y", source=plot.source(0, "truth", "x", "y"), line_color=INK, line_width=2)
    for of in (PINNED, 1, 0):
        colour = GHOST if of == PINNED else COLOURS[int(of)]
        plot.figure.patch("x", "y", source=plot.source(of, "ellipse", "x", "y"), line_color=colour,
                          fill_color=colour, fill_alpha=0.16, line_width=1.5)  # fmt: skip
    _lines(plot, "x", "y")
    plot.figure.scatter("x", "y", size=9, source=plot.source(0, "here", "x", "y"), line_color=RED,
                        fill_color=RED)  # fmt: skip
    return plot


def whiteness_plot() -> Plot:
    """Make the autocorrelation plot of the least white component of the whitened innovations."""
    plot = blank("whiteness", "Whiteness", y_range=Range1d(-0.25, 0.25))
    interval = plot.source(0, "interval", "t", "low", "high")
    plot.figure.varea("t", "low", "high", source=interval, fill_color=TINT)
    for of in SHIFTS:
        colour = GHOST if of == PINNED else COLOURS[int(of)]
        source = plot.source(of, "line", "x", "y", "zero")
        plot.figure.segment("x", "zero", "x", "y", source=source, line_color=colour, line_width=2)
        plot.figure.scatter("x", "y", source=source, size=5, color=colour)
    plot.figure.xaxis.axis_label = "lag, in measurements"
    return plot


def likelihood_plot() -> Plot:
    """Make the plot of the log-likelihood of all measurements over the dragged parameter."""
    plot = blank("likelihood", "Likelihood", x_range=Range1d(-0.05, 1.05), y_range=Range1d(0.0, 1.0))
    plot.figure.yaxis.formatter = NumeralTickFormatter(format="0,0")
    plot.figure.xaxis.ticker = FixedTicker(ticks=TICKS)
    source = plot.source(0, "line", "x", "y")
    plot.figure.line("x", "y", source=source, line_color=QUIET, line_width=1.5)
    plot.figure.scatter("x", "y", source=plot.source(0, "peak", "x", "y"), marker="diamond", size=9,
                        color=INK)  # fmt: skip
    plot.figure.scatter("x", "y", source=plot.source(0, "here", "x", "y"), size=10, color=COLOURS[0])
    return plot


def show_played(
    plots: Mapping[str, Plot], of: int | str, played: Played, case: str, component: str
) -> None:
    """Draw the errors, NEES, NIS, whiteness and path of one replay."""
    if (one := played.cases.get(case)) is None:
        for plot in plots.values():
            plot.clear(of)
        return
    _show_errors(plots["error"], of, one, component)
    _show_nees(plots["nees"], of, one)
    _show_nis(plots["nis"], of, one)
    _show_whiteness(plots["whiteness"], of, one)
    if one.path is not None:
        rows = fewer(len(one.path.points))
        plots["scene"].fill(of, "line", x=one.path.points[rows, 0], y=one.path.points[rows, 1])


def _show_errors(plot: Plot, of: int | str, case: Case, component: str) -> None:
    """Draw the error of a component or, without truth, its estimate or 95 % interval."""
    errors, name = case.errors, label_of(component)
    if errors is None or component not in errors.components:
        if component not in case.components:  # for example, a filter without it in the state
            plot.clear(of)
            return
        sigma, t = 1.96 * case.sigma[:, case.components.index(component)], case.time_s
        rows = fewer(len(t))
        middle = case.beside.get(component, np.zeros(len(t)))[rows]
        is_known = component in case.beside
        plot.fill(of, "line", x=t[rows] if is_known else [], y=middle if is_known else [])
        plot.fill(of, "band", t=t[rows], low=middle - sigma[rows], high=middle + sigma[rows])
        if of == 0:
            plot.fill(0, "outside", t=[], foot=[])
            plot.say(f"{'Estimate' if is_known else 'Errors'} of {name}; tinted: its 95 % interval")
        return
    place = errors.components.index(component)
    error, t = errors.error[:, place], errors.elapsed_s
    sigma = 1.96 * np.sqrt(errors.covariance[:, place, place])
    rows, even = extremes(error), fewer(len(t))
    plot.fill(of, "line", x=t[rows], y=error[rows])
    plot.fill(of, "band", t=t[even], low=-sigma[even], high=sigma[even])
    _show_foot(plot, of, f"Error of {name}", t, np.abs(error) > sigma)


def _show_nees(plot: Plot, of: int | str, case: Case) -> None:
    if case.errors is None or len(case.errors.nees) == 0:
        return
    t, nees = case.errors.elapsed_s, case.errors.nees
    low, high = case.nees_interval
    rows = extremes(nees)
    plot.fill(of, "line", x=t[rows], y=np.maximum(nees[rows], 1e-6))
    plot.fill(of, "interval", t=t[[0, -1]], low=[low, low], high=[high, high])
    _show_foot(plot, of, "NEES", t, (nees < low) | (nees > high))


def _show_nis(plot: Plot, of: int | str, case: Case) -> None:
    if case.nis is None:
        return
    nis = case.nis
    rows = extremes(nis.mean)
    plot.fill(of, "line", x=nis.time_s[rows], y=np.maximum(nis.mean[rows], 1e-6))
    even = fewer(len(nis.time_s))
    plot.fill(
        of, "interval", t=nis.time_s[even], low=np.maximum(nis.low[even], 1e-6), high=nis.high[even]
    )
    outside = (nis.mean < nis.low) | (nis.mean > nis.high)
    _show_foot(plot, of, "NIS per component", nis.time_s, outside)


def _show_whiteness(plot: Plot, of: int | str, case: Case) -> None:
    if not case.whiteness:
        return
    name, white = min(
        case.whiteness.items(), key=lambda each: np.nan_to_num(each[1].probability, nan=2.0)
    )
    lags = np.arange(1, len(white.correlation) + 1, dtype=float)
    plot.fill(of, "line", x=lags + SHIFTS[of], y=white.correlation, zero=np.zeros(len(lags)))
    ends = [0.0, len(lags) + 1.0]
    plot.fill(of, "interval", t=ends, low=[-white.bound] * 2, high=[white.bound] * 2)
    most = max(LEAST_CORRELATION, 1.1 * float(np.nan_to_num(np.abs(white.correlation)).max()))
    plot.figure.y_range.update(start=-most, end=most)
    plot.say(f"Whiteness of the innovations of {quantity(name).name}")


def show_lens(
    plot: Plot,
    scene: Plot,
    played: Mapping[int | str, Played],
    case: str,
    truth: Path | None,
    at_s: float,
) -> None:
    """Show truth, estimates and 95 % ellipses at one instant."""
    first = played[0].cases.get(case) if 0 in played else None
    if first is None or first.path is None or not len(first.path.points):
        return
    half = 0.0
    for of, each in played.items():
        one = each.cases.get(case)
        if one is None or one.path is None:
            continue
        row = int(np.argmin(np.abs(one.path.time_s - at_s)))
        [outline] = ellipses(one.path.points[[row]], one.covariance[[row]], vertices=CORNERS)
        plot.fill(of, "ellipse", x=outline[:, 0], y=outline[:, 1])
        near = np.abs(one.path.time_s - at_s) < 5.0
        plot.fill(of, "line", x=one.path.points[near, 0], y=one.path.points[near, 1])
        half = max(half, float(np.nan_to_num(np.abs(outline - one.path.points[row])).max()))
    center = first.path.points[int(np.argmin(np.abs(first.path.time_s - at_s)))]
    scene.fill(0, "here", x=center[:1], y=center[1:])
    if truth is not None:
        there = np.array([np.interp(at_s, truth.time_s, each) for each in truth.points.T])
        near = np.abs(truth.time_s - at_s) < 5.0
        plot.fill(0, "truth", x=truth.points[near, 0], y=truth.points[near, 1])
        plot.fill(0, "here", x=there[:1], y=there[1:])
        half = max(half, float(np.abs(there - center).max()))
    half = 1.4 * (half or 1.0)
    plot.figure.x_range.update(start=center[0] - 1.6 * half, end=center[0] + 1.6 * half)
    plot.figure.y_range.update(start=center[1] - half, end=center[1] + half)


def show_likelihood(
    plot: Plot,
    slider: Slider,
    along: Sequence[tuple[float, Mapping[str, float]]],
    case: str,
    now: float,
) -> None:
    """Draw the likelihood of a case along a parameter, its peak, and the current value."""
    points = [(value, each[case]) for value, each in along if np.isfinite(each.get(case, np.nan))]
    if not points:
        return
    places = np.array([slider.place(value) for value, _ in points])
    likelihoods = np.array([each for _, each in points])
    best = int(np.argmax(likelihoods))
    plot.fill(0, "line", x=places, y=likelihoods)
    plot.fill(0, "peak", x=places[[best]], y=likelihoods[[best]])
    here = slider.place(now)
    there = float(np.interp(here, places, likelihoods))
    plot.fill(0, "here", x=[here], y=[there])
    near = likelihoods[max(best - ABOUT_PEAK, 0) : best + ABOUT_PEAK + 1]
    below = 1.3 * max(likelihoods[best] - min(there, *near), LEAST_DROP)
    plot.figure.y_range.update(start=likelihoods[best] - below, end=likelihoods[best] + 0.15 * below)
    plot.say(f"Likelihood over {slider.title}; largest near {slider.words(points[best][0])}")
    plot.figure.xaxis.major_label_overrides = {each: slider.words(slider.value(each)) for each in TICKS}


def fit_errors(plot: Plot, played: Mapping[int | str, Played], case: str, component: str) -> None:
    """Scale the error axis so that all except rare errors are visible, also those of pinned replays."""
    most, ends = 0.0, [0.0]
    for each in played.values():
        one = each.cases.get(case)
        if one is None or component not in one.components:
            continue
        sigma = float(np.nanmedian(one.sigma[:, one.components.index(component)]))
        most = max(most, 1.96 * sigma * 2.0)
        if component in one.beside:
            ends += np.nanquantile(one.beside[component], [0.005, 0.995]).tolist()
        elif one.errors is not None and len(one.errors.error):
            errors = one.errors.error[:, one.errors.components.index(component)]
            most = max(most, float(np.quantile(np.abs(errors), 0.995)))
    if most > 0.0:
        low, high = min(ends) - 1.1 * most, max(ends) + 1.1 * most
        plot.figure.y_range.update(start=low, end=high)
        ticks = ticks_between(low, high, unit_of(component))
        # setting a new ticker makes Bokeh search all models
        plot.figure.yaxis[0].ticker.ticks = list(ticks)
        plot.figure.yaxis.major_label_overrides = ticks


def _lines(plot: Plot, x: str = "x", y: str = "y") -> None:
    """Add a line for pinned results and a line per filter; the second filter's is dashed and on top."""
    for of in (PINNED, 0, 1):
        colour, width = (GHOST, 1.0) if of == PINNED else (COLOURS[int(of)], 1.5)
        source = plot.source(of, "line", x, y)
        dash = "dashed" if of == 1 else "solid"  # lines that coincide are both visible
        plot.figure.line(x, y, source=source, line_color=colour, line_width=width, line_dash=dash)


def _foot(plot: Plot) -> None:
    """Add a strip at the bottom with marks where the first filter is outside its interval."""
    plot.figure.extra_y_ranges = {"foot": Range1d(0.0, 1.0)}
    marks = plot.source(0, "outside", "t", "foot")
    plot.figure.scatter("t", "foot", source=marks, marker="dash", angle=np.pi / 2, size=7, color=RED,
                        y_range_name="foot")  # fmt: skip


def _show_foot(plot: Plot, of: int | str, title: str, time_s: Floats, outside: Any) -> None:
    if of == 0:
        t = time_s[outside]
        t = t[fewer(len(t))] if len(t) else t
        plot.fill(0, "outside", t=t, foot=np.full(len(t), 0.02))
        share = 100.0 * float(np.mean(outside)) if len(outside) else 0.0
        shown = f"{share:.0f}" if share >= 10.0 or not share else f"{share:.1f}"
        plot.say(f"{title}: outside {shown} %; 5 % expected")
