"""Association: the sheet's exact cases, all maps one by one, and what is chosen or approximated."""

from collections.abc import Iterator
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from fuselog.recorders.errors import BadInput
from fuselog.replay.families.tracking.association.association import existence_after, marginals
from fuselog.replay.families.tracking.association.births import ending
from fuselog.replay.families.tracking.association.clusters import MOST_ENUMERATED
from fuselog.replay.families.tracking.association.scans import Scans, in_time
from fuselog.replay.families.tracking.association.shared_bias import pool_errors, pool_of
from fuselog.replay.families.tracking.association.track_management import MANAGEMENTS
from fuselog.replay.families.tracking.association.tracks import no_tracks

PLACES = np.array([[0.0, 0.0], [4.0, 1.0], [9.0, -1.0]])
COVARIANCES = np.array([[[1, 0], [0, 2]], [[2, 0.5], [0.5, 1]], [[1.5, 0], [0, 1.5]]]) + np.array(
    [[1, 0.2], [0.2, 0.5]]
)
DETECTIONS = np.array([[1, 0.5], [3, 0], [6.5, 0.2], [8, -2]])
GATE = 9.21034037197618
DIFFERENCES = DETECTIONS - PLACES[:, None]
SQUARED = np.einsum("tdi,tij,tdj->td", DIFFERENCES, np.linalg.inv(COVARIANCES), DIFFERENCES)
DENSITY = np.exp(-0.5 * SQUARED) / (2 * np.pi * np.sqrt(np.linalg.det(COVARIANCES)))[:, None]


def scene(
    probability: float, clutter: float, gate: float = np.inf, inside: float = 1.0, existence=1.0
) -> tuple[np.ndarray, np.ndarray]:
    """The weights of pairs and misses in the sheet's scene."""
    existence = np.broadcast_to(existence, 3)
    pairs = probability * existence[:, None] * DENSITY / clutter
    return np.where(gate >= SQUARED, pairs, 0.0), 1.0 - probability * inside * existence


def maps(detected: np.ndarray, missed: np.ndarray) -> Iterator[tuple[tuple[int, ...], float]]:
    """Every map with its weight: one detection or none (0) for each track."""
    for chosen in product(range(1 + detected.shape[1]), repeat=len(missed)):
        taken = [each for each in chosen if each]
        weights = [detected[i, j - 1] if j else missed[i] for i, j in enumerate(chosen)]
        if len(set(taken)) == len(taken) and all(weights):
            yield chosen, float(np.prod(weights))


def summed(detected: np.ndarray, missed: np.ndarray) -> np.ndarray:
    """The marginals by the sum over maps one by one."""
    found = np.zeros((len(missed), 1 + detected.shape[1]))
    for chosen, weight in maps(detected, missed):
        found[np.arange(len(missed)), chosen] += weight
    return found / found.sum(axis=1, keepdims=True)


def test_the_sheet_without_a_gate():
    assert SQUARED[[0, 1, 2], [0, 1, 3]] == pytest.approx(
        [0.5645161290323, 0.7730673316708, 0.8266129032258], abs=1e-12
    )
    weights = [weight for _, weight in maps(*scene(0.9, 0.01))]
    assert len(weights) == 73
    assert sum(weights) == pytest.approx(171.66984359024954, rel=1e-13)
    expected = [
        [0.0239820226329, 0.9196228049270, 0.0563686981371, 0.0000264672475, 0.0000000070554],
        [0.0179303195646, 0.0384320779412, 0.7677469145834, 0.1758295190728, 0.0000611688381],
        [0.0190828057105, 0.0000000492232, 0.0001089856355, 0.1691861438577, 0.8116220155732],
    ]
    np.testing.assert_allclose(marginals(*scene(0.9, 0.01)), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("weights", "entries"),
    [
        (
            scene(0.9, 0.01, GATE),
            {
                (0, 0): 0.0239809460122,
                (0, 1): 0.9196465414537,
                (0, 2): 0.0563725125341,
                (1, 0): 0.0179254627847,
                (1, 1): 0.0384307237000,
                (1, 2): 0.7678781336693,
                (1, 3): 0.1757656798459,
                (2, 0): 0.0190809618003,
                (2, 3): 0.1691633254715,
                (2, 4): 0.8117557127282,
            },
        ),
        (
            scene(0.9, 0.01, GATE, 0.99),
            {
                (0, 0): 0.0260716474881,
                (1, 0): 0.0194950374378,
                (2, 0): 0.0207606461797,
                (0, 1): 0.9175726678088,
                (0, 2): 0.0563556847031,
            },
        ),
        (
            scene(0.7, 0.05),
            {
                (0, 0): 0.3066403216195,
                (1, 0): 0.2427458395371,
                (2, 0): 0.2702182792164,
                (0, 1): 0.6421964793137,
                (1, 2): 0.5568061047505,
                (2, 4): 0.5959676995049,
            },
        ),
    ],
    ids=["B", "C", "D"],
)
def test_the_sheet_with_gates_and_more_clutter(weights, entries):
    found = marginals(*weights)
    assert [found[place] for place in entries] == pytest.approx(list(entries.values()), abs=1e-12)
    if weights[0][0, 3] == 0.0:
        assert len(list(maps(*weights))) == 27
        assert found[0, 3] == found[2, 1] == 0.0


def test_the_sheet_with_existence():
    existence = np.array([0.9, 0.6, 0.3])
    none = marginals(*scene(0.9, 0.01, existence=existence))[:, 0]
    assert none == pytest.approx([0.0478592150247, 0.1205858392942, 0.3201926847030], abs=1e-12)
    after = [existence_after(r, missed, 0.9) for r, missed in zip(existence, none, strict=True)]
    assert after == pytest.approx([0.9748109394607, 0.8951427484399, 0.6929659187779], abs=1e-12)


@pytest.mark.parametrize(("tracks", "detections"), [(1, 1), (2, 5), (5, 2), (4, 4), (3, 0)])
def test_clusters_are_summed_as_maps_one_by_one(tracks, detections):
    """Whichever are fewer, and however the gates connect them."""
    generator = np.random.default_rng(5)
    for _ in range(20):
        detected = generator.exponential(1.0, (tracks, detections)) * 10.0 ** generator.uniform(-8, 8)
        detected[generator.random(detected.shape) < 0.5] = 0.0
        missed = generator.uniform(1e-6, 1.0, tracks)
        found = marginals(detected, missed)
        np.testing.assert_allclose(found, summed(detected, missed), rtol=1e-12, atol=1e-15)


def test_one_map_is_chosen():
    """The best one, as the library has it; the surest pair first is another one."""
    generator = np.random.default_rng(6)
    for tracks, detections in ((1, 3), (4, 4), (7, 5), (12, 20)):
        detected = generator.exponential(5.0, (tracks, detections))
        detected[generator.random(detected.shape) < 0.4] = 0.0
        missed = generator.uniform(0.1, 1.0, tracks)
        found = marginals(detected, missed, "hungarian")
        assert set(np.unique(found)) <= {0.0, 1.0}
        assert (found.sum(axis=1) == 1).all()
        assert (found[:, 1:].sum(axis=0) <= 1).all()
        gain = np.log(np.maximum(detected / missed[:, None], 1.0))
        best = gain[linear_sum_assignment(gain, maximize=True)].sum()
        chosen = detected[found[:, 1:] == 1] / missed[np.nonzero(found[:, 1:])[0]]
        assert np.log(chosen).sum() == pytest.approx(best, rel=1e-12)
    crossed = np.array([[10.0, 9.0], [9.0, 0.0]])
    assert marginals(crossed, [1, 1], "nearest").argmax(axis=1).tolist() == [1, 0]
    assert marginals(crossed, [1, 1], "hungarian").argmax(axis=1).tolist() == [2, 1]


def test_larger_clusters_are_approximated():
    """A chain is a tree, where messages are exact; a full cluster of all alike is about right."""
    size = MOST_ENUMERATED + 1
    chain = np.zeros((size, size))
    chain[np.arange(size), np.arange(size)] = 3.0
    chain[np.arange(size - 1), np.arange(1, size)] = 2.0
    found = marginals(chain, np.ones(size))
    # of a chain the sum over maps is a product of 2 x 2 matrices: taken or not by the track before
    forward = [np.array([1.0, 0.0])]
    step = np.array([[1.0 + 3.0, 2.0], [1.0, 2.0]])
    for _ in range(size - 1):
        forward.append(forward[-1] @ step)
    backward = [np.array([1.0 + 3.0, 1.0])]
    for _ in range(size - 1):
        backward.append(step @ backward[-1])
    total = forward[0] @ backward[-1]
    middle = size // 2
    before, after = forward[middle], backward[size - 2 - middle]
    taken_straight = before[0] * 3.0 * after[0] / total
    assert found[middle, 1 + middle] == pytest.approx(taken_straight, rel=1e-8)
    alike = marginals(np.full((size, size), 1.0), np.ones(size))
    np.testing.assert_allclose(alike.sum(axis=1), 1.0, rtol=1e-9)
    # sum over k matched pairs: C(n, k)^2 k! maps
    counts = np.array([1.0])
    for k in range(1, size + 1):
        counts = np.append(counts, counts[-1] * (size - k + 1) ** 2 / k)
    exact = 1.0 - (counts * np.arange(size + 1)).sum() / counts.sum() / size
    np.testing.assert_allclose(alike[:, 0], exact, atol=0.02)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (([[1.0]], [0.0]), "positive"),
        (([[np.nan]], [1.0]), "finite"),
        (([[1.0]], [1.0, 1.0]), "tracks"),
        (([[1.0]], [1.0], "jpad"), "jpda"),
    ],
)
def test_bad_input_is_named(arguments, said):
    with pytest.raises(BadInput, match=said):
        marginals(*arguments)


def test_shared_errors_add_up_as_information_and_every_track_gets_them():
    """The module's formula with any matrices; tracks that are not confirmed or updated say nothing."""
    rng = np.random.default_rng(3)

    def spread(size: int) -> np.ndarray:
        root = rng.normal(size=(size, size))
        return root @ root.T + np.eye(size)

    tracks = no_tracks(1, 4, (1, 5, 5), 1, 100.0 * spread(2))
    tracks.used[:], tracks.shared_mean[:] = 4, rng.normal(size=2)
    tracks.is_confirmed[:] = [[True, False, True, True]]
    tracks.mean[0, :, 0] = rng.normal(size=(4, 5))
    tracks.covariance[0, :, 0] = [spread(5) for _ in range(4)]
    pool = pool_of(2, 5, 4)
    pool.is_updated[:] = [True, True, False, True]
    mean, before = tracks.shared_mean[0].copy(), np.linalg.inv(tracks.shared_covariance[0])
    old, joint = tracks.mean[0, :, 0].copy(), tracks.covariance[0, :, 0].copy()
    information, vector = before.copy(), before @ mean
    for each in (0, 3):
        own = np.linalg.inv(joint[each, 2:4, 2:4])
        information += own - before
        vector += own @ old[each, 2:4] - before @ mean
    pool_errors(0, 2, tracks, pool)
    shared = np.linalg.inv(information)
    assert tracks.shared_mean[0] == pytest.approx(shared @ vector)
    assert tracks.shared_covariance[0] == pytest.approx(shared)
    for place in range(4):
        gain = joint[place][:, 2:4] @ np.linalg.inv(joint[place, 2:4, 2:4])
        told = old[place] + gain @ (shared @ vector - old[place, 2:4])
        assert tracks.mean[0, place, 0] == pytest.approx(told)
        rest = joint[place] + gain @ (shared - joint[place, 2:4, 2:4]) @ gain.T
        assert tracks.covariance[0, place, 0] == pytest.approx(rest)


@pytest.mark.parametrize("first_is_confirmed", [True, False])
@pytest.mark.parametrize("component", range(4))
def test_a_second_track_of_a_target_ends(first_is_confirmed: bool, component: int):
    """Where an older confirmed one is nearer in place and in velocity; at the limit none is."""
    limits = [10.0, 2.0, 10.0, 2.0]  # x_m, vx_mps, y_m, vy_mps
    model = SimpleNamespace(state=("x_m", "vx_mps", "y_m", "vy_mps"))
    tracker = SimpleNamespace(bound_model=SimpleNamespace(model=model), management="existence")
    p = SimpleNamespace(
        same_within_m=10.0, same_within_mps=2.0, ending_existence=0.1, silence_s=1, tentative_silence_s=1
    )
    end_tracks = ending(tracker)
    for sign in (1.0, -1.0):
        for share, is_left in ((0.999, not first_is_confirmed), (1.0, True)):
            tracks = no_tracks(1, 3, (1, 4, 4), 1, np.empty((0, 0)))
            tracks.used[:], tracks.existence[:] = 2, 1.0
            tracks.is_confirmed[0, :2] = first_is_confirmed, True
            tracks.mean[0, 0, 0] = 3.0, 7.0, 70.0, -7.0
            tracks.mean[0, 1] = tracks.mean[0, 0]
            tracks.mean[0, 1, 0, component] += sign * share * limits[component]
            end_tracks(0, tracks, p)
            assert tracks.used[0] == 1 + is_left


@pytest.mark.parametrize("management", MANAGEMENTS)
def test_a_silent_track_ends_after_the_time_of_its_kind(management: str):
    """A confirmed one and a tentative one have times of their own, and are there to the end of them."""
    model = SimpleNamespace(state=("x_m", "y_m"))
    tracker = SimpleNamespace(bound_model=SimpleNamespace(model=model), management=management)
    p = SimpleNamespace(
        silence_s=10.0,
        tentative_silence_s=6.0,
        same_within_m=0.0,
        ending_existence=0.1,
        chances=6,
        false_confirmation=0.01,
        missed_confirmation=0.01,
    )
    end_tracks = ending(tracker)
    for silent_s, left in ((5.9, [1, 2]), (6.1, [1]), (9.9, [1]), (10.1, [])):
        tracks = no_tracks(1, 2, (1, 2, 2), 1, np.empty((0, 0)))
        tracks.used[:], tracks.existence[:] = 2, 1.0
        tracks.number[0], tracks.is_confirmed[0] = (1, 2), (True, False)
        tracks.time_ns[:], tracks.seen_ns[:] = round(silent_s * 1e9), 0
        end_tracks(0, tracks, p)
        assert tracks.number[0, : tracks.used[0]].tolist() == left, silent_s


def test_scans_of_two_sequences_are_merged_with_their_detections_and_keep_their_order_at_equal_stamps():
    rng, made = np.random.default_rng(1), []
    for sensor in (0, 1):
        counts = rng.integers(0, 4, 12)
        ends, numbers = counts.cumsum(), np.arange(12)
        detection = np.stack([np.repeat(numbers, counts), np.full(counts.sum(), sensor)], axis=1)
        same = np.full(12, sensor)
        origin = np.stack([numbers, same], axis=1)
        stamps = np.sort(rng.integers(0, 4, 12))
        made.append(
            Scans(np.array([0, 12]), stamps, same, same, numbers, ends - counts, ends, origin, detection)
        )
    found = in_time(*made)
    order = sorted(
        (int(stamp), sensor, number) for sensor in (0, 1) for number, stamp in enumerate(made[sensor][1])
    )
    of_scans = np.stack([found.time_ns, found.sensor, found.number], axis=1)
    np.testing.assert_array_equal(of_scans, order)
    for (_, sensor, number), first, end, origin in zip(
        order, found.first, found.end, found.origin, strict=True
    ):
        own = made[sensor]
        here = own.detection[own.first[number] : own.end[number]]
        np.testing.assert_array_equal(found.detection[first:end], here)
        np.testing.assert_array_equal(origin, [number, sensor])
    assert list(found.offsets) == [0, 24]
