"""Nodes of a network, which predict, measure, send, receive and fuse."""

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
    """Activities of nodes (measuring, sending or receiving), ordered by run, time and node.

    Activities offsets[r]:offsets[r + 1] belong to run r. Activity a uses the measurements
    measured[a]:measured[a + 1] and the messages received[a]:received[a + 1]. `message` (m,) is the
    activity in which a message was sent; `may_send` marks the activities in which a node may send.
    """

    offsets: Integers
    time_ns: Integers
    node: Integers
    measured: Integers
    received: Integers
    message: Integers
    may_send: Booleans


class Sensing(NamedTuple):
    """Measurements (k, n) in the order of their activities, NaN if not measured.

    `variance` (nodes, n) and `density` (nodes,) describe the noise of each node's model.
    """

    value: Floats
    sensor: Integers
    variance: Floats
    density: Floats


class NodeFusion(NamedTuple):
    """Number of the rule in `covariance_intersection.RULES`, and conditions for sending and accepting.

    If `own_first`, a node fuses its own x* instead of its prediction. A node sends a message if its
    estimate differs by at least `divergence` nats from the prediction of its last message, which must be
    at least `interval_ns` old. `gate` is the largest squared distance between a prediction and a
    received estimate; it is infinite if all estimates are accepted. `faulty_node` is an index, or -1 if
    no node is faulty.
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
    """Inputs of the nodes in all runs.

    Attributes:
        events: the activities.
        sensing, fusion: the measurements of the nodes, and their rule of fusion.
        prior_ns, prior_mean, prior_covariance: (runs,), (runs, n), (runs, n, n), the prior of each run.
    """

    events: Activities
    sensing: Sensing
    fusion: NodeFusion
    prior_ns: Integers
    prior_mean: Floats
    prior_covariance: Floats


class Nodes(NamedTuple):
    """Estimates of the nodes of one run; the first axis is the node.

    Attributes:
        time_ns: stamps of the estimates, (nodes,).
        mean, covariance: (nodes, n), (nodes, n, n).
        last_ns, last_mean, last_covariance: stamp, mean and covariance of each node's last message; the
            stamp is -1 before the first message.
    """

    time_ns: Integers
    mean: Floats
    covariance: Floats
    last_ns: Integers
    last_mean: Floats
    last_covariance: Floats


class NodeMemory(NamedTuple):
    """Scratch memory of one CPU core: nodes of a run, estimates to fuse, and their weights (most,)."""

    nodes: Nodes
    parts: Estimate
    weights: Floats
    memory: FusionMemory


def node_memory(nodes: int, most: int, states: int) -> NodeMemory:
    """Allocate memory for `nodes` nodes that each fuse at most `most` estimates."""
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
    """Results per activity: the estimates, x* as it would be sent, and whether it is sent.

    `refused` (m,) marks messages that the gate rejected.
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
        duration_s: duration of the prediction, in s.
    """
    predict_constant_velocity(
        mean, covariance, duration_s, (1, len(mean) // 2), noise_moments(density, duration_s)
    )


def observe(
    mean: Floats, covariance: Floats, independent: Floats, value: Floats, variance: Floats
) -> None:
    """Update with a measurement, component by component, in place.

    Args:
        mean, covariance: (n,), (n, n).
        independent: (n, n), the part of the covariance that is due to the measurements made since this
            part was last set to zero.
        value, variance: (n,), NaN for components that are not measured.
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
    """Update with all measurements of a node in an activity; see `observe`.

    Args:
        activity: number of the activity.
        mean, covariance, independent: as for `observe`.
        inputs: inputs of the nodes, with the measurements.
    """
    activities, sensing = inputs.events, inputs.sensing
    for k in range(activities.measured[activity], activities.measured[activity + 1]):
        variance = sensing.variance[sensing.sensor[k]]
        observe(mean, covariance, independent, sensing.value[k], variance)


def squared_distance(difference: Floats, covariance: Floats) -> float:
    """Compute the squared Mahalanobis distance, or infinity if the covariance is singular.

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
    """Compute the Kullback-Leibler divergence (nats) of a first Gaussian from a second one.

    Args:
        mean, covariance, of_mean, of_covariance: both Gaussians, (n,), (n, n).
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
    """Test whether two estimates, with any correlation, agree well enough to describe the same state.

    The covariance of the difference is at most P_a / w + P_b / (1 - w) for any w; here w is 1 / 2.

    Args:
        mean, covariance, received: both estimates, (n,), (n, n).
        gate: largest squared distance of estimates that agree; infinity accepts everything.
    """
    if gate == np.inf:
        return True
    difference, most = np.empty(len(mean)), np.empty_like(covariance)
    for row in range(len(mean)):
        difference[row] = received.mean[row] - mean[row]
    blend(2.0, covariance, 2.0, received.covariance, most)
    return squared_distance(difference, most) <= gate


def following() -> Follow:
    """Make the loop over the activities of one run; it stops if a fusion fails.

    Returns `follow(run, inputs, failed_ns, results, work)`, which writes the time of a failure.
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
    """Make all nodes send, then receive and fuse, at the current time; return False if a fusion fails.

    Args:
        run: number of the run.
        begin, end: the activities at this time.
        inputs, results, work: inputs of the nodes, results to fill, and scratch memory.
        failed_ns: (runs,), times at which a fusion failed, overwritten.
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
        # the independent part is not used after this
        observe_all(activity, mean, covariance, parts.independent[0], inputs)
        copy_gaussian(mean, covariance, results.mean[activity], results.covariance[activity])
    return True


def predict_and_send(
    activity: int, start_ns: int, inputs: NodeInputs, nodes: Nodes, results: NodeResults
) -> None:
    """Predict a node to the current time, update x* with its measurements, and send x* if it is due."""
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
    """Test whether x* may be sent again and differs enough from the prediction of the last message.

    Args:
        node, now: number of the node, and the time in ns.
        mean, covariance: x*, (n,), (n, n).
        inputs, nodes: inputs of the nodes, and their last messages.
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
    """Collect estimates to fuse at the current time, the node's own first; return their number."""
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
        # other nodes may have forwarded the information in an old message, so it is not independent
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
