"""Metrics of studies of networks, samplings, navigation and scores, of made numbers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from fuselog.pipeline.families.biometrics import study as biometrics
from fuselog.pipeline.families.directional import bingham, orientation, torus, torus_real
from fuselog.pipeline.families.networks import cooperative_stress, stress
from fuselog.pipeline.families.ranging.study import Reference, mean_nis
from fuselog.pipeline.families.sampling import extended_target, reactor
from fuselog.pipeline.families.sampling.linearization import REFERENCE
from fuselog.pipeline.families.sampling.lrkf_dimension import RATED, _measure_moments
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.studies.navigation import outages
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from tests.goldens import keeping
from tests.pipeline.test_made_studies import S, names


def test_news_are_beside_intervals_of_equal_bandwidth() -> None:
    """Squared errors fall with the bandwidth, as a power of it; news have a quarter of them."""
    rows = [
        {"policy": policy, "limit": limit, "run": run, "bytes_per_s": bytes_per_s}
        | {"squared_m2": share * (1.0 + run) / bytes_per_s, "estimator": "ci"}
        for policy, limit, bytes_per_s, share in (
            (stress.INTERVAL, 1.0, 100.0, 1.0),
            (stress.INTERVAL, 4.0, 25.0, 1.0),
            (stress.NEWS, 0.5, 50.0, 0.25),
            (stress.NEWS, 9.0, 5.0, 0.25),
        )
        for run in (0, 1)
    ]
    outcome = Outcome()
    stress._measure_economy(pd.DataFrame(rows), outcome)
    assert outcome.metrics == {"ci.rmse_ratio_to_intervals.news-0_5": pytest.approx(0.5)}
    [of_news] = stress.summarised(pd.DataFrame(rows[4:6]), ["policy"]).to_dict("records")
    assert of_news["position_rmse_m"] == pytest.approx((0.25 * 1.5 / 50.0) ** 0.5)


def test_runs_of_a_network_are_of_the_honest_nodes_once_it_has_settled() -> None:
    def node(case: str, scale: float) -> Any:
        error = scale * np.array([[30.0, 40.0], [3.0, 4.0], [6.0, 8.0], [3.0, 4.0]])
        values = {"run": np.array([0, 0, 0, 1]), "elapsed_s": np.array([5.0, 6.0, 7.0, 6.0])}
        return names(
            estimator="ci",
            case=case,
            error=error,
            position=[0, 1],
            nees=scale * np.arange(4.0),
            **values,
        )

    found = stress.of_runs(names(errors=[node("node1", 1.0), node("node2", 9.0)]), 5.0, without=2)
    assert found[["run", "nees", "squared_m2"]].to_numpy().tolist() == [[0, 1.5, 62.5], [1, 3.0, 25.0]]
    links = {"sender_id": [2, 2, 1, 3, 2, 3], "receiver_id": [1, 3, 2, 1, 1, 1]}
    stamps = [4 * S, 5 * S, 6 * S, 6 * S, 7 * S, 8 * S]
    lost = {"arrival_time_ns": stamps, "lost": [0, 0, 0, 0, 0, 1]}
    arrived = make_stream("/links", schemas.LINK_EVENT, stamps, **links, **lost)
    refused = gather([arrived.take([1, 2, 3])])
    source = names(streams={"/links": arrived}, epoch_ns=0)
    replayed = names(sources=[source], outputs={"/estimates/gated/node/refused": refused})
    shares = stress._refused(replayed, names(liar=2, lie_after_s=5.0))  # type: ignore[arg-type]
    assert shares == {"liar_refused": {0: 0.5}, "honest_refused": {0: 1.0}}


def test_robots_send_two_messages_a_sighting() -> None:
    covariance = np.broadcast_to(np.diag([4.0, 9.0, 1.0]), (2, 3, 3))
    error = np.array([[4.0, 3.0, 9.0], [0.0, 5.0, 9.0]])
    errors = names(
        estimator="ci", case="robot2/pose", position=[0, 1], error=error, covariance=covariance
    )
    seen = {
        f"/robot{robot}/range_bearing": {"target_id": np.array(targets)}
        for robot, targets in ((1, [2, 9, 2]), (2, [1, 9, 9]))
    }
    source: Any = names(streams=seen, extent=lambda _: (0, 4 * S))
    [row] = cooperative_stress._rows(names(errors=[errors]), [source], [1, 2]).to_dict("records")
    assert row["robot"] == "robot2"
    assert row["position_rmse_m"] == 5.0
    assert row["position_nees"] == pytest.approx((4.0 + 1.0 + 25.0 / 9.0) / 2.0)
    assert row["bytes_per_s"] == 2 * 3 * cooperative_stress.MESSAGE_BYTES / 4.0 / 2


def test_intervals_of_fused_scores_have_two_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Replicates are ramps: quantiles are their places; impacts are means over subsets of a kind."""
    ramp = np.linspace(0.0, 0.1, 101)[:, None] * np.arange(1, 5)
    fused = names(is_complete=True)
    monkeypatch.setattr(biometrics, "_complete", lambda _: {"/estimates/sum/all/fused": fused})
    monkeypatch.setattr(biometrics, "bootstrap_users", lambda *_: ramp[:, : len(names_of) - 1])
    names_of = ["quantity", *biometrics.FALSE_ACCEPT_RATES, "eer"]
    table = biometrics.confidence_table(names(), 101)
    assert table["quantity"].iloc[-1] == "eer_percent"
    assert set(table["fusion"] + table["case"]) == {"sumall"}
    wanted = np.arange(1, len(table) + 1)
    assert table["low"].tolist() == pytest.approx(0.25 * wanted)
    assert table["high"].tolist() == pytest.approx(9.75 * wanted)
    label = next(iter(biometrics.PAPER_FUSED))
    factors = pd.DataFrame({"subset": biometrics.CASES, "paper_rri": [1.0, 2, 4, 8, 16]})
    impact = biometrics.impact_table(factors.assign(fusion=label, rri=-factors["paper_rri"]))
    found = impact.set_index("fused")[["paper_rri", "rri"]].to_numpy().tolist()
    assert found == [[16.0, -16.0], [1.5, -1.5], [6.0, -6.0]]  # all, one modality, two


def test_winds_are_judged_in_their_second_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turns of .1 rad are learnt and turns of .2 rad foretold, whose density is known."""
    wind = np.cumsum(np.r_[0.0, 0.1 * (-1.0) ** np.arange(9), 0.2 * (-1.0) ** np.arange(10)])
    plain = torus_real.persistence(wind, 10)["persistence"]
    assert plain.log_density[9:] == pytest.approx(norm.logpdf(0.2, scale=0.1), rel=1e-3)
    assert plain.error_rad[9:] == pytest.approx(0.2)
    learnt: list[int] = []
    model = {"coupling_rad": 0.0, "system_sigma_rad": 0.4, "measurement_sigma_rad": 0.2}
    monkeypatch.setattr(torus_real, "most_likely", lambda part, _: learnt.append(len(part)) or model)
    monkeypatch.setattr(torus_real, "held_out", lambda *_: pd.DataFrame())
    monkeypatch.setattr(torus_real, "_judge_fits", lambda *_: None)
    streams = {
        "/wind": make_stream(
            "/wind", schemas.VECTOR_MEASUREMENT, S * np.arange(20), value=wind[:, None]
        ),
        "/dihedrals": make_stream("/dihedrals", schemas.VECTOR_MEASUREMENT, [0], value=[[0.0, 0.0]]),
    }
    source = MemorySource(streams, RunMetadata("made", {}), "made")
    runner = names(obtain=lambda: [source], keep=lambda *_: None)
    monkeypatch.setattr(torus_real, "Runner", lambda *_: runner)
    monkeypatch.setattr(torus_real, "hash_streams", lambda _: "")
    setting: Any = names(options=torus_real.Options(grid_cells=16, block_hours=2))
    outcome = torus_real.study(names(estimators={}), setting)
    keeping.hold_outcome("torus-real", {}, outcome)
    metrics = outcome.metrics
    assert learnt == [10, 10]
    assert metrics["persistence.error_rad.wind"] == pytest.approx(0.2)
    assert metrics["ukf.system_sigma_rad.wind"] == 0.4
    gain = metrics["torus.log_density.wind"] - metrics["persistence.log_density.wind"]
    assert metrics["torus.log_density_gain.persistence"] == pytest.approx(gain)
    nearer = metrics["persistence.error_rad.wind"] - metrics["torus.error_rad.wind"]
    assert metrics["torus.error_gain_rad.persistence"] == pytest.approx(nearer)


def test_moments_of_samplings_by_function() -> None:
    rows = [
        {"dimension": 2, "direction": "all", "function": function, "estimator": label}
        | {
            "mean_error": scale * (1.0 + function),
            "covariance_error": 3.0 * scale,
            "cross_error": scale**2,
        }
        for label, scale in ((RATED, 1.0), ("ukf", 4.0))
        for function in (0, 1)
    ]
    outcome = Outcome()
    _measure_moments(pd.DataFrame(rows), outcome)
    wanted = {f"{RATED}.mean_error": 1.5, f"{RATED}.covariance_error": 3.0, f"{RATED}.cross_error": 1.0}
    wanted |= {"ukf.mean_error": 6.0, "ukf.covariance_error": 12.0, "ukf.cross_error": 16.0}
    wanted |= {"ukf.log_ratio": -np.log(4.0)}
    assert outcome.metrics == pytest.approx({f"{key}.n2-all": value for key, value in wanted.items()})


def ensemble(means: dict[str, np.ndarray], truth: np.ndarray, scale: dict[str, float]) -> Any:
    """Tracks with these means, and covariances of so many units."""
    size = truth.shape[-1]
    tracks = {
        label: names(
            mean=mean,
            covariance=np.broadcast_to(scale[label] * np.eye(size), (*mean.shape, size)),
            failed=place,
        )
        for place, (label, mean) in enumerate(means.items())
    }
    return names(tracks=tracks, truth=truth)


def test_reactors_are_compared_with_exact_moments_by_step_and_seed() -> None:
    """Two runs of twelve steps, off by the step; the UKF by 6 in all."""
    zero, steps = np.zeros((2, 12, 2)), np.arange(1.0, 13.0)[None, :, None]
    means = {REFERENCE: zero, "x": zero + steps * [0.6, 0.8], "ukf": zero + np.array([3.6, 4.8])}
    made = ensemble(means, zero + np.array([0.0, 1.0]), {REFERENCE: 2.0, "x": 3.0, "ukf": 1.0})
    tables = [reactor.step_errors(made).assign(seed=seed) for seed in (0, 1)]
    tables[1]["mean_rmse"] *= 3.0
    metrics = reactor.metrics(pd.concat(tables), "printed")
    for name, value in {
        "x.mean_rmse": 13.0,
        "x.mean_rmse_by_seed": [6.5, 19.5],
        "x.covariance_rmse": 2.0**0.5,
        "x.variance_ratio": 1.5,
        "ukf.variance_ratio": 0.5,
        "x.early_mean_rmse": 6.0,
        "x.late_mean_rmse": 20.0,
        "x.share_above_ukf": 0.5,
        "x.failed_runs": 2.0,
        f"{REFERENCE}.truth_rmse": 1.0,
        "ukf.truth_rmse": np.hypot(3.6, 3.8),
    }.items():
        assert metrics[f"{name}.printed"] == pytest.approx(value), name
    record = names(scenario="reactor", parameters={"prior_mean": (0.2, 3.0)})
    copied: Any = names(record=record, model_copy=lambda update: update["record"].parameters)
    assert reactor._in_case(copied, "printed") == {"prior_mean": (0.2, 3.0)}  # type: ignore[comparison-overlap]
    assert reactor._in_case(copied, "swapped") == {"prior_mean": (3.0, 0.2)}  # type: ignore[comparison-overlap]


def test_extended_targets_have_areas_with_signs() -> None:
    """Half sides of 1 and 2 m are 8 m2; one of two runs has a negative side."""
    exact = np.tile([1.0, 2.0, 0.0, 0.0], (2, 1, 1))
    own = np.array([[[1.0, 3.0, 3.0, 4.0]], [[-1.0, 2.0, 0.0, 0.0]]])
    truth = exact + np.array([0.0, 0.0, 0.0, 2.0])
    made = ensemble({REFERENCE: exact, "x": own}, truth, {REFERENCE: 1.0, "x": 1.0})
    row = extended_target.step_errors(made).to_dict("records")[1]
    for name, value in {
        "area_rmse_m2": ((4.0**2 + 16.0**2) / 2) ** 0.5,
        "size_rmse_m2": 8.0**0.5,
        "position_rmse_m": 12.5**0.5,
        "area_truth_rmse_m2": ((4.0**2 + 16.0**2) / 2) ** 0.5,
        "position_truth_rmse_m": ((9.0 + 4.0 + 4.0) / 2) ** 0.5,
        "median_area_m2": 2.0,
        "flipped_runs": 1,
        "failed_runs": 1,
    }.items():
        assert row[name] == pytest.approx(value), name
    first = extended_target.KEY_STEPS[0]
    tables = [pd.DataFrame([{**row, "step": first, "area_rmse_m2": 10.0 * seed}]) for seed in (1, 2)]
    metrics = extended_target.metrics(extended_target.by_key_step(pd.concat(tables)))
    assert metrics[f"x.area_rmse_m2.step-{first}"] == 15.0
    assert metrics[f"x.flipped_runs.step-{first}"] == 2.0


def test_axes_err_by_the_angle_and_orientations_by_half_of_it() -> None:
    errors = names(
        estimator="e", step=np.array([0, 1]), run=np.array([0, 0]), error=np.array([[0.3], [0.4]])
    )
    for dimension, share in ((2, 1.0), (4, 0.5)):
        stated: Any = names(dimension=lambda dimension=dimension: dimension)
        found = bingham._errors_deg(
            names(errors=[errors], sources=[0]), stated, names(), "gaussian-noise"
        )
        assert found["e"] == pytest.approx([share * np.degrees(0.125**0.5)])


def test_samples_on_the_torus_err_in_mean_and_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = torus.MomentErrors(
        np.array([[1.0, 3.0], [3.0, 7.0]]), np.array([[10.0, 30.0], [30.0, 50.0]])
    )
    monkeypatch.setattr(torus, "propagation_errors", lambda *_: {"five": errors})
    options = torus.PropagationOptions(couplings_rad=[0.02], correlations=[0.1, 0.9])
    setting: Any = names(options=options, progress=lambda items, *_: items)
    stated: Any = names(record=None, import_=None, estimators={}, runs=2, seed=1)
    outcome = torus.study_propagation(stated, setting)
    assert outcome.metrics == {
        "five.mean_error_rad.c=20-mrad": 3.5,
        "five.covariance_error_rad2.c=20-mrad": 30.0,
        "five.mean_errors_by_correlation.c=20-mrad": [2.0, 5.0],
        "five.covariance_errors_by_correlation.c=20-mrad": [20.0, 40.0],
    }
    rows = outcome.tables["errors"].to_numpy().tolist()
    assert rows == [[0.02, "five", 0.1, 2.0, 20.0], [0.02, "five", 0.9, 5.0, 40.0]]


def test_ranges_are_judged_within_a_span() -> None:
    """The truth is a line between stamps; both ends of the span count."""
    time_ns = S * np.arange(5)
    assert Reference(time_ns, np.outer([0.0, 2, 4, 6, 8], [1, 5])).at(
        np.array([S // 2, 3 * S])
    ).tolist() == [[1.0, 5.0], [6.0, 30.0]]
    squared = np.array([1000.0, 1.0, 4.0, 7.0, 1000.0])
    innovations: Any = names(publish_time_ns=time_ns)
    innovations = type("Rows", (dict,), vars(innovations))(normalised_innovation_squared=squared)
    assert mean_nis(innovations, S, 3 * S) == 4.0


def test_an_outage_is_withheld_and_estimates_are_judged_in_it() -> None:
    """Rows of every second, withheld from 3 s to 5 s, where estimates are 3 and 4 m off in the plane."""
    time_ns, place = 10 * S + S * np.arange(10), np.outer(np.arange(10.0), [1.0, 2.0])
    rows = outages.Rows(time_ns, place, np.ones((10, 2)))
    window = outages.Window(2.0, 3.0, np.array([3, 4]))
    kept = {"covariance_m2": np.ones((10, 3)), "position_m": np.zeros((10, 3))}
    fix = make_stream(outages.FIX, schemas.POSITION_FIX, time_ns, **kept)
    streams = {topic: replace(fix, topic=topic) for topic in (outages.FIX, outages.VELOCITY)}
    source = MemorySource(streams, RunMetadata("made", {}), "made")
    left = outages.withheld(source, rows, [window]).streams
    for topic in streams:
        assert ((left[topic].log_time_ns - time_ns[0]) // S).tolist() == [0, 1, 2, 5, 6, 7, 8, 9]
    told = left[f"{outages.FIX}/outages"]
    assert told.publish_time_ns.tolist() == [13 * S]
    assert told["end_time_ns"].tolist() == [15 * S]
    mean = np.stack([place[:, 1] + 4.0, np.full(10, 99.0), place[:, 0] + 3.0], axis=1)
    states = make_stream(
        "/state",
        schemas.GAUSSIAN_ESTIMATE,
        time_ns,
        metadata={"components": "y_m,z_m,x_m", "kinds": "linear,linear,linear"},
        mean=mean,
        covariance=np.tile(np.diag([16.0, 1.0, 9.0]).ravel(), (10, 1)),
    )
    error, nees = outages.estimated(rows, window, states)
    assert error.tolist() == [[3.0, 4.0], [3.0, 4.0]]
    assert nees == pytest.approx(2.0)
    table = outages.error_table(rows, [[window]], {"/estimates/ekf/state": gather([states])}, ["ekf"])
    assert table["since_s"].tolist() == [0.0, 1.0] * 3
    by_length = outages.length_table(outages.window_table(table)).set_index("estimator").loc["ekf"]
    assert by_length.tolist() == pytest.approx([2.0, 1, 5.0, 5.0, 5.0, 2.0])


def test_orientations_are_compared_trial_by_trial() -> None:
    rows = [
        {"trial": trial, "case": case, "estimator": label, "total_deg": total}
        for trial, more in (("01_undisturbed_slow", 0.0), ("02_disturbed_fast", 1.0))
        for case, magnet in ((orientation.AS_RECORDED, 0.0), (orientation.WITH_MAGNET, 3.0))
        for label, total in (("own", 1.0 + magnet), ("other", 3.0 + more + 2.0 * magnet))
    ]
    table = pd.DataFrame(rows).assign(heading_deg=0.0, inclination_deg=1.0)
    outcome = Outcome()
    orientation._compare(table, "own", outcome)
    assert outcome.metrics == {"other.excess_deg.all": 2.5, "other.excess_deg.magnet-added": 5.5} | {
        "own.cost_deg.magnet-added": 3.0
    }
    kinds = orientation.by_kind(table).set_index(["kind", "estimator"])["total_deg"]
    assert kinds["all", "other"] == 3.5
    assert kinds["slow", "other"] == kinds["undisturbed", "other"] == 3.0
    assert kinds["disturbed", "other"] == kinds["fast", "other"] == 4.0
    row, known = orientation.same_stamps(np.array([1, 3, 5]), np.array([0, 1, 4, 5, 9]))
    assert known.tolist() == [False, True, False, True, False]
    assert row[known].tolist() == [0, 2]
    spans = [
        ("01_undisturbed_slow", orientation.AS_RECORDED, "own", 1.0, 1.5),
        ("01_undisturbed_slow", orientation.AS_RECORDED, "other", 1.0, 9.0),
        ("02_disturbed_fast", orientation.AS_RECORDED, "own", 1.0, 7.0),
        ("01_undisturbed_slow", orientation.WITH_MAGNET, "own", 4.2, 6.1),
        ("01_undisturbed_slow", orientation.WITH_MAGNET, "own", 0.0, 6.0),
    ]
    found = pd.DataFrame(spans, columns=["trial", "case", "estimator", "begin_s", "end_s"])
    sources = {
        name: names(streams={f"/{name}/inertial": names(publish_time_ns=S * np.arange(21))})
        for name in ("01_undisturbed_slow", "02_disturbed_fast")
    }
    options: Any = names(estimator="own", magnet_s=[(4.0, 6.0)])
    outcome = Outcome()
    orientation._measure_disturbances(found, sources, options, outcome)  # type: ignore[arg-type]
    assert outcome.metrics["own.falsely_disturbed_s"] == 0.5
    assert outcome.metrics["own.undisturbed_s"] == pytest.approx(20.0)
    assert outcome.metrics["own.magnet_noticed_late_s"] == [pytest.approx(0.2)]
