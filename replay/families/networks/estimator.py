"""Replay of sensor networks: every node filters with its own sensor and fuses received estimates.

Jin, Lee, Hashimoto, DIND networks, 4.2: predict; x* = update with the own measurement; send x*; fuse the
prediction (not x*) with the received x*, by a rule of `covariance_intersection`; update with the own
measurement again. The log records when each message was sent and when it arrived. The content of the
messages is computed by the replay, so the same log can be replayed with any rule. The state is
(positions, velocities).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Topic, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine import chi2
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Integers
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.engine.streams.channels import numbered
from fuselog.replay.engine.streams.results import ALL_WELL, failures_of, states_in
from fuselog.replay.engine.vectors.components import components_of
from fuselog.replay.families.networks.covariance_intersection import rule_number
from fuselog.replay.families.networks.nodes import (
    Activities,
    NodeFusion,
    NodeInputs,
    NodeResults,
    Sensing,
    following,
    node_memory,
)

ALONE, CENTRALISED, TRAP = "alone", "centralised", "own-again"
Rule = Literal[
    "alone",
    "centralised",
    "naive",
    "ci-trace",
    "ci-determinant",
    "niehsen",
    "franken",
    "split-ci",
    "inverse-ci",
    "own-again",
]
FAILURES = ("a covariance is singular or no longer finite",)


class NetworkParameters(Parameters):
    """Fusion rule, conditions for sending, and a node that sends false estimates.

    Attributes:
        rule: the fusion rule; "alone" does not fuse, "centralised" is one filter with all sensors and no
            links, and "own-again" is a deliberate mistake: a node fuses its own estimate and then uses
            its measurement again.
        tolerance: tolerance of the optimization of weights.
        send_interval_s: shortest time between two messages of a node.
        send_divergence: a node sends again if the Kullback-Leibler divergence of its estimate from the
            prediction of its last message reaches this value, in nats.
        gate_probability: a received estimate is fused if it agrees with the node's own; consistent
            estimates with any correlation pass this gate with at least this probability.
        liar: number of the node that sends false estimates.
        lie_m: offset that the liar adds to its estimates.
        lie_after_s: time after the start of the run at which the liar begins to add the offset.
    """

    rule: Rule = "ci-trace"
    tolerance: PositiveFloat = 1e-3
    send_interval_s: NonNegativeFloat = 0.0
    send_divergence: NonNegativeFloat = 0.0
    gate_probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    liar: PositiveInt | None = None
    lie_m: float = 1.0
    lie_after_s: NonNegativeFloat = 0.0


_follow = compile_over_runs(following(), title="the nodes of a network")


def _fusion(parameters: NetworkParameters, sensors: Collection[int], states: int) -> NodeFusion:
    name, liar = parameters.rule, parameters.liar
    if liar is not None and liar not in sensors:
        raise BadInput(
            f"liar = {liar} is not one of the nodes {', '.join(map(str, sensors))}; give one of these"
        )
    rule = {ALONE: "naive", CENTRALISED: "naive", TRAP: "ci-trace"}.get(name, name)
    return NodeFusion(
        rule_number(rule),
        parameters.tolerance,
        name == TRAP,
        round(parameters.send_interval_s * 1e9),
        parameters.send_divergence,
        float(chi2.ppf(parameters.gate_probability, states)),
        -1 if liar is None else list(sensors).index(liar),
        parameters.lie_m,
        round(parameters.lie_after_s * 1e9),
    )


def message_bytes(name: str, states: int) -> int:
    """Count the bytes of a message: stamp, mean, and triangle of the covariance (two for split CI)."""
    triangle = states * (states + 1) // 2
    doubles = {ALONE: 0, "split-ci": 1 + states + 2 * triangle}.get(name, 1 + states + triangle)
    return 8 * doubles


def solve(given: Given[NetworkParameters]) -> list[Ragged]:
    """Replay the network; see the module's docstring.

    Raises BadInput if a link or the liar refers to an unknown node, or if a message arrives before it
    was sent.
    """
    (sensors, components), parameters = given.setup, given.parameters
    prior_ns, prior_mean, prior_covariance = given.prior("/prior")
    runs, size = prior_mean.shape
    activities, sensing, arrived = _schedule(given, sensors, components, prior_ns, parameters.rule)
    count = len(activities.node)
    blank = np.full((count, size), np.nan)
    square = np.full((count, size, size), np.nan)
    results = NodeResults(
        blank,
        square,
        blank.copy(),
        square.copy(),
        np.zeros_like(square),
        np.zeros(count, bool),
        np.zeros(len(arrived), bool),
    )
    failed_ns = np.full(runs, -1)
    most = 1 + int(np.diff(activities.received).max(initial=0))
    _follow(
        runs,
        NodeInputs(
            activities,
            sensing,
            _fusion(parameters, sensors, size),
            prior_ns,
            prior_mean,
            prior_covariance,
        ),
        failed_ns,
        results,
        scratch=partial(node_memory, len(sensing.density), most, size),
    )
    well = np.full_like(failed_ns, ALL_WELL)
    topic, kinds = f"/estimates/{given.name}", components_of(components)
    outputs = [failures_of(topic, well, np.where(failed_ns < 0, well, 0), failed_ns, FAILURES)]
    places = [f"node{number}" for number in sensors] if parameters.rule != CENTRALISED else ["centre"]
    done = np.isfinite(results.mean[:, 0])
    stamps = activities.time_ns, activities.offsets
    for node, place in enumerate(places):
        own = (activities.node == node) & done
        estimates = ("state", own, "/truth", results.mean, results.covariance)
        messages = ("sent", own & results.sent, None, results.sent_mean, results.sent_covariance)
        is_sender = parameters.rule not in (ALONE, CENTRALISED)
        for leaf, chosen, truth, mean, covariance in [estimates, messages][: 1 + is_sender]:
            rows, where = np.flatnonzero(chosen), f"{topic}/{place}/{leaf}"
            outputs.append(states_in(rows, where, *stamps, kinds, truth, mean, covariance))
    if parameters.gate_probability < 1.0:
        links, rows = given["/links"], np.sort(arrived[results.refused])
        refused = replace(links.stream.take(rows), topic=f"{topic}/refused")
        outputs.append(Ragged(refused, np.searchsorted(rows, links.offsets)))
    return outputs


def _schedule(
    whole: Mapping[str, Ragged],
    sensors: Mapping[int, Topic],
    components: Sequence[str],
    prior_ns: Integers,
    name: str,
) -> tuple[Activities, Sensing, Integers]:
    """Return the activities of all nodes and runs, their measurements, and rows of arrived messages."""
    numbers = list(sensors)
    centralised = name == CENTRALISED
    sensing = _sensing(whole, sensors, components)
    run, time_ns, node = _events([whole[topic.name] for topic in sensors.values()])
    if centralised:
        node = np.zeros_like(node)
    links = whole["/links"]
    link_run = run_of_rows(links.offsets)
    ends = {}
    for end in ("sender_id", "receiver_id"):
        if not np.isin(links[end], numbers).all():
            raise BadInput(
                f"topic /links: {end} refers to a node without a topic /nodeN/sensor; record the topic, "
                "or remove the link"
            )
        ends[end] = np.searchsorted(numbers, links[end])
    sent_ns, arrival_ns = links.stream.publish_time_ns, links["arrival_time_ns"]
    if np.any(arrival_ns < sent_ns):
        raise BadInput(
            "topic /links: a message arrives before it was sent; synchronize the clocks of the link"
        )
    arrived = links["lost"] == 0
    if centralised or name == ALONE:
        arrived = np.zeros(len(links), bool)
        if centralised:
            ends = {end: np.zeros_like(ids) for end, ids in ends.items()}
    events = [
        np.stack(each)
        for each in (
            (run, time_ns, node),
            (link_run, sent_ns, ends["sender_id"]),
            (link_run[arrived], arrival_ns[arrived], ends["receiver_id"][arrived]),
        )
    ]
    stacked = np.concatenate(events, axis=1)
    usable = stacked[1] >= prior_ns[stacked[0]]
    instants, rank = np.unique(stacked[1], return_inverse=True)
    keys = (stacked[0] * len(instants) + rank) * len(numbers) + stacked[2]
    found, activity = np.unique(np.where(usable, keys, -1), return_inverse=True)
    early = int(found[0] == -1) if len(found) else 0  # events before the prior
    found, activity = found[early:], activity - early
    moment, node_of = np.divmod(found, len(numbers))
    run_of, instant = np.divmod(moment, len(instants))
    cuts = np.cumsum([part.shape[1] for part in events])[:-1]
    of_measurement, of_send, of_arrival = np.split(activity, cuts)
    order = np.argsort(of_measurement, kind="stable")
    order = order[of_measurement[order] >= 0]
    source = of_send[arrived]
    received = np.argsort(of_arrival, kind="stable")
    received = received[source[received] >= 0]
    sent = np.zeros(len(found), bool)
    sent[of_send[of_send >= 0]] = True
    bounds = np.arange(len(found) + 1)
    return (
        Activities(
            np.searchsorted(run_of, np.arange(len(prior_ns) + 1)),
            instants[instant],
            node_of,
            np.searchsorted(of_measurement[order], bounds),
            np.searchsorted(of_arrival[received], bounds),
            source[received],
            sent,
        ),
        sensing._replace(value=sensing.value[order], sensor=sensing.sensor[order]),
        np.flatnonzero(arrived)[received],
    )


def _events(parts: Sequence[Ragged]) -> tuple[Integers, Integers, Integers]:
    """Return run, stamp and part index of all messages, one part after another."""
    run = [run_of_rows(part.offsets) for part in parts]
    index = [np.full(len(part), number) for number, part in enumerate(parts)]
    time_ns = [part.stream.publish_time_ns for part in parts]
    return np.concatenate(run), np.concatenate(time_ns), np.concatenate(index)


def _sensing(
    whole: Mapping[str, Ragged], sensors: Mapping[int, Topic], components: Sequence[str]
) -> Sensing:
    values, index = [], []
    variance = np.full((len(sensors), len(components)), np.nan)
    density = np.empty(len(sensors))
    for number, topic in enumerate(sensors.values()):
        part = whole[topic.name]
        try:
            seen = [components.index(name) for name in topic.metadata["components"].split(",")]
            variance[number, seen] = np.square([float(x) for x in topic.metadata["sigmas"].split(",")])
            density[number] = float(topic.metadata["acceleration_density"])
        except (KeyError, ValueError):
            raise BadInput(
                f"topic {topic.name}: the channel's metadata must state components, sigmas "
                "and acceleration_density"
            ) from None
        if part["value"].size != len(part) * len(seen):
            raise BadInput(
                f"topic {topic.name}: its values do not have the {len(seen)} components that its "
                "channel states; state as many components as each value has"
            )
        value = np.full((len(part), len(components)), np.nan)
        value[:, seen] = part["value"].reshape(len(part), len(seen))
        values.append(value)
        index.append(np.full(len(part), number))
    if not np.all(np.nan_to_num(variance, nan=1.0) > 0):
        raise BadInput(
            "a sensor's sigma is not positive, which makes covariances singular; give a positive sigma"
        )
    return Sensing(np.concatenate(values), np.concatenate(index), variance, density)


def _find(_: str, topics: Mapping[str, Topic], parameters: NetworkParameters) -> Iterator[Binding]:
    sensors = numbered(topics, "node", "sensor", schemas.VECTOR_MEASUREMENT)
    if not sensors or "/links" not in topics or "/prior" not in topics:
        return
    components = state_of(topics["/prior"])
    streams = {each: topics[each] for each in ("/links", *(topic.name for topic in sensors.values()))}
    priors = {"/prior": components_of(components)}
    static = {"/prior": topics["/prior"]}
    yield Binding(streams, static, priors=priors, setup=(sensors, components))


def state_of(prior: Topic) -> list[str]:
    """Return the components of a prior: positions, then their velocities, such as `x_m` and `vx_mps`.

    Raises BadInput if the prior has other components.
    """
    stated = [name for name in prior.metadata.get("components", "").split(",") if name]
    positions = [name for name in stated if name.endswith("_m")]
    components = [*positions, *(f"v{name.removesuffix('_m')}_mps" for name in positions)]
    if not positions or sorted(components) != sorted(stated):
        raise BadInput(
            f"topic {prior.name}: its channel states {', '.join(stated) or 'no components'}; expected "
            "positions such as x_m, and for each a velocity such as vx_mps"
        )
    return components


NETWORK = batch(
    "nodes that track one target and fuse the estimates they send each other, by any fusion rule",
    parameters=NetworkParameters,
    find=_find,
    requirements="/prior, /links and, per node, /nodeN/sensor",
    solve=solve,
    variant="rule",
)
