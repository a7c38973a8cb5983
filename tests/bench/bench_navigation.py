"""An hour of inertial navigation, 100 Hz with fixes and velocities at 5 Hz; and a filter in plain NumPy.

Whole replays from columns in memory to output streams, CPU time of all cores together. The reference
goes through a minute; that it gives the same estimates, but for its linearisation, is asserted. Run it
with `make bench`, or `python -m tests.bench navigation`.
"""

import numpy as np

from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from tests.bench.reference import navigation
from tests.bench.timing import cpu_seconds

Row = tuple[str, str, str, str]
HOUR_S, MINUTE_S = 3600.0, 60.0
TARGETS_S = {"ekf": 4.0, "smoother:ekf": 10.0}
LEAST = 10.0  # times as fast as plain NumPy


def main() -> list[Row]:
    """Seconds for an hour."""
    hour, minute = drive(HOUR_S), drive(MINUTE_S)
    streams = {
        topic.removeprefix("/body/"): each for topic, each in minute.read(list(minute.topics)).items()
    }
    stated = streams["inertial"].metadata
    names = ("force_noise_density", "gyro_noise_density", "gyro_bias_density", "force_bias_density")
    densities = np.array([float(stated[name]) for name in names])
    place = float(stated["origin_latitude_deg"]), float(stated["origin_altitude_m"])
    plain = navigation.filtered(streams, densities, place)
    np.testing.assert_allclose(states("ekf", minute)[:, :6], plain, atol=0.01)
    ways = {label: lambda label=label: states(label, hour) for label in TARGETS_S}
    seconds = cpu_seconds(ways)
    [reference_s] = cpu_seconds(
        {"": lambda: navigation.filtered(streams, densities, place)}, repeats=1
    ).values()
    reference_s *= HOUR_S / MINUTE_S
    rows = [
        (
            f"{label}: an hour; what it may take",
            f"{own:.3g} s",
            f"{target:g} s",
            f"{own / target:.2g} times",
        )
        for label, target in TARGETS_S.items()
        for own in [seconds[label]]
    ]
    own = seconds["ekf"]
    ratio = f"{reference_s / own:.3g} times as fast, at least {LEAST:g}"
    return [*rows, ("ekf: an hour; plain NumPy", f"{own:.3g} s", f"{reference_s:.3g} s", ratio)]


def drive(duration_s: float) -> MemorySource:
    """A simulated drive."""
    return memory_source(*record_run("navigation", {"duration_s": duration_s}, seed=1))


def states(label: str, log: MemorySource) -> np.ndarray:
    """The means of all estimates."""
    found = collect(replay([log], bind(label, [log], {"gate_probability": 1.0})))
    return found[f"/estimates/{label}/body/state"]["mean"]
