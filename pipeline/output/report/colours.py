"""Chooses the colours of estimators' names: their curves', dark or light enough to be read."""

from functools import cache

from pipeline.output.charts import COLOURS

# The grounds of the page on which names stand; the first of each is the page's own.
LIGHT, DARK = ("#ffffff", "#fdf1f5"), ("#14171a", "#2a1a20")
READABLE = 4.6  # WCAG 2.2, 1.4.3 asks for 4.5 to 1


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour such as `#2f7fd1`, from 0 to 1 (WCAG 2.2)."""
    channels = [int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)]
    linear = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, from 1 to 21."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def readable(colour: str, grounds: tuple[str, ...], towards: int) -> str:
    """Return the colour, mixed with black (0) or white (255) until it is read on all grounds."""
    channels = [int(colour[place : place + 2], 16) for place in (1, 3, 5)]
    for share in range(0, 101, 2):
        mixed = [round(each + (towards - each) * share / 100) for each in channels]
        text = "#" + "".join(f"{each:02x}" for each in mixed)
        if all(contrast(text, ground) >= READABLE for ground in grounds):
            return text
    raise AssertionError("black or white is read on any ground")


@cache
def text_colours() -> list[tuple[str, str]]:
    """Of each curve's colour what is read on the light page and on the dark one."""
    return [(readable(each, LIGHT, 0), readable(each, DARK, 255)) for each in COLOURS]
