"""A room of networked sensor nodes that track one moving target: DIND nodes.

Jin, Lee, Hashimoto, DIND networks, sections 3 to 5. The paper gives no values for the room, so the
defaults were chosen for fuselog. Every node observes the target with its own sensor and rate, and sends
its estimate over directed links, on which messages may be lost. The content of a message depends on the
estimator, so the log contains only the link events.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import outage_stream, prior_stream, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

COMPONENTS = ("x_m", "y_m", "vx_mps", "vy_mps")
Probability = Annotated[float, Field(ge=0, le=1)]
Index = Annotated[int, Field(ge=1)]


class Node(Parameters):
    """The sensor of a node.

    Attributes:
        components: measured components of the state.
        sigmas: standard deviations of these components, in their units.
        every_steps: number of steps between measurements; the first measurement is at the first step.
        acceleration_density: power spectral density of the acceleration in the node's own motion model,
            in m^2/s^3; the true density if not set.
    """

    components: tuple[str, ...] = ("x_m", "y_m")
    sigmas: tuple[PositiveFloat, ...] = (0.1, 0.1)
    every_steps: PositiveInt = 1
    acceleration_density: PositiveFloat | None = None


ROOM = (
    Node(sigmas=(0.05, 0.05)),
    Node(sigmas=(0.15, 0.15), every_steps=2),
    Node(sigmas=(0.05, 0.40), every_steps=3),
    Node(sigmas=(0.40, 0.05), every_steps=5),
)


class NodeOutage(Parameters):
    """A time span in which a node neither measures nor sends nor receives.

    Attributes:
        node: number of the node, from 1.
        start_s: start of the span, since the run's epoch.
        end_s: end of the span, since the run's epoch.
    """

    node: Index
    start_s: NonNegativeFloat
    end_s: PositiveFloat


class IspaceParameters(Parameters):
    """Linked sensor nodes in a room, and the target that the nodes track.

    Attributes:
        steps: number of time steps.
        step_s: length of a time step.
        acceleration_density: power spectral density of the target's acceleration, in m^2/s^3.
        start: mean of the target's initial state (x, y, vx, vy), in m and m/s.
        start_sigma: standard deviations of the initial state, in m and m/s.
        nodes: the sensor of each node.
        links: pairs of nodes, by number from 1, that are linked in both directions.
        random_nodes: number of nodes of a random graph; if above 0, every run has a different ring of
            this many nodes, which use the sensors of `nodes` in turn.
        random_chords: number of additional links in a random graph.
        loss_probability: probability that a message over a link is lost.
        duplicate_probability: probability that a message over a link arrives twice.
        delay_s: shortest delay of a message over a link.
        delay_jitter_s: mean of the additional random delay (exponential).
        outages: time spans in which a node is out of service.
    """

    steps: PositiveInt = 100
    step_s: PositiveFloat = 0.1
    acceleration_density: PositiveFloat = 0.005
    start: tuple[float, float, float, float] = (1.0, 1.0, 0.25, 0.2)
    start_sigma: tuple[PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat] = (0.5, 0.5, 0.3, 0.3)
    nodes: Annotated[tuple[Node, ...], Field(min_length=1)] = ROOM
    links: tuple[tuple[Index, Index], ...] = ((1, 2), (2, 3), (3, 4), (4, 1), (1, 3))
    random_nodes: Annotated[int, Field(ge=0)] = 0
    random_chords: Annotated[int, Field(ge=0)] = 0
    loss_probability: Probability = 0.2
    duplicate_probability: Probability = 0.0
    delay_s: NonNegativeFloat = 0.0
    delay_jitter_s: NonNegativeFloat = 0.0
    outages: tuple[NodeOutage, ...] = ()


def simulate(parameters: IspaceParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if a link or an outage refers to an unknown node."""
    truth_rng, sensor_rng, link_rng, graph_rng = rng.spawn(4)
    nodes, links = _network(parameters, graph_rng)
    _check(parameters, len(nodes), links)
    times_s: NDArray[np.float64] = np.arange(parameters.steps + 1, dtype=float) * parameters.step_s
    truth = _truth(parameters, truth_rng)
    streams = [
        prior_stream(
            "/prior",
            simulation_stamps_ns(times_s[:1]),
            COMPONENTS,
            parameters.start,
            np.diag(np.square(parameters.start_sigma)),
        ),
        truth_stream("/truth", simulation_stamps_ns(times_s), COMPONENTS, truth),
        _link_events(parameters, links, times_s[1:], link_rng),
    ]
    for number, node in enumerate(nodes, start=1):
        steps = np.arange(1, parameters.steps + 1, node.every_steps)
        steps = steps[~_is_out(parameters, number, times_s[steps])]
        seen = [COMPONENTS.index(name) for name in node.components]
        noise = sensor_rng.normal(size=(len(steps), len(seen))) * node.sigmas
        density = node.acceleration_density or parameters.acceleration_density
        streams.append(
            make_stream(
                f"/node{number}/sensor",
                schemas.VECTOR_MEASUREMENT,
                simulation_stamps_ns(times_s[steps]),
                metadata={
                    "components": ",".join(node.components),
                    "sigmas": ",".join(map(repr, node.sigmas)),
                    "acceleration_density": repr(density),
                },
                value=truth[steps][:, seen] + noise,
            )
        )
    return Recording(streams + _outage_streams(parameters))


def _network(
    parameters: IspaceParameters, rng: np.random.Generator
) -> tuple[list[Node], NDArray[np.int64]]:
    """Return the nodes, and the directed links (m, 2) as node numbers; draw them if they are random."""
    count = parameters.random_nodes
    if count == 0:
        nodes = list(parameters.nodes)
        pairs = np.array(parameters.links, np.int64).reshape(-1, 2)
    else:
        nodes = [parameters.nodes[index % len(parameters.nodes)] for index in range(count)]
        ring = rng.permutation(count) + 1
        chords = rng.integers(1, count + 1, (parameters.random_chords, 2))
        pairs = np.concatenate([np.stack([ring, np.roll(ring, 1)], axis=1), chords])
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return nodes, np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)


def _check(parameters: IspaceParameters, count: int, links: NDArray[np.int64]) -> None:
    named = [*links.ravel(), *(outage.node for outage in parameters.outages)]
    if named and max(named) > count:
        raise BadInput(
            f"scenario ispace: a link or outage refers to node {max(named)}; nodes are 1 to {count}"
        )
    if np.any(links[:, 0] == links[:, 1]):
        raise BadInput("scenario ispace: a link leads from a node to itself; remove it")
    for number, node in enumerate(parameters.nodes, start=1):
        if not set(node.components) <= set(COMPONENTS) or len(node.components) != len(node.sigmas):
            raise BadInput(
                f"scenario ispace: node {number} needs components from {', '.join(COMPONENTS)} "
                "and one sigma for each"
            )


def _truth(parameters: IspaceParameters, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw states (steps + 1, 4), the first from the prior."""
    position, both, velocity = noise_moments(parameters.acceleration_density, parameters.step_s)
    factor = np.linalg.cholesky(np.array([[position, both], [both, velocity]]))
    kicks = rng.normal(size=(parameters.steps, 2, 2)) @ factor.T  # step, axis, (position, velocity)
    start = np.array(parameters.start) + rng.normal(size=4) * parameters.start_sigma
    speed = start[2:] + np.concatenate([np.zeros((1, 2)), np.cumsum(kicks[:, :, 1], axis=0)])
    moves = speed[:-1] * parameters.step_s + kicks[:, :, 0]
    place = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return np.concatenate([place, speed], axis=1)


def _link_events(
    parameters: IspaceParameters,
    links: NDArray[np.int64],
    times_s: NDArray[np.float64],
    rng: np.random.Generator,
) -> Stream:
    """Simulate the messages of every link at every step; a lost message has the time of its loss."""
    sender, receiver = np.tile(links, (len(times_s), 1)).T
    sent_s = np.repeat(times_s, len(links))
    delay_s = parameters.delay_s + parameters.delay_jitter_s * rng.exponential(size=len(sent_s))
    lost = rng.uniform(size=len(sent_s)) < parameters.loss_probability
    lost |= _is_out(parameters, receiver, sent_s + delay_s)
    copies = 1 + (rng.uniform(size=len(sent_s)) < parameters.duplicate_probability)
    kept = np.repeat(np.arange(len(sent_s)), np.where(_is_out(parameters, sender, sent_s), 0, copies))
    return make_stream(
        "/links",
        schemas.LINK_EVENT,
        simulation_stamps_ns(sent_s[kept]),
        sender_id=sender[kept],
        receiver_id=receiver[kept],
        arrival_time_ns=simulation_stamps_ns((sent_s + delay_s)[kept]),
        lost=lost[kept],
    )


def _is_out(
    parameters: IspaceParameters, node: int | NDArray[np.int64], times_s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    out = np.zeros(len(times_s), bool)
    for span in parameters.outages:
        out |= (node == span.node) & (times_s >= span.start_s) & (times_s < span.end_s)
    return out


def _outage_streams(parameters: IspaceParameters) -> list[Stream]:
    spans: dict[int, list[NodeOutage]] = {}
    for span in parameters.outages:
        spans.setdefault(span.node, []).append(span)
    return [
        outage_stream(
            f"/node{node}/outages",
            simulation_stamps_ns([(span.start_s, span.end_s) for span in found]),
        )
        for node, found in spans.items()
    ]


ISPACE = Simulator(
    "a room of networked sensor nodes that track one moving target; any graph, losses, delays, outages",
    IspaceParameters,
    simulate,
)
