"""Trajectory GOSPA, HOTA, IDF1: the sheet's case, and the linear programme against all assignments."""

import json

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.sets.judging.distances import gospa, gospa_pairs
from fuselog.replay.families.tracking.judging.distances import THRESHOLDS, hota, idf1, trajectory_gospa
from fuselog.replay.families.tracking.judging.errors import (
    TracksAt,
    figures_of_whole_tracks,
    track_errors,
    track_figures,
)
from tests.replay.families.tracking import track_peers

NO = (np.nan, np.nan)
TRUTHS = np.array(
    [
        [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0)],
        [(0, 10), (1, 10), (2, 10), (3, 10), NO],
    ]
)
ESTIMATES = np.array(
    [
        [(0, 1), (1, 1), (2, 9), (3, 9), NO],
        [(0, 11), (1, 11), (2, 1), (3, 1), (4, 1)],
        [NO, (50, 50), (51, 50), NO, NO],
    ]
)


@pytest.mark.parametrize("exactly", [False, True])
@pytest.mark.parametrize(
    ("cutoff", "penalty", "value", "parts"),
    [
        (5, 1, 6, (9, 0, 25, 2)),
        (5, 3, 7.211102550927978, (9, 0, 25, 18)),
        (5, 10, 11.40175425099138, (5, 50, 75, 0)),
        (20, 1, 20.273134932713294, (9, 0, 400, 2)),
        (20, 2, 20.42057785666214, (9, 0, 400, 8)),
    ],
)
def test_trajectory_gospa_of_the_sheet(cutoff, penalty, value, parts, exactly):
    found = trajectory_gospa(ESTIMATES, TRUTHS, cutoff, penalty, exactly=exactly)
    assert found.total == pytest.approx(value, abs=1e-9)
    assert found[1:] == pytest.approx(parts, abs=1e-7)


def test_gospa_is_blind_to_a_swap():
    each = [
        gospa(at[np.isfinite(at[:, 0])], true[np.isfinite(true[:, 0])], 5).total
        for at, true in zip(ESTIMATES.swapaxes(0, 1), TRUTHS.swapaxes(0, 1), strict=True)
    ]
    assert each == pytest.approx(np.sqrt([2, 14.5, 14.5, 2, 1]), abs=1e-12)


def test_gospa_of_the_sheet_and_its_pairs():
    truths, estimates = [(0, 0), (10, 0)], [(1, 0), (30, 0), (10, 3)]
    found = gospa(estimates, truths, 20)
    assert found == pytest.approx((14.491376746189438, 10, 0, 200), abs=1e-12)
    assert [each.tolist() for each in gospa_pairs(estimates, truths, 20)] == [[0, 2], [0, 1]]
    assert [each.tolist() for each in gospa_pairs(estimates, truths, 2)] == [[0], [0]]


def test_the_programme_finds_what_all_assignments_do():
    generator = np.random.default_rng(1)
    for _ in range(40):
        truths, estimates = (generator.uniform(0, 10, (n, 4, 2)) for n in (2, 3))
        for tracks in (truths, estimates):
            tracks[generator.random(tracks.shape[:2]) < 0.2] = np.nan
        penalty = generator.uniform(0.5, 4)
        programme = trajectory_gospa(estimates, truths, 4, penalty)
        exact = trajectory_gospa(estimates, truths, 4, penalty, exactly=True)
        assert programme.total == pytest.approx(exact.total, abs=1e-9)
        assert sum(exact[1:]) == pytest.approx(exact.total**2, abs=1e-9)


def test_hota_of_the_sheet():
    one = hota(ESTIMATES, TRUTHS, 8, [0.05, 0.85, 0.9])
    assert one.detection == pytest.approx([9 / 11, 9 / 11, 0], abs=1e-12)
    assert one.association == pytest.approx([0.3439153439153439, 0.3439153439153439, 0], abs=1e-12)
    assert one.hota == pytest.approx([0.5304576150695561, 0.5304576150695561, 0], abs=1e-12)
    means = [each.mean() for each in hota(ESTIMATES, TRUTHS, 8)]
    assert len(THRESHOLDS) == 19
    assert means == pytest.approx(
        [0.4746199713780239, 0.7320574162679426, 0.3077137287663603], abs=1e-12
    )


@pytest.mark.paper
def test_figures_are_those_of_motmetrics_and_trackeval_on_random_scenes():
    """IDF1, switches and breaks of motmetrics, HOTA and IDF1 of TrackEval; see `track_peers`.

    Of every fifth scene: forty.
    """
    kept = json.loads(track_peers.KEPT.read_text())["scenes"]
    assert len(kept) == track_peers.SCENES
    for seed, theirs in [*enumerate(kept)][::5]:
        tracks, targets = track_peers.scene(seed)
        told = [
            TracksAt(np.flatnonzero(there), at[there])
            for at in tracks.transpose(1, 0, 2)
            for there in [np.isfinite(at[:, 0])]
        ]
        found = track_figures(track_errors(told, targets)) | figures_of_whole_tracks(told, targets)
        ours = [found[name] for name in ("idf1", "switches", "breaks", "hota")]
        assert ours == pytest.approx([*theirs.values()], abs=1e-9), seed


def test_every_track_counts_unless_truths_cover_some_targets():
    """Two targets that are followed, and ten tracks 300 m away: IDF1 is 2 * 20 / (20 + 20 + 100)."""
    targets = np.stack([np.zeros((10, 2)), np.full((10, 2), 100.0)])
    numbers = np.arange(12)
    places = np.concatenate([targets[:, 0] + 1.0, [[40.0 * each, 400.0] for each in range(10)]])
    told = [TracksAt(numbers, places)] * 10
    errors = track_figures(track_errors(told, targets))
    assert (errors["false_targets"], errors["missed_targets"]) == (10.0, 0.0)
    assert "unreferenced_targets" not in errors
    assert figures_of_whole_tracks(told, targets)["idf1"] == pytest.approx(40 / 140)
    assert figures_of_whole_tracks(told, targets)["hota"] < 0.5
    some = track_figures(track_errors(told, targets, unreferenced_m=50.0))
    assert (some["false_targets"], some["unreferenced_targets"]) == (0.0, 10.0)
    assert figures_of_whole_tracks(told, targets, 50.0)["referenced_idf1"] == 1.0


def test_idf1_counts_the_one_track_of_each_thing():
    """Of 9 points of truths and 11 of tracks, 3 + 2 are in each truth's own track."""
    assert idf1(ESTIMATES, TRUTHS, 5) == pytest.approx(2 * 5 / 20)
    assert idf1(TRUTHS, TRUTHS, 5) == 1
    assert np.isnan(idf1(np.full((1, 3, 2), np.nan), np.empty((0, 3, 2)), 5))


def test_nothing_to_track_and_nothing_tracked():
    nobody = np.empty((0, 5, 2))
    for exactly in (False, True):
        found = trajectory_gospa(nobody, TRUTHS, 5, 1, exactly=exactly)
        assert found == pytest.approx((np.sqrt(9 * 12.5), 0, 9 * 12.5, 0, 0))
    assert hota(nobody, TRUTHS, 8).hota.tolist() == [0.0] * 19


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: trajectory_gospa(ESTIMATES, TRUTHS[:, :4], 5, 1), "same steps"),
        (lambda: trajectory_gospa(ESTIMATES, TRUTHS, 5, 0), "penalty"),
        (lambda: hota(ESTIMATES, TRUTHS, 0), "cutoff"),
        (lambda: idf1(ESTIMATES, TRUTHS, -1), "cutoff"),
        (
            lambda: trajectory_gospa(np.zeros((9, 2, 2)), np.zeros((9, 2, 2)), 5, 1, exactly=True),
            "exactly=False",
        ),
    ],
)
def test_bad_input_is_named(call, said):
    with pytest.raises(BadInput, match=said):
        call()
