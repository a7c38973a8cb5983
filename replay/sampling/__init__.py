"""Makes and keeps sample sets of N(0, I) for linear regression Kalman filters.

Begin with `samplers`.
"""

from fuselog.replay.sampling.cache import SetName, cached_set
from fuselog.replay.sampling.distance import lcd_distance
from fuselog.replay.sampling.lcd import lcd_samples, moment_corrected
from fuselog.replay.sampling.names import Sampling, parse_sampling
from fuselog.replay.sampling.samplers import Sampler, Samples

__all__ = [
    "Sampler",
    "Samples",
    "Sampling",
    "SetName",
    "cached_set",
    "lcd_distance",
    "lcd_samples",
    "moment_corrected",
    "parse_sampling",
]
