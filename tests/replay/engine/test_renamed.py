"""Public names of the release before are accepted, and the warning says what each is called now."""

from dataclasses import replace
from typing import Any

import pytest

import fuselog as fl
from fuselog.recorders.log import schemas
from fuselog.replay.estimators.landmarks import ROBOT


def nothing(*_: Any) -> None:
    """In place of a function that is not called."""


def test_a_public_name_is_found_by_its_old_one() -> None:
    with pytest.warns(FutureWarning, match="fuselog.Told was renamed to fuselog.Diagnostics"):
        assert fl.Told is fl.Diagnostics


@pytest.mark.parametrize(
    ("make", "old", "new"),
    [
        (lambda: replace(ROBOT, estimable={"a": "linear"}), "estimable", "augmentable"),
        (lambda: replace(ROBOT.sensors[0], about=None), "about", "reference"),
        (lambda: fl.Motion(nothing, lost=nothing), "lost", "gap_noise"),
        (lambda: fl.Control("", schemas.RANGE, (), instead=()), "instead", "fallbacks"),
        (lambda: fl.Start({}, suspect=nothing), "suspect", "check_prior"),
        (lambda: fl.Batch("", (), whole=("map",), solve=nothing), "whole", "static"),
        (
            lambda: fl.Estimator("", needs="a map", parameters=None, bind=nothing),
            "needs",
            "requirements",
        ),
    ],
)
def test_a_field_is_given_and_read_by_its_old_name(make: Any, old: str, new: str) -> None:
    with pytest.warns(FutureWarning, match=f"'{old}' was renamed to '{new}'; the old name will be"):
        made = make()
    assert getattr(made, old) is getattr(made, new)
    assert type(made)(**{name: getattr(made, name) for name in made.__dataclass_fields__}) is not made
