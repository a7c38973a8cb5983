"""Nodes that send seldom, refuse what they hear, or lie: a room of a few steps."""

import numpy as np
import pytest
from scipy.stats import chi2

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.replay.families.networks.estimates import Estimate
from fuselog.replay.families.networks.nodes import agrees, divergence

RULE = {"kind": "network:ci-trace"}


@pytest.fixture(scope="module")
def room():
    return record_ensemble("ispace", {"steps": 20}, 3, 1)


def replayed(room, **estimators):
    settings = {name: {**RULE, **values} for name, values in estimators.items()}
    return replay_ensemble(room, settings, gap_limit_s=0.2)


def stamps_s(found, name, node=1):
    sent = found.outputs[f"/estimates/{name}/node{node}/sent"].stream
    return (sent.publish_time_ns - found.sources[0].epoch_ns) * 1e-9


def test_divergence_is_that_of_kullback_and_leibler():
    rng = np.random.default_rng(0)
    means, factors = rng.normal(size=(2, 4)), rng.normal(size=(2, 4, 6))
    one, other = factors @ np.swapaxes(factors, 1, 2)
    inverse, away = np.linalg.inv(other), means[1] - means[0]
    expected = np.trace(inverse @ one) + away @ inverse @ away - 4
    expected += np.log(np.linalg.det(other) / np.linalg.det(one))
    assert divergence(means[0], one, means[1], other) == pytest.approx(0.5 * expected)
    assert divergence(means[0], one, means[0], one) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 1.0])
def test_the_gate_keeps_honest_estimates_however_they_are_correlated(correlation):
    """Errors that are opposite make the largest difference: then the bound is met with equality."""
    gate, count = float(chi2.ppf(0.9, 2)), 600
    rng = np.random.default_rng(1)
    first, fresh = rng.normal(size=(2, count, 2))
    second = correlation * first + np.sqrt(1.0 - correlation**2) * fresh
    unit = np.eye(2)
    passed = [agrees(a, unit, Estimate(b, unit, unit), gate) for a, b in zip(first, second, strict=True)]
    share = np.mean(passed)
    assert share >= 0.9 - 2 * np.sqrt(0.09 / count)
    if correlation == -1.0:
        assert share <= 0.9 + 2 * np.sqrt(0.09 / count)
    assert not agrees(np.zeros(2), unit, Estimate(np.array([20.0, 0.0]), unit, unit), gate)


@pytest.mark.paper
def test_nodes_send_no_more_often_than_they_may(room):
    found = replayed(room, always={}, seldom={"send_interval_s": 0.5}, news={"send_divergence": 1.0})
    assert len(stamps_s(found, "always")) == 20
    assert np.diff(stamps_s(found, "seldom")) == pytest.approx(0.5, abs=1e-6)
    assert 1 <= len(stamps_s(found, "news")) < 15
    # a message that is not sent is not heard: without any, a node is alone
    alone = replay_ensemble(
        room,
        {"alone": {"kind": "network:alone"}, "silent": {**RULE, "send_divergence": 1e9}},
        gap_limit_s=0.2,
    )
    last = [alone.outputs[f"/estimates/{name}/node3/state"]["mean"][-1] for name in ("alone", "silent")]
    heard = found.outputs["/estimates/always/node3/state"]["mean"][-1]
    # what they do send is the first message, of the first step
    assert np.linalg.norm(last[0] - last[1]) < np.linalg.norm(last[0] - heard)


@pytest.mark.paper
def test_a_liar_is_believed_without_a_gate_and_refused_with_one(room):
    lying = {"liar": 2, "lie_m": 3.0, "lie_after_s": 1.0}
    found = replayed(room, honest={}, misled=lying, gated={**lying, "gate_probability": 0.999})
    squared = {
        name: np.mean(
            [np.mean(each.error[-5:, 0] ** 2) for each in found.errors if each.estimator == name]
        )
        for name in ("honest", "misled", "gated")
    }
    assert squared["misled"] > 20 * squared["honest"]
    assert squared["gated"] < 2 * squared["honest"]
    refused = found.outputs["/estimates/gated/refused"].stream
    assert (refused["sender_id"] == 2).mean() > 0.45  # the liar refuses the others in its turn
    assert refused.publish_time_ns.min() >= found.sources[0].epoch_ns + 1e9
    # the lie is in what is sent, from its beginning on
    states = [found.outputs[f"/estimates/misled/node2/{leaf}"].stream for leaf in ("sent", "state")]
    away = states[0]["mean"][:, 0] - states[1]["mean"][:, 0]
    early = (states[0].publish_time_ns - found.sources[0].epoch_ns) < 0.95e9
    assert np.abs(away[early]).max() < 1.0 < 2.0 < np.median(away[~early])


def test_a_liar_that_is_no_node_is_refused(room):
    with pytest.raises(BadInput, match="liar = 9 is not one of the nodes 1, 2, 3, 4"):
        replayed(room, ci={"liar": 9})
