"""Intersection of rays: the starting point of localization from angles."""

import numpy as np

from fuselog.replay.engine.arrays import Floats

# If the smallest eigenvalue of the mean projector is below this, the rays are treated as parallel.
PARALLEL = 1e-12


def intersect_rays(origin_m: Floats, direction: Floats) -> Floats:
    """Find the least-squares intersection of rays: (sum(I - u u'))^-1 sum((I - u u') origin).

    The result is NaN if there are fewer than two rays, if all are parallel, or if all point away from
    the intersection.

    Args:
        origin_m: (rays, d), or with the batch axes of `direction`.
        direction: unit vectors u (..., rays, d); NaN leaves a ray out.

    Returns:
        Points (..., d), in m.
    """
    missing = np.isnan(direction)
    unit = np.where(missing, 0.0, direction)
    origin = np.broadcast_to(origin_m, unit.shape)
    identity = np.eye(unit.shape[-1])
    projector = np.where(missing[..., None], 0.0, identity) - unit[..., :, None] * unit[..., None, :]
    normal = projector.sum(axis=-3)
    moment = (projector @ origin[..., None]).sum(axis=-3)
    meet = np.linalg.eigvalsh(normal)[..., :1] > PARALLEL * unit.shape[-2]
    point = np.linalg.solve(np.where(meet[..., None], normal, identity), moment)[..., 0]
    ahead = ((point[..., None, :] - origin) * unit).sum(axis=-1) > 0.0
    return np.where(meet & ahead.any(axis=-1, keepdims=True), point, np.nan)
