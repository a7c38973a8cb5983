"""Every shipped claim follows its metrics: on either side of each limit, and with intervals."""

import re

import pytest

from tests.claims.limits import Limit, Made, all_limits

# What only several metrics moved against each other would decide.
UNDECIDED = (
    "acoustic-recordings: LOCA_2021_detections_different_starts-zeep",  # apart by nothing at all
    "acoustic: without cross-covariances",  # one share of many is below 1
    "biometrics-sequential-simulated: independent probes",  # two means and two limits
    "biometrics-sequential: independent probes",
    "crossing: ",  # changes of either sign
    "los-two-sensors: sigma_CRLB of the table of biases",  # none of two is near
    "los-two-sensors: any five of the six",  # six ratios
    "lrkf-dimension: mean of waves along the axes",  # changes of either sign
    "torus-propagation: five toroidal samples significantly outperform random",  # lists that cross
    "vehicles-ctm2: 2 vehicles turn",  # three ratios, of which one is far off
    "vehicles-ctm4: 4 vehicles turn",
)
# What equals, or lies within an interval of its own, has no limit in between.
OTHERWISE = re.compile(r"==| in |value\(|high\(|low\(|chi_square|consistent")


@pytest.mark.paper
def test_every_claim_has_a_limit() -> None:
    """A claim that no metric moves would be confirmed, or refuted, whatever is found."""
    names = [
        f"{made.experiment}: {made.claim.sentence}"
        for made, found in all_limits()
        if made.claim.holds and not found
    ]
    assert [name for name in names if not name.startswith(UNDECIDED)] == []
    for known in UNDECIDED:
        assert any(name.startswith(known) for name in names), f"{known} has a limit now"


@pytest.mark.paper
def test_between_the_sides_of_a_limit_nothing_is_shown() -> None:
    """An interval on one side of a limit decides as the number does; one about it decides nothing."""
    count = 0
    for made, found in all_limits():
        for limit in found:
            if _is_plain(made, limit, found):
                verdicts = [_verdict(made, limit, places) for places in (-1.0, 0.0, 1.0)]
                assert verdicts == [limit.below, "inconclusive", limit.above], (made.experiment, limit)
                count += 1
    assert count > 300


def _is_plain(made: Made, limit: Limit, others: list[Limit]) -> bool:
    """Whether it is of one number by itself, which the claim compares with something else."""
    stated = " ".join([made.claim.holds, made.claim.value, *map(str, made.claim.given.values())])
    near = [each for each in others if each.moved == limit.moved and each is not limit]
    return (
        {limit.below, limit.above} == {"confirmed", "refuted"}
        and not limit.width
        and limit.keys == limit.keys[:1]
        and isinstance(made.metrics[limit.keys[0]], int | float)
        and made.metrics[limit.keys[0]] != 0
        and not OTHERWISE.search(stated)
        and not any(abs(each.at - limit.at) < 4.0 * _reach(made, limit) for each in near)
    )


def _reach(made: Made, limit: Limit) -> float:
    value = made.metrics[limit.keys[0]]
    assert isinstance(value, int | float)
    return 0.01 * max(abs(limit.at), abs(value))


def _verdict(made: Made, limit: Limit, side: float) -> str:
    """The verdict with an interval on a side of the limit, or about it."""
    reach = _reach(made, limit)
    at, half = limit.at + side * reach, 0.02 * reach
    [key] = limit.keys
    claim = made.decided({**made.metrics, key: at}, {key: (at - half, at + half)})
    assert claim is not None
    return claim.verdict


@pytest.mark.paper
def test_printed_numbers_follow() -> None:
    """What a claim says of ours changes with what it reads, but where that is a ratio of its own."""
    same = [
        (made.experiment, made.claim.ours)
        for made, _ in all_limits()
        if made.read and "{" in made.claim.ours and _ours(made, 2.0) == _ours(made, 1.0)
    ]
    assert len(same) <= 12, same


def _ours(made: Made, factor: float) -> str:
    claim = made.with_moved(made.read, factor)
    assert claim is not None
    return claim.ours


@pytest.mark.paper
def test_nothing_is_decided_by_what_is_missing() -> None:
    """A claim that lacks the numbers that it reads is neither confirmed nor refuted."""
    for made, found in all_limits():
        for limit in found:
            claim = made.decided({**made.metrics, **dict.fromkeys(limit.keys)})
            assert claim is None or claim.verdict == "not reproducible", (made.experiment, limit)
