"""Writes the page's words as HTML: verdicts, numbers, labels of sliders. All text is escaped."""

from html import escape

from pipeline.exploring.plots import COLOURS, QUIET, RED
from pipeline.exploring.session import Played
from pipeline.exploring.sliders import Slider, in_words
from pipeline.exploring.verdict import Verdict, numbers_of

MARKS = {"good": "✓", "doubtful": "✕", "failed": "✕"}
SIDE = 300  # the width of the sliders' column, in pixels
SPREAD = '<div style="display:flex;justify-content:space-between">'


def label_of(slider: Slider, value: float) -> str:
    """The name of a slider, its value, its ends and where the log's own value is."""
    changed = "" if value == slider.own else f"color:{COLOURS[0]};"
    mark = 100.0 * min(max(slider.place(slider.own), 0.0), 1.0)
    return (
        f'<div title="{escape(f"{slider.name}: {slider.meaning}")}" style="width:{SIDE - 20}px">'
        f"{SPREAD}<span>{escape(slider.title)}</span>"
        f'<b style="{changed}">{escape(slider.words(value))}</b></div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11px;color:{QUIET};'
        f'position:relative"><span>{escape(slider.words(slider.low))}</span>'
        f'<span style="position:absolute;left:{mark:.1f}%" title="the log\'s own, '
        f'{escape(slider.words(slider.own))}">▾</span>'
        f"<span>{escape(slider.words(slider.high))}</span></div></div>"
    )


def verdict_html(label: str, verdict: Verdict, colour: str) -> str:
    """Return a filter's verdict, in its colour."""
    mark = MARKS[verdict.level]
    red = "" if verdict.level == "good" else f"color:{RED};"
    return (
        f'<h2 style="margin:4px 0;font-weight:400"><b style="color:{colour}">{escape(label)}</b> '
        f'<b class="headline" style="{red}">{mark} {escape(verdict.headline)}</b> '
        f"{escape(verdict.detail)}</h2>"
    )


def numbers_html(played: Played, pinned: Played | None, case: str) -> str:
    """Its numbers, above those that are pinned."""
    cells = []
    before = numbers_of(pinned.cases[case]) if pinned is not None and case in pinned.cases else {}
    for name, (value, unit) in numbers_of(played.cases[case]).items():
        was = before.get(name)
        ghost = f'<br><small style="color:{QUIET}">pinned {_number(name, *was)}</small>' if was else ""
        cells.append(
            f'<div style="margin-right:32px"><small style="color:{QUIET}">{escape(name)}</small><br>'
            f'<b style="font-size:18px">{_number(name, value, unit)}</b>{ghost}</div>'
        )
    return f'<div class="numbers" style="display:flex">{"".join(cells)}</div>'


def _number(name: str, value: float, unit: str) -> str:
    return f"{value:,.0f}" if name == "log-likelihood" else escape(in_words(value, unit))
