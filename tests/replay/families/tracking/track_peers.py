"""Random scenes of tracks and targets, and what motmetrics and TrackEval find in them.

`python -m tests.replay.families.tracking.track_peers` computes the peers' figures of all scenes again,
with both installed (`pip install motmetrics trackeval`), and keeps them with their versions in
`track_peers.json`.
"""

import json
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
KEPT = Path(__file__).with_suffix(".json")
SCENES, CUTOFF_M, STEPS = 200, 20.0, 40


def scene(seed: int) -> tuple[Floats, Floats]:
    """Return tracks (n, steps, 2) and targets (m, steps, 2), NaN where one is absent.

    Targets cross, come and go. Tracks follow them with gaps, change over to others, begin anew with
    another number, and some are false: near targets or far from all of them.
    """
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 5))
    begin, speed = rng.uniform(-60, 60, (m, 1, 2)), rng.normal(0, 3, (m, 1, 2))
    targets = begin + speed * np.arange(STEPS)[None, :, None]
    tracks = []
    for target in range(m):
        owners = np.repeat(target, STEPS)
        for _ in range(rng.integers(0, 3)):  # the track goes over to another target
            owners[rng.integers(1, STEPS) :] = rng.integers(0, m)
        track = targets[owners, np.arange(STEPS)] + rng.normal(0, rng.uniform(0.5, 9), (STEPS, 2))
        track[rng.uniform(size=STEPS) < rng.choice([0.0, 0.1, 0.4])] = np.nan
        cut = int(rng.integers(5, STEPS))
        again = np.full_like(track, np.nan)
        if rng.uniform() < 0.5:
            again[cut:], track[cut:] = track[cut:], np.nan
        tracks += [track, again]
    for _ in range(rng.integers(0, 4)):
        false = rng.uniform(-80, 80, (1, 2)) + rng.normal(0, 2, (STEPS, 2)) + rng.choice([0, 400])
        false[: rng.integers(0, STEPS)] = np.nan
        tracks.append(false)
    for target in range(m):
        away = rng.integers(0, STEPS, 2)
        if rng.uniform() < 0.4:
            targets[target, min(away) : max(away)] = np.nan
    order = rng.permutation(len(tracks))
    return np.array(tracks)[order], targets


def _of_motmetrics(tracks: Floats, targets: Floats) -> dict[str, float]:
    import motmetrics

    seen = motmetrics.MOTAccumulator(auto_id=True)
    for step in range(STEPS):
        there = [np.flatnonzero(np.isfinite(each[:, step, 0])) for each in (targets, tracks)]
        away = np.linalg.norm(targets[there[0], step, None] - tracks[None, there[1], step], axis=2)
        seen.update(*there, np.where(away < CUTOFF_M, away, np.nan))
    names = ["idf1", "num_switches", "num_fragmentations"]
    return motmetrics.metrics.create().compute(seen, metrics=names, name="it").loc["it"].to_dict()


def _of_trackeval(tracks: Floats, targets: Floats) -> dict[str, float]:
    import trackeval

    ids, similarities = [], []
    for step in range(STEPS):
        there = [np.flatnonzero(np.isfinite(each[:, step, 0])) for each in (targets, tracks)]
        away = np.linalg.norm(targets[there[0], step, None] - tracks[None, there[1], step], axis=2)
        ids.append(there)
        similarities.append(np.maximum(0.0, 1.0 - away / CUTOFF_M))
    # TrackEval numbers only what is ever there
    known = [np.unique(np.concatenate([each[which] for each in ids])) for which in (0, 1)]
    data = {
        "gt_ids": [np.searchsorted(known[0], each[0]) for each in ids],
        "tracker_ids": [np.searchsorted(known[1], each[1]) for each in ids],
        "num_gt_ids": len(known[0]),
        "num_tracker_ids": len(known[1]),
        "num_gt_dets": sum(len(each[0]) for each in ids),
        "num_tracker_dets": sum(len(each[1]) for each in ids),
        "num_timesteps": STEPS,
        "similarity_scores": similarities,
    }
    hota = trackeval.metrics.HOTA().eval_sequence(data)
    half = {**data, "similarity_scores": [0.5 * (each + (each > 0)) for each in similarities]}
    identity = trackeval.metrics.Identity({"PRINT_CONFIG": False}).eval_sequence(half)
    return {"hota": float(hota["HOTA"].mean()), "trackeval_idf1": float(identity["IDF1"])}


def main() -> None:
    """Compute and keep the peers' figures."""
    figures = []
    for seed in range(SCENES):
        found = _of_motmetrics(*scene(seed)) | _of_trackeval(*scene(seed))
        figures.append({name: round(float(value), 12) for name, value in found.items()})
    assert all(np.isclose(each["idf1"], each.pop("trackeval_idf1"), atol=1e-9) for each in figures)
    versions = {name: version(name) for name in ("motmetrics", "trackeval", "numpy")}
    lines = ",\n".join(json.dumps(each) for each in figures)
    KEPT.write_text(f'{{"versions": {json.dumps(versions)},\n"scenes": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
