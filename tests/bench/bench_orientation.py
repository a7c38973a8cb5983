"""Orientation over one simulated log of a nine-axis unit, against the packages ahrs and vqf.

Madgwick's and Mahony's filters give the same orientations as those of ahrs, or this stops; beside VQF
stands the EKF of the model `orientation`, which does more: it tells a covariance. Its loop is timed
alone as well; the rest is to check and return the covariances, 11 by 11 a sample.
"""

from typing import Any

import numpy as np

from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.inertial import product, triad
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.directional.orientation.complementary import HALF
from tests.bench.loops import calls_of
from tests.bench.meter import loop_seconds
from tests.bench.timing import median_seconds, seconds

COUNT, STEP_NS, THEIRS = 100_000, 10_000_000, 500
SETTINGS: dict[str, dict[str, Any]] = {"ekf": {"model": "orientation"}, "madgwick": {}, "mahony": {}}

Row = tuple[str, float, float, float]


def main() -> list[Row]:
    """Rows of (what, our time in us a sample, theirs, how many times faster)."""
    source = swung()
    ours = {
        label: 1e6 * median_seconds(lambda label=label: ran(source, label)) / COUNT for label in SETTINGS
    }
    theirs = {label: ahrs_us(source, label) for label in ("madgwick", "mahony")} | {
        "ekf": vqf_us(source)
    }
    calls = calls_of(bind("ekf", [source], SETTINGS["ekf"]), [source])
    ours["loop"] = 1e6 * min(sum(map(loop_seconds, calls)) for _ in range(5)) / COUNT
    theirs["loop"] = theirs["ekf"]
    names = {
        "ekf": "EKF, us; vqf's VQF, at least 0.5",
        "loop": "EKF, its loop, us; vqf's VQF",
        "madgwick": "Madgwick, us; ahrs",
        "mahony": "Mahony, us; ahrs",
    }
    return [(name, ours[of], theirs[of], theirs[of] / ours[of]) for of, name in names.items()]


def swung() -> MemorySource:
    """A log of samples that no body has made, but that tell an orientation."""
    time_s = np.arange(COUNT)[:, None] * STEP_NS * 1e-9
    samples = make_stream(
        "/hand/inertial",
        schemas.INERTIAL_SAMPLE,
        SIMULATION_EPOCH_NS + STEP_NS * np.arange(COUNT),
        specific_force_mps2=0.3 * np.sin(9.0 * time_s + np.arange(3)) + np.array([0.0, 0.0, 9.8]),
        turn_rate_radps=0.3 * np.cos(7.0 * time_s + np.arange(3)),
        magnetic_field_ut=0.3 * np.cos(5.0 * time_s + np.arange(3)) + np.array([0.0, 20.0, -40.0]),
    )
    return memory_source(Recording([samples]), RunMetadata("hand"))


def ran(source: MemorySource, label: str) -> np.ndarray:
    """Our orientations (COUNT, 4)."""
    estimates = collect(replay([source], bind(label, [source], SETTINGS[label])))
    return estimates[f"/estimates/{label}/hand/state"]["mean"]


def ahrs_us(source: MemorySource, label: str) -> float:
    """The time of a sample of ahrs's filter; an AssertionError where it gives another orientation."""
    import ahrs

    samples = source.streams["/hand/inertial"]
    force, rate, field = (
        samples[name] for name in ("specific_force_mps2", "turn_rate_radps", "magnetic_field_ut")
    )
    start = tuple(triad(force[0], field[0]))
    turned = label == "madgwick"  # its north is x
    made = {"madgwick": ahrs.filters.Madgwick, "mahony": ahrs.filters.Mahony}[label]
    theirs = made(frequency=1e9 / STEP_NS, **({"gain": 0.041} if turned else {}))
    q = np.array(product((HALF, 0.0, 0.0, -HALF), start) if turned else start)
    q = theirs.updateMARG(q, rate[0], force[0], field[0], dt=0.0)

    def steps() -> None:
        nonlocal q
        for row in range(1, THEIRS):
            q = theirs.updateMARG(q, rate[row], force[row], field[row])

    taken_s = seconds(steps)
    expected = product((HALF, 0.0, 0.0, HALF), tuple(q)) if turned else tuple(q)
    np.testing.assert_allclose(ran(source, label)[THEIRS - 1], expected, atol=1e-12)
    return 1e6 * taken_s / (THEIRS - 1)


def vqf_us(source: MemorySource) -> float:
    """The time of a sample of VQF over the whole log."""
    from vqf import VQF

    samples = source.streams["/hand/inertial"]
    columns = [
        np.ascontiguousarray(samples[name])
        for name in ("turn_rate_radps", "specific_force_mps2", "magnetic_field_ut")
    ]
    return 1e6 * median_seconds(lambda: VQF(STEP_NS * 1e-9).updateBatch(*columns)) / COUNT
