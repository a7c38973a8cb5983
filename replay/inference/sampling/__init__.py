"""Sample sets of N(0, I) for linear regression Kalman filters, and their cache.

Begin with `samplers`.
"""

from fuselog.replay.inference.sampling.cache import SetName, cached_set
from fuselog.replay.inference.sampling.distance import lcd_distance
from fuselog.replay.inference.sampling.lcd import lcd_samples, moment_corrected
from fuselog.replay.inference.sampling.names import Sampling, parse_sampling
from fuselog.replay.inference.sampling.samplers import Sampler, Samples

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
