"""Runs the nodes of a network between events: they predict, measure, send, receive and fuse."""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.families.networks.covariance_intersection import (
    FusionMemory,
    fuse_by,
    fusion_memory,
)
from fuselog.replay.families.networks.estimates import (
    Estimate,
    Fused,
    blend,
    determinant,
    inverted,
    one_of,
)
from fuselog.replay.inference.linear_algebra.gaussian import copy_gaussian, predict_constant_velocity
from fuselog.replay.inference.run.loops import Follow, over_stamps


class Activities(NamedTuple):
    """Holds each moment of a node at which it measures, sends or receives, by run, time and node.

    Run r owns offsets[r]:offsets[r + 1]; activity a uses the measurements from measured[a] to
    measured[a + 1] and the messages from received[a] to received[a + 1]. `message` (m,) is the activity
    in which a message was sent, `may_send` says in which activities a node has a chance to send.
    """

    offsets: Integers
    time_ns: Integers
    node: Integers
    measured: Integers
    received: Integers
    message: Integers
    may_send: Booleans


class Sensing(NamedTuple):
    """Holds measurements in the order of their activities: (k, n), NaN where not measured.

    `variance` (nodes, n) and `density` (nodes,) are the nodes' models.
    """

    value: Floats
    sensor: Integers
    variance: Floats
    density: Floats


class NodeFusion(NamedTuple):
    """Holds the rule's number in `covariance_intersection.RULES`, and how exactly weights are optimised.

    With `own_first` a node fuses its own x*, not its prediction. A message differs by `divergence` nats
    at least from what the last one says, which is `interval_ns` old at least; `gate` is the largest
    squared distance between a prediction and what is heard, infinity where everything is fused. The
    index `faulty_node` is -1 where there is none.
    """

    rule: int
    tolerance: float
    own_first: bool
    interval_ns: int
    divergence: float
    gate: float
    faulty_node: int
    fault_m: float
    fault_after_ns: int


class NodeInputs(NamedTuple):
    """Holds what the nodes go by, all runs; the prior's stamp, mean and covariance are of every run.

    Attributes:
        events: the activities.
        sensing, fusion: what nodes measure, and how they fuse.
        prior_ns, prior_mean, prior_covariance: (runs,), (runs, n), (runs, n, n).
    """

    events: Activities
    sensing: Sensing
    fusion: NodeFusion
    prior_ns: Integers
    prior_mean: Floats
    prior_covariance: Floats


class Nodes(NamedTuple):
    """Holds what the nodes of one run know, first axis = node.

    Attributes:
        time_ns: (nodes,), of their estimates.
        mean, covariance: (nodes, n), (nodes, n, n).
        last_ns, last_mean, last_covariance: of each node's last message; -1 where there is none.
    """

    time_ns: Integers
    mean: Floats
    covariance: Floats
    last_ns: Integers
    last_mean: Floats
    last_covariance: Floats


class NodeMemory(NamedTuple):
    """Holds what one core works in: a run's nodes, and what one of them fuses, weights (most,)."""

    nodes: Nodes
    parts: Estimate
    weights: Floats
    memory: FusionMemory


def node_memory(nodes: int, most: int, states: int) -> NodeMemory:
    """Allocate memory for so many nodes, of which each fuses so many estimates at most."""
    square, many = (nodes, states, states), (most, states, states)
    return NodeMemory(
        Nodes(
            np.empty(nodes, np.int64),
            np.empty((nodes, states)),
            np.empty(square),
            np.empty(nodes, np.int64),
            np.empty((nodes, states)),
            np.empty(square),
        ),
        Estimate(np.empty((most, states)), np.empty(many), np.empty(many)),
        np.empty(most),
        fusion_memory(most, states),
    )


class NodeResults(NamedTuple):
    """Holds a row per activity: the estimates, x* as it is sent, and whether it is.

    `refused` (m,) says of every message that arrived whether the gate kept it out.
    """

    mean: Floats
    covariance: Floats
    sent_mean: Floats
    sent_covariance: Floats
    sent_independent: Floats
    sent: Booleans
    refused: Booleans


def move(mean: Floats, covariance: Floats, density: float, duration_s: float) -> None:
    """Predict with constant velocity, in place.

    Args:
        mean, covariance: (n,), positions in m, then velocities in m/s; (n, n).
        density: power spectral density of the acceleration, in m^2/s^3.
        duration_s: how long.
    """
    predict_constant_velocity(
        mean, covariance, duration_s, (1, len(mean) // 2), noise_moments(density, duration_s)
    )


def observe(
    mean: Floats, covariance: Floats, independent: Floats, value: Floats, variance: Floats
) -> None:
    """Update with what is measured, component by component, in place.

    Args:
        mean, covariance: (n,), (n, n).
        independent: the part of the covariance from measurements since it was zero, (n, n).
        value, variance: (n,), NaN for what is not measured.
    """
    size = len(mean)
    gain, crossed = np.empty(size), np.empty(size)
    for seen in range(size):
        if np.isnan(value[seen]):
            continue
        spread = covariance[seen, seen] + variance[seen]
        error = value[seen] - mean[seen]
        for row in range(size):
            gain[row] = covariance[row, seen] / spread
        at = independent[seen, seen]
        crossed[:] = independent[seen]
        for row in range(size):
            mean[row] += gain[row] * error
            for column in range(size):
                independent[row, column] += (
                    gain[row] * gain[column] * (at + variance[seen])
                    - gain[row] * crossed[column]
                    - crossed[row] * gain[column]
                )
        for row in range(size):
            for column in range(row + 1):
                covariance[row, column] -= gain[row] * gain[column] * spread
                covariance[column, row] = covariance[row, column]


def observe_all(
    activity: int, mean: Floats, covariance: Floats, independent: Floats, inputs: NodeInputs
) -> None:
    """Update with all that a node measures in an activity, see `observe`.

    Args:
        activity: its number.
        mean, covariance, independent: as for `observe`.
        inputs: with the measurements.
    """
    activities, sensing = inputs.events, inputs.sensing
    for k in range(activities.measured[activity], activities.measured[activity + 1]):
        variance = sensing.variance[sensing.sensor[k]]
        observe(mean, covariance, independent, sensing.value[k], variance)


def squared_distance(difference: Floats, covariance: Floats) -> float:
    """Return the squared Mahalanobis distance; infinity where the covariance is singular.

    Args:
        difference, covariance: (n,), (n, n).
    """
    information = np.empty_like(covariance)
    if not inverted(covariance, information):
        return np.inf
    squared = 0.0
    for row in range(len(difference)):
        for column in range(len(difference)):
            squared += difference[row] * information[row, column] * difference[column]
    return squared


def divergence(mean: Floats, covariance: Floats, of_mean: Floats, of_covariance: Floats) -> float:
    """Return the Kullback-Leibler divergence (nats) of a Gaussian from another one, the second.

    Args:
        mean, covariance, of_mean, of_covariance: of the first and the second, (n,), (n, n).
    """
    size = len(mean)
    information, difference = np.empty_like(covariance), np.empty(size)
    if not inverted(of_covariance, information):
        return np.inf
    total = np.log(determinant(of_covariance) / determinant(covariance)) - size
    for row in range(size):
        difference[row] = mean[row] - of_mean[row]
        for column in range(size):
            total += information[row, column] * covariance[row, column]
    return 0.5 * (total + squared_distance(difference, of_covariance))


def agrees(mean: Floats, covariance: Floats, received: Estimate, gate: float) -> bool:
    """Tell whether an estimate may be of the same state, however both are correlated.

    The difference's covariance is at most P_a / w + P_b / (1 - w) for any w; here w is 1 / 2.

    Args:
        mean, covariance, received: both estimates, (n,), (n, n).
        gate: their largest squared distance; infinity lets everything in.
    """
    if gate == np.inf:
        return True
    difference, most = np.empty(len(mean)), np.empty_like(covariance)
    for row in range(len(mean)):
        difference[row] = received.mean[row] - mean[row]
    blend(2.0, covariance, 2.0, received.covariance, most)
    return squared_distance(difference, most) <= gate


def following() -> Follow:
    """Make the loop over the activities of one run, until these end or a fusion fails.

    Returns `follow(run, inputs, failed_ns, results, work)`, which fills in when the run failed.
    """
    go_through = over_stamps(act)

    def follow(
        run: int, inputs: NodeInputs, failed_ns: Integers, results: NodeResults, work: NodeMemory
    ) -> None:
        nodes = work.nodes
        nodes.time_ns[:], nodes.last_ns[:] = inputs.prior_ns[run], -1
        mean, covariance = inputs.prior_mean[run], inputs.prior_covariance[run]
        for node in range(len(nodes.mean)):
            copy_gaussian(mean, covariance, nodes.mean[node], nodes.covariance[node])
        go_through(run, inputs, failed_ns, results, work)

    return follow


def act(
    run: int,
    begin: int,
    end: int,
    inputs: NodeInputs,
    failed_ns: Integers,
    results: NodeResults,
    work: NodeMemory,
) -> bool:
    """Take all nodes through a time: they send first, then take in what they hear; False if they fail.

    Args:
        run: which.
        begin, end: the activities of this time.
        inputs, results, work: what nodes go by, what is filled, what is worked in.
        failed_ns: (runs,), gets the time at which a fusion fails.
    """
    activities, fusion, (nodes, parts, weights, memory) = inputs.events, inputs.fusion, work
    for activity in range(begin, end):
        predict_and_send(activity, inputs.prior_ns[run], inputs, nodes, results)
    for activity in range(begin, end):
        node = activities.node[activity]
        mean, covariance = nodes.mean[node], nodes.covariance[node]
        received = receive(activity, inputs, nodes, parts, results)
        if received > 1:
            into = Fused(mean, covariance, weights)
            gap = fuse_by(fusion.rule, received, parts, into, fusion.tolerance, memory)
            if not gap < np.inf:
                failed_ns[run] = activities.time_ns[begin]
                return False
        # the independent part is of no use any more
        observe_all(activity, mean, covariance, parts.independent[0], inputs)
        copy_gaussian(mean, covariance, results.mean[activity], results.covariance[activity])
    return True


def predict_and_send(
    activity: int, start_ns: int, inputs: NodeInputs, nodes: Nodes, results: NodeResults
) -> None:
    """Predict a node to now, update x* with its own measurements, and send that where it is due."""
    activities, sensing, fusion = inputs.events, inputs.sensing, inputs.fusion
    node, now = activities.node[activity], activities.time_ns[activity]
    if now > nodes.time_ns[node]:
        span_s = (now - nodes.time_ns[node]) * 1e-9
        move(nodes.mean[node], nodes.covariance[node], sensing.density[node], span_s)
        nodes.time_ns[node] = now
    mean, covariance = results.sent_mean[activity], results.sent_covariance[activity]
    copy_gaussian(nodes.mean[node], nodes.covariance[node], mean, covariance)
    independent = results.sent_independent[activity]
    observe_all(activity, mean, covariance, independent, inputs)
    if not activities.may_send[activity]:
        return
    if is_due(node, now, mean, covariance, inputs, nodes):
        results.sent[activity], nodes.last_ns[node] = True, now
        copy_gaussian(mean, covariance, nodes.last_mean[node], nodes.last_covariance[node])
    if node == fusion.faulty_node and now - start_ns >= fusion.fault_after_ns:
        mean[0] += fusion.fault_m


def is_due(
    node: int, now: int, mean: Floats, covariance: Floats, inputs: NodeInputs, nodes: Nodes
) -> bool:
    """Tell whether x* may be sent again, and differs enough from what the last message says of now.

    Args:
        node, now: its number, and the time in ns.
        mean, covariance: x*, (n,), (n, n).
        inputs, nodes: what nodes go by, and what they sent last.
    """
    sensing, fusion = inputs.sensing, inputs.fusion
    if nodes.last_ns[node] < 0:
        return True
    if now - nodes.last_ns[node] < fusion.interval_ns:
        return False
    if fusion.divergence == 0.0:
        return True
    last_mean, last_covariance = nodes.last_mean[node].copy(), nodes.last_covariance[node].copy()
    silent_s = (now - nodes.last_ns[node]) * 1e-9
    move(last_mean, last_covariance, sensing.density[node], silent_s)
    return fusion.divergence <= divergence(mean, covariance, last_mean, last_covariance)


def receive(
    activity: int, inputs: NodeInputs, nodes: Nodes, parts: Estimate, results: NodeResults
) -> int:
    """Fill in what a node fuses, its own estimate first and all as of now; returns how many."""
    activities, sensing, fusion = inputs.events, inputs.sensing, inputs.fusion
    node, now, size = activities.node[activity], activities.time_ns[activity], nodes.mean.shape[1]
    first, end = activities.received[activity], activities.received[activity + 1]
    count = 0
    for i in range(-1, end - first):
        is_own = i < 0
        source = activity if is_own else activities.message[first + i]
        if not is_own and not results.sent[source]:
            continue
        mean, covariance = nodes.mean[node], nodes.covariance[node]
        if not is_own or fusion.own_first:
            mean, covariance = results.sent_mean[source], results.sent_covariance[source]
        copy_gaussian(mean, covariance, parts.mean[count], parts.covariance[count])
        late_s = (now - activities.time_ns[source]) * 1e-9
        # what was new in a late one others may have passed on
        new = 1.0 if not is_own and late_s <= 0.0 else 0.0
        for row in range(size):
            for column in range(size):
                own = results.sent_independent[source, row, column]
                parts.independent[count, row, column] = new * own
        if late_s > 0.0:
            move(parts.mean[count], parts.covariance[count], sensing.density[node], late_s)
        received = one_of(parts, count)
        if is_own or agrees(nodes.mean[node], nodes.covariance[node], received, fusion.gate):
            count += 1
        else:
            results.refused[first + i] = True
    return count
