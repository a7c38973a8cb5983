"""Networks of nodes: the room of the covariance-intersection sheet, and what can go wrong on links."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.families.networks.covariance_intersection import RULES
from fuselog.replay.families.networks.estimator import ALONE, CENTRALISED, TRAP, Rule

pytestmark = pytest.mark.paper

RUNS = 60


def judged(sources, rule, settle_s=1.0):
    """Per node: RMSE of the position, mean NEES, after the first second."""
    errors = replay_ensemble(sources, {rule: {"kind": f"network:{rule}"}}, gap_limit_s=0.2).errors
    kept = [each.elapsed_s > settle_s + 1e-9 for each in errors]
    rmse = [
        np.sqrt(np.mean(np.sum(e.error[k][:, :2] ** 2, axis=1)))
        for e, k in zip(errors, kept, strict=True)
    ]
    return np.array(rmse), np.array([e.nees[k].mean() for e, k in zip(errors, kept, strict=True)])


def ensemble(runs=RUNS, **parameters):
    return record_ensemble("ispace", parameters, 3, runs)


@pytest.fixture(scope="module")
def room():
    return ensemble()


@pytest.fixture(scope="module")
def centralised_rmse_m(room):
    rmse, nees = judged(room, "centralised")
    assert rmse[0] == pytest.approx(0.0322, rel=0.06)
    assert nees[0] == pytest.approx(4.0, abs=0.25)
    return rmse[0]


@pytest.mark.parametrize(
    ("rule", "ratio", "low", "high"),
    [
        ("ci-trace", 1.075, 3.6, 4.4),
        ("ci-determinant", 1.076, 3.6, 4.4),
        ("niehsen", 1.088, 2.8, 3.5),
        ("franken", 1.094, 2.7, 3.5),
        ("split-ci", 1.063, 3.6, 4.4),
        ("inverse-ci", 1.073, 3.6, 4.4),
        ("own-again", 1.165, 5.3, 6.4),
    ],
)
def test_the_room(room, centralised_rmse_m, rule, ratio, low, high):
    """Ratio of the RMSE and NEES of every node about the sheet's."""
    rmse, nees = judged(room, rule)
    assert rmse.mean() / centralised_rmse_m == pytest.approx(ratio, abs=0.03)
    assert np.all((low < nees) & (nees < high))


def test_nodes_alone_in_the_room(room, centralised_rmse_m):
    """Without the others four sensors differ much, and scatter more."""
    rmse, nees = judged(room, "alone")
    assert rmse[0] == pytest.approx(0.0359, rel=0.06)
    assert rmse.mean() / centralised_rmse_m == pytest.approx(4.83, rel=0.08)
    assert np.all((nees > 3.7) & (nees < 4.3))


def test_naive_fusion_is_inconsistent(room, centralised_rmse_m):
    rmse, nees = judged(room, "naive")
    assert np.all(nees > 1000)
    assert rmse.mean() > 10 * centralised_rmse_m


def test_what_stands_in_the_log_is_enough_for_ci_at_high_loss():
    sources = ensemble(loss_probability=0.9)
    assert np.all(np.abs(judged(sources, "ci-trace")[1] - 3.95) < 0.4)
    assert 10 < judged(sources, "naive")[1].mean() < 60


def test_without_links_every_rule_is_the_node_alone():
    """A disconnected graph: nothing arrives, and nothing may change."""
    sources = ensemble(3, links=())
    alone = replay_ensemble(sources, {"a": {"kind": "network:alone"}}, gap_limit_s=0.2).errors
    fused = replay_ensemble(sources, {"a": {"kind": "network:ci-trace"}}, gap_limit_s=0.2).errors
    assert all(np.array_equal(a.error, b.error) for a, b in zip(alone, fused, strict=True))


def test_late_and_duplicate_messages_leave_ci_consistent_and_are_predicted_forward():
    sources = ensemble(60, delay_s=0.15, delay_jitter_s=0.1, duplicate_probability=0.3)
    rmse, nees = judged(sources, "ci-trace")
    assert np.all(nees < 4.6)
    assert rmse.mean() < 0.5 * judged(sources, "alone")[0].mean()


def test_a_message_that_arrives_twice_counts_once_for_ci():
    """Every message doubled: what is fused stays, but for the tolerance of the weights."""
    once, twice = (ensemble(3, duplicate_probability=share) for share in (0.0, 1.0))
    assert len(twice[0].streams["/links"]) == 2 * len(once[0].streams["/links"])
    errors = [
        replay_ensemble(each, {"ci": {"kind": "network:ci-trace"}}, gap_limit_s=0.2).errors
        for each in (once, twice)
    ]
    for single, double in zip(*errors, strict=True):
        sigma = np.sqrt(single.covariance[:, 0, 0])
        assert np.all(np.abs(single.error[:, 0] - double.error[:, 0]) < 0.2 * sigma)
        np.testing.assert_allclose(double.covariance[:, 0, 0], single.covariance[:, 0, 0], rtol=0.1)


def test_a_node_that_is_lost_and_rejoins_recovers():
    outage = [{"node": 4, "start_s": 2.0, "end_s": 6.0}]
    sources = ensemble(60, outages=outage)
    errors = replay_ensemble(sources, {"ci": {"kind": "network:ci-trace"}}, gap_limit_s=0.2).errors
    back = errors[3].elapsed_s > 7.0
    out = (errors[3].elapsed_s > 2.05) & (errors[3].elapsed_s < 5.95)
    assert not out.any()
    assert np.sqrt(np.mean(errors[3].error[back, :2] ** 2)) < 0.04
    assert errors[3].nees[back].mean() < 4.8


def test_nodes_with_sensors_of_their_own():
    """A node that measures velocities only is told where the thing is by the others."""
    nodes = [
        {"sigmas": [0.05, 0.05]},
        {"components": ["vx_mps", "vy_mps"], "sigmas": [0.05, 0.05], "every_steps": 2},
    ]
    sources = ensemble(60, nodes=nodes, links=[[1, 2]])
    rmse, nees = judged(sources, "ci-trace")
    assert rmse[1] < 0.06
    assert np.all(nees < 4.5)


def test_ensemble_and_single_runs_are_equal_bit_for_bit(room):
    bound = bind("ci", room[:3], {"kind": "network:ci-trace"})
    many = collect(replay(room[:3], bound))
    one = collect(replay(room[1:2], bind("ci", room[1:2], {"kind": "network:ci-trace"})))
    for topic, ragged in many.items():
        part, single = ragged.of_run(1), one[topic].of_run(0)
        assert all(np.array_equal(part.columns[k], single.columns[k]) for k in single.columns)


def test_a_large_random_network_with_cycles_stays_consistent():
    """100 nodes, 20 % loss, 100 steps; duplicates and delays in the shipped scenario's measure."""
    parameters = {"random_nodes": 100, "random_chords": 100, "delay_jitter_s": 0.05}
    source = memory_source(*record_run("ispace", parameters, 1))
    _, nees = judged([source], "ci-trace")
    assert len(nees) == 100
    assert nees.mean() < 4.6  # one run: all nodes share one truth; 3.4 +- 0.4 over runs


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"links": [[1, 9]]}, "node 9"),
        ({"links": [[2, 2]]}, "itself"),
        ({"nodes": [{"components": ["z_m"], "sigmas": [1.0]}], "links": []}, "components"),
    ],
)
def test_bad_networks_are_refused(parameters, said):
    with pytest.raises(BadInput, match=said):
        record_run("ispace", parameters, 1)


def test_every_fusion_rule_has_its_name_and_no_other_is_known(room):
    assert set(get_args(Rule)) == {*RULES, ALONE, CENTRALISED, TRAP}
    with pytest.raises(BadInput, match="split-ci"):
        bind("network:best", room, {})


def with_prior(source, **columns):
    prior = source.streams["/prior"]
    changed = replace(prior, columns={**prior.columns, **columns})
    return replace(source, streams={**source.streams, "/prior": changed})


def test_a_singular_prior_is_refused(room):
    singular = np.diag([1.0, 1.0, 0.0, 1.0]).reshape(1, 16)
    with pytest.raises(BadInput, match="not positive definite"):
        judged([with_prior(room[0], covariance=singular)], "ci-trace")


def test_a_covariance_that_is_singular_to_working_precision_fails_its_run_only(room):
    """A run whose prior is nearly flat; the others are as without it."""
    flat = np.diag([1e20, 1e-20, 1e20, 1e-20]).reshape(1, 16)
    sources = [room[0], with_prior(room[1], covariance=flat), room[2]]
    outputs = collect(replay(sources, bind("network:ci-trace", sources, {})))
    failed = outputs["/estimates/network:ci-trace/failure"]
    assert [len(failed.of_run(run)) for run in range(3)] == [0, 1, 0]
    alone = collect(replay(room[:1], bind("network:ci-trace", room[:1], {})))
    topic = "/estimates/network:ci-trace/node1/state"
    assert np.array_equal(outputs[topic].of_run(0)["mean"], alone[topic].of_run(0)["mean"])
