"""Faults of the origin that geodetic fixes are taken into a plane by."""

from collections.abc import Iterator

import numpy as np

from pipeline.altering import alterations as alter
from pipeline.diagnosing.advice import Advice, number
from pipeline.diagnosing.hypotheses.hypothesis import Hypothesis
from pipeline.diagnosing.likelihood import Trial
from recorders.log import Stream
from recorders.log.planes import Origin, stated_in
from recorders.models.geodesy import out_of_tangent_plane

STEP_M = 1.0
Metres = tuple[float, float]


def of_origin(stream: Stream) -> Iterator[Hypothesis]:
    """The plane has another origin than the fixes' channel states; none where it states none."""
    stated = stated_in(stream.topic, stream.metadata)
    if stated is None or "latitude_deg" not in stream.columns:
        return
    origin = stated

    def right(by_m: Metres) -> Origin:
        """The origin, where fixes are so far east and north of where they should be."""
        latitude, longitude, _ = out_of_tangent_plane(by_m, origin)
        return origin._replace(latitude_deg=float(latitude), longitude_deg=float(longitude))

    def without(trial: Trial, by_m: Metres) -> Trial:
        apart = np.subtract(right(by_m), origin)
        source = trial.source
        for field, degrees in zip(("latitude_deg", "longitude_deg"), apart, strict=False):
            source = alter.altered(source, stream.topic, alter.shifted(field), -float(degrees))
        return trial._replace(source=source)

    def words(at: Metres, low: Metres, high: Metres) -> str:
        east, north = (
            f"{number(value)} ({number(least)} to {number(most)}) m too far"
            for value, least, most in zip(at, low, high, strict=True)
        )
        return (
            f"{stream.topic}: its fixes are {east} east and {north} north: the origin of the plane is "
            "another one"
        )

    def mend(at: Metres) -> Advice:
        mended = right(at)
        return Advice(f"{stream.topic}.origin", f"{mended.latitude_deg:.8f},{mended.longitude_deg:.8f}")

    yield Hypothesis(
        "bias or turned frame",
        stream.topic,
        "east_m, north_m",
        ((STEP_M, STEP_M),),
        np.inf,
        without,
        words,
        mend,
        size=2,
    )
