"""Score matrices are read whole or refused with a sentence; simulated scores are like the real ones."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.biometrics.importer import Matchers, ScoreMatricesParameters, read
from fuselog.recorders.families.biometrics.models import comparisons_of
from fuselog.recorders.families.biometrics.simulator import FAILURE, GENUINE_SCORES, C, G, R
from fuselog.recorders.parameters import build
from fuselog.recorders.recording import record_run
from fuselog.replay.families.biometrics.verification import identified

pytestmark = pytest.mark.paper

TWO = Matchers.model_validate(
    {"matchers": [{"name": "face", "modality": "face"}, {"name": "finger", "modality": "finger"}]}
).matchers
PARAMETERS = ScoreMatricesParameters(matchers=TWO)


def write(folder, name, scores, probes=None, gallery=None):
    """A matrix file as published."""
    gallery = gallery or [f"u{user}" for user in range(len(scores))]
    rows = [",".join(["", *gallery])]
    rows += [
        ",".join([probe, *map(str, row)]) for probe, row in zip(probes or gallery, scores, strict=True)
    ]
    (folder / f"{name}.csv").write_text("\n".join(rows))


@pytest.fixture
def folder(tmp_path):
    for name in ("face", "finger"):
        write(tmp_path, name, np.eye(3) + 0.1)
    return tmp_path


def test_matrices_become_score_vectors_of_every_pair(folder):
    """Rows are probes and columns the gallery: a transposed import would swap them."""
    scores = np.eye(3) + np.arange(9).reshape(3, 3) / 100
    write(folder, "finger", scores)
    (stream,) = read(folder, PARAMETERS).streams
    compared = comparisons_of(stream)
    np.testing.assert_array_equal(compared.scores[:, :, 1], scores)
    assert stream["scores"].shape == (9, 2)
    assert np.all(np.diff(compared.arrival_ns) == 1_000_000_000)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"scores": np.eye(4)}, "4 users, not the 3"),
        ({"scores": np.eye(3)[:, :2], "probes": ["u0", "u1", "u2"], "gallery": ["u0", "u1"]}, "square"),
        ({"scores": np.eye(3), "gallery": ["u0", "u1", "x"]}, "same users"),
        ({"scores": np.eye(3), "probes": ["u1", "u0", "u2"]}, "rows and columns"),
        ({"scores": [[1, 0, 0], [0, "one", 0], [0, 0, 1]]}, "probe 2, gallery entry 2 is 'one'"),
        ({"scores": np.ones((3, 3))}, "all scores are equal"),
        ({"scores": 1 - np.eye(3)}, 'declare score = "distance"'),
    ],
)
def test_bad_matrices_are_refused_with_the_file_and_the_mend(folder, changed, sentence):
    write(folder, "finger", **changed)
    with pytest.raises(BadInput, match=r"finger\.csv") as error:
        read(folder, PARAMETERS)
    assert sentence in str(error.value)


def test_a_declared_distance_is_negated_for_fusion_and_stays_as_it_was_in_the_log(folder):
    write(folder, "finger", 1 - np.eye(3))
    matchers = [TWO[0], TWO[1].model_copy(update={"score": "distance"})]
    (stream,) = read(folder, ScoreMatricesParameters(matchers=matchers)).streams
    assert stream["scores"][0, 1] == 0.0
    assert comparisons_of(stream).scores[0, 1, 1] == -1.0
    write(folder, "finger", np.eye(3))
    declared = 'as distance, but .* are higher than those of others; declare score = "similarity"$'
    with pytest.raises(BadInput, match=declared):
        read(folder, ScoreMatricesParameters(matchers=matchers))


def test_matchers_are_named_in_the_folder_where_the_parameters_name_none(folder):
    with pytest.raises(BadInput, match=r"matchers\.toml: no such file"):
        read(folder, ScoreMatricesParameters())
    (folder / "matchers.toml").write_text('[[matchers]]\nname = "face"\nmodality = "face"\n')
    assert len(read(folder, ScoreMatricesParameters()).streams[0]["scores"][0]) == 1


@pytest.mark.parametrize("names", [("face", "face"), ("face", "../finger"), ("face", "left,right")])
def test_matchers_have_names_of_their_own_that_files_topics_and_lists_can_hold(names):
    matchers = [{"name": name, "modality": "face"} for name in names]
    with pytest.raises(BadInput, match="name"):
        build(ScoreMatricesParameters, {"matchers": matchers}, "x")


def test_a_missing_pair_is_refused(folder):
    (stream,) = read(folder, PARAMETERS).streams
    with pytest.raises(BadInput, match="8 score vectors"):
        comparisons_of(stream.take(slice(0, 8)))


def test_simulated_scores_identify_as_many_users_as_the_real_ones():
    """The sheet's mean and 4 standard deviations of 10 runs. Tables are easily mistyped."""
    recording, _ = record_run("biometric-scores", {}, 3)
    compared = comparisons_of(recording.streams[0])
    found = [identified(compared.scores[:, :, matcher]) for matcher in range(4)]
    assert np.all(np.abs(np.subtract(found, (450, 429, 446, 480))) <= 4 * np.array([8, 10, 8, 5]))


def test_a_user_is_another_as_a_probe_than_as_a_gallery_entry():
    """Of matcher G the two effects correlate by .13; every mean over 300 others is one of them."""
    settings = {"users": 300, "low_galleries": 0, "broken_probes": 0}
    scores = comparisons_of(record_run("biometric-scores", settings, 2)[0].streams[0]).scores[:, :, G]
    others = np.where(np.eye(300, dtype=bool), np.nan, scores)
    as_probe, as_gallery = np.nanmean(others, axis=1), np.nanmean(others, axis=0)
    assert abs(np.corrcoef(as_probe, as_gallery)[0, 1] - 0.13) < 4 / np.sqrt(300)
    assert as_probe.std() > 1.3 * as_gallery.std()


def test_simulated_special_users_and_marginals():
    """One failed enrolment; poor fingers are made up for, so that the genuine marginals hold."""
    settings = {"users": 400, "broken_probes": 0, "poor_fingers_share": 0.05}
    genuine = []
    for run in range(3):
        compared = comparisons_of(record_run("biometric-scores", settings, 1, run)[0].streams[0])
        failed = compared.failed[:, :, C]
        assert np.count_nonzero(failed.all(axis=0)) == np.count_nonzero(failed.any(axis=0)) == 1
        assert np.all(compared.scores[:, :, C][failed] == FAILURE)
        genuine.append(np.diagonal(compared.scores[:, :, R]))
    below_median = np.mean(np.concatenate(genuine) < GENUINE_SCORES[R][9])
    assert abs(below_median - 0.5) < 4 * 0.5 / np.sqrt(1200)
