"""Stress of what is no plain filter: copies that fail, no covariances, random samples, what bends."""

import re
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import fuselog as fl
from fuselog.pipeline.stressing.partings import partings
from fuselog.pipeline.stressing.sums import StressSums
from fuselog.pipeline.stressing.verdicts import Tried
from fuselog.recorders.errors import BadInput
from tests.pipeline.test_stressing import EPOCH_NS, LINE, VECTOR, line


class GainParameters(fl.Parameters):
    """What the estimate follows.

    Attributes:
        gain: one where it is unchanged.
    """

    gain: float = 1.0


def bends(streams: fl.OneRun, parameters: Any) -> fl.Estimates:
    """An estimate in proportion to small changes of its gain; it fails at odd stamps."""
    stamps_ns = streams["seen"].publish_time_ns
    if np.any(stamps_ns % 10**6):
        raise BadInput("a stamp is not one of whole milliseconds")
    change = 100.0 * (parameters.gain - 1.0)
    mean = np.full((len(stamps_ns), 1), change - 0.25 * change**3)
    return fl.Estimates(stamps_ns, mean, np.ones((len(stamps_ns), 1, 1)))


BENDS = fl.batch(
    "an estimate that bends",
    parameters=GainParameters,
    streams={"seen": VECTOR},
    components={"x_m": "linear"},
    solve=fl.each_run(bends),
)


def test_a_copy_that_fails_and_a_change_that_bends() -> None:
    """The half does more than half; a quarter half as much as that."""
    [stressed] = fl.stress(line([0.1, 0.2, 0.3, 0.4]), {"own": {"kind": BENDS}}).stressed
    assert stressed.verdict("parameters") == "sensitive"
    assert stressed.tried["parameters"].largest / stressed.halves["parameters"].largest < 1.7
    assert 1.9 < stressed.ratio("parameters") < 2.1
    half, quarter = re.findall(r"(0\.\d+) of", stressed._shrinking("parameters"))
    assert 0.59 < float(half) < 1.0
    assert 0.47 < float(quarter) < 0.53
    assert stressed.worst == stressed.verdict("stamps") == "discontinuous or chaotic"
    said = "stamps moved by up to 1 us: the copy fails at 4.000 s: a stamp is not one of whole"
    assert said in stressed.sentences[0]
    odd = line([0.1, 0.2])
    seen = odd.streams[1]
    late = replace(seen, publish_time_ns=seen.publish_time_ns + 1)
    with pytest.raises(BadInput, match="a stamp is not one of whole milliseconds"):
        fl.stress(fl.Recording([odd.streams[0], late], epoch_ns=EPOCH_NS), {"own": {"kind": BENDS}})


def test_other_samples_are_no_noise_per_prediction() -> None:
    [stressed] = fl.stress(
        line(list(np.linspace(0.0, 2.0, 6))), {"own": fl.modelled(LINE, "particles:50")}
    ).stressed
    said = " ".join(stressed.sentences)
    assert "a change of the inputs by one ulp changes the covariance: other samples are drawn" in said
    assert "per prediction" not in said


def test_parameters_of_smoothers_are_changed() -> None:
    """Of those that their method shares with another one, and refuses, it is changed without them."""
    [stressed] = fl.stress(line([0.1, 0.2, 0.3]), {"own": fl.modelled(LINE, "smoother:ekf")}).stressed
    assert stressed.tried["parameters"].why == ""
    assert stressed.tried["parameters"].largest > 0.0


def test_without_covariances_metres_are_told() -> None:
    def estimate(x_m: float) -> fl.Stream:
        metadata = {"components": "x_m", "kinds": "linear"}
        return fl.make_stream(
            "/estimates/own/state",
            fl.schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=metadata,
            mean=[[x_m]],
            covariance=[[0.0]],
        )

    one, other = ({"own": estimate(x_m)} for x_m in (0.0, 0.5))
    [parting] = partings(one, other, 0)
    tried = Tried("start", parting)
    assert (tried.far, tried.largest, tried.size) == ("at most 0.5 m", 0.0, 0.5)


def test_estimates_part_by_metres_by_degrees_and_by_sigmas_of_the_first() -> None:
    """3 m and 4 m are 5 m; across +-180 degrees it is 6 degrees; each sigma of the other is 10 % more.

    Sigmas are 1 m, 2 m, 3 degrees and 0.5 of what has no unit: A^2 is the mean of 9, 4, 4 and 4.
    """

    def estimate(stamps_ms: list[int], mean: list[float], larger: float) -> fl.Stream:
        sigmas = larger * np.array([1.0, 2.0, np.radians(3.0), 0.5])
        return fl.make_stream(
            "/estimates/own/state",
            fl.schemas.GAUSSIAN_ESTIMATE,
            np.array(stamps_ms) * 10**6,
            metadata={"components": "x_m,y_m,heading_rad,scale", "kinds": "linear,linear,angle,linear"},
            mean=[[*mean[:2], np.radians(mean[2]), mean[3]]] * len(stamps_ms),
            covariance=[np.diag(sigmas**2).ravel()] * len(stamps_ms),
        )

    one = {"own": estimate([100, 200, 300], [1.0, 2.0, 177.0, 5.0], 1.0)}
    other = {"own": estimate([104, 206, 296], [4.0, 6.0, -177.0, 6.0], 1.1)}
    [parting] = partings(one, other, 5 * 10**6)
    assert (parting.stamps_ns // 10**6).tolist() == [100, 300]
    assert parting.metres == pytest.approx([5.0, 5.0])
    assert parting.degrees == pytest.approx([6.0, 6.0])
    assert parting.amplification == pytest.approx([np.sqrt((9 + 4 + 4 + 4) / 4)] * 2)
    assert parting.spread == pytest.approx(0.1)
    [less] = partings(one, other, 5 * 10**6, has_less=True)
    assert less.explained == pytest.approx([np.sqrt(0.21 * chi2.isf(0.0005, 4) / 4)] * 2)


def test_what_a_change_moves_is_the_mean_over_runs_of_each_case_and_of_all() -> None:
    """Of each metric the change that moves it most counts, whichever way that is."""
    sums = StressSums("ekf")
    runs = (
        {"stamps": {("car", "rmse_m"): 0.3, ("bus", "rmse_m"): 0.1}, "ulp": {("car", "rmse_m"): -0.5}},
        {"stamps": {("car", "rmse_m"): 0.1, ("bus", "rmse_m"): 0.3}, "ulp": {("car", "rmse_m"): -0.7}},
    )
    for run in runs:
        moved = {name: {key: (by, 1) for key, by in of.items()} for name, of in run.items()}
        said = {"harmless": (0.0, ["said"])}
        sums.merge(StressSums("ekf", Counter({"harmless": 1}), said, moved))
    found = sums.summary
    assert found.moved == pytest.approx({"rmse_m": 0.6, "rmse_m.car": 0.6, "rmse_m.bus": 0.2})
    assert found.words == ["ekf over 2 runs: harmless in 2", "said"]
