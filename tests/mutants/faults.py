"""Faults chosen by hand, over all rooms, and the tests that ought to catch each.

Signs, clocks, swapped arguments, forgotten roots, wrong bounds, leaks, shared random streams.
"""

from typing import NamedTuple


class Fault(NamedTuple):
    """In the file at `path` the text `old`, which occurs once, is replaced by `new`.

    `tests` are the files, separated by blanks, of which one has to fail.
    """

    path: str
    old: str
    new: str
    tests: str


def faulty(fault: Fault, sound: str) -> str:
    """The file's text with the fault; raises ValueError where the old text is not there exactly once."""
    if sound.count(fault.old) != 1:
        raise ValueError(f"{fault.path} has '{fault.old}' {sound.count(fault.old)} times; state it anew")
    return sound.replace(fault.old, fault.new)


PLANAR = "tests/recorders/test_planar.py"
LANDMARKS = "tests/recorders/test_landmarks.py"
VEHICLES = "tests/recorders/test_vehicles.py"
SCORES = "tests/recorders/test_biometrics.py"
READING = "tests/recorders/test_log_reading.py"
WRITING = "tests/recorders/test_log_writing.py"
ENGINE = "tests/replay/engine/test_engine.py"
EVALUATION = "tests/replay/judging/test_evaluation.py"
FUSION = "tests/replay/estimators/test_biometrics.py"
VECTORS = "tests/replay/engine/test_reading_streams.py"
SPANS = "tests/pipeline/test_spans.py"
FAILING = "tests/replay/engine/test_failing_runs.py"
OUTPUTS = "tests/pipeline/test_outputs.py"

FAULTS = [
    # models of sensors and motion
    Fault(
        "recorders/models/planar.py",
        "direction = pose[2] + half_turn\n    return (",
        "direction = pose[2]\n    return (",
        PLANAR,
    ),
    Fault(
        "recorders/models/acoustic.py",
        "trajectory - side * (0.5 * np.pi + medium",
        "trajectory + side * (0.5 * np.pi + medium",
        "tests/recorders/test_acoustic_model.py",
    ),
    Fault(
        "recorders/models/acoustic.py",
        "delay**2 + lever**2 * angles",
        "delay**2 + lever * angles",
        "tests/recorders/test_acoustic_model.py",
    ),
    Fault(
        "recorders/models/optical.py",
        "return _about_z(yaw, _about_y(pitch, _about_x(roll, x)))",
        "return _about_x(roll, _about_y(pitch, _about_z(yaw, x)))",
        "tests/recorders/test_optical_model.py",
    ),
    Fault(
        "recorders/models/optical.py",
        "by_target[2] * offset[1] - by_target[1] * offset[2]",
        "by_target[1] * offset[2] - by_target[2] * offset[1]",
        "tests/recorders/test_optical_model.py",
    ),
    # simulators: noise, clocks, priors, random streams
    Fault(
        "recorders/simulators/landmarks.py",
        "noise = rng.normal(size=(steps, 2)) * density / np.sqrt(step_s)",
        "noise = rng.normal(size=(steps, 2)) * density",
        LANDMARKS,
    ),
    Fault(
        "recorders/simulators/landmarks.py",
        "np.diag(sigma**2)",
        "np.diag(sigma)",
        LANDMARKS,
    ),
    Fault(
        "recorders/simulators/landmarks.py",
        'prior = truth[0] + rng_of("prior").normal(size=3) * sigma',
        "prior = truth[0] + np.random.default_rng(0).normal(size=3) * sigma",
        LANDMARKS,
    ),
    Fault(
        "recorders/simulators/landmarks.py",
        '"log_time_ns": simulation_stamps_ns(times_s + delay_s)[look]',
        '"log_time_ns": simulation_stamps_ns(times_s - delay_s)[look]',
        LANDMARKS,
    ),
    Fault(
        "recorders/simulators/landmarks.py",
        "half_view = np.radians(sensor.field_of_view_deg) / 2",
        "half_view = np.radians(sensor.field_of_view_deg)",
        LANDMARKS,
    ),
    Fault(
        "recorders/simulators/vehicles.py",
        "disturbance = rng.normal(size=(count, 4)) * np.sqrt(parameters.prior_variance)",
        "disturbance = rng.normal(size=(count, 4)) * np.array(parameters.prior_variance)",
        VEHICLES,
    ),
    Fault(
        "recorders/simulators/vehicles.py",
        "fixes += np.sqrt(parameters.fix.variance_m2) * fix_rng.normal(size=fixes.shape)",
        "fixes += parameters.fix.variance_m2 * fix_rng.normal(size=fixes.shape)",
        VEHICLES,
    ),
    Fault(
        "recorders/simulators/vehicles.py",
        "seen += np.sqrt(parameters.infrastructure.variance_m2) * sensor_rng.normal(size=seen.shape)",
        "seen += np.sqrt(parameters.infrastructure.variance_m2) * fix_rng.normal(size=seen.shape)",
        VEHICLES,
    ),
    Fault(
        "recorders/simulators/vehicles.py",
        "states[..., 0::2] += 0.5 * span_s[..., None] ** 2 * acceleration",
        "states[..., 0::2] += span_s[..., None] ** 2 * acceleration",
        VEHICLES,
    ),
    Fault(
        "recorders/simulators/biometrics.py",
        "np.sqrt(PROBE_VARIANCE) * users.probe[:, None]",
        "np.sqrt(PROBE_VARIANCE) * users.gallery[:, None]",
        SCORES,
    ),
    Fault(
        "recorders/simulators/orientation.py",
        "system_rng, measurement_rng = rng.spawn(2)",
        "system_rng = rng.spawn(1)[0]\n    measurement_rng = np.random.default_rng(0)",
        "tests/recorders/test_orientation.py tests/recorders/test_angle_recorders.py",
    ),
    Fault(
        "recorders/recording.py",
        "np.random.SeedSequence(seed, spawn_key=(run,))",
        "np.random.SeedSequence(seed)",
        LANDMARKS,
    ),
    # parameters
    Fault(
        "recorders/parameters.py",
        "merged[key] = merge(old, value)",
        "merged[key] = value",
        "tests/recorders/test_parameters.py",
    ),
    # importers
    Fault(
        "recorders/importers/ais.py",
        "np.where(speed == NO_SPEED, np.nan, speed * KNOT_MPS)",
        "np.where(speed == NO_SPEED, np.nan, speed)",
        "tests/recorders/test_ais.py",
    ),
    Fault(
        "recorders/importers/ais.py",
        "wrong[1:-1] = leaps[:-1] & leaps[1:]",
        "wrong[1:-1] = leaps[:-1] | leaps[1:]",
        "tests/recorders/test_ais.py",
    ),
    Fault(
        "recorders/importers/ais.py",
        "return reports.take(~repeated)",
        "return reports",
        "tests/recorders/test_ais.py",
    ),
    Fault(
        "recorders/importers/mrclam.py",
        "start_ns = max(odometry_ns[0], truth_ns[0])",
        "start_ns = min(odometry_ns[0], truth_ns[0])",
        "tests/recorders/test_mrclam.py",
    ),
    Fault(
        "recorders/importers/mrclam.py",
        'order = np.argsort(times_ns, kind="stable")',
        "order = np.arange(len(times_ns))",
        "tests/recorders/test_mrclam.py",
    ),
    Fault(
        "recorders/importers/broad.py",
        "turn_rate_radps=samples[:, 3:6]",
        "turn_rate_radps=samples[:, 6:]",
        "tests/recorders/test_broad.py",
    ),
    # the log
    Fault(
        "recorders/log/streams.py",
        'return self.publish_time_ns if clock == "publish_time" else self.log_time_ns',
        "return self.publish_time_ns",
        READING,
    ),
    Fault(
        "recorders/log/reader.py",
        "else end_ns - 1",
        "else end_ns",
        READING,
    ),
    Fault(
        "recorders/log/reader.py",
        "stream.take(np.lexsort((position, times)))",
        "stream.take(np.lexsort((-position, times)))",
        READING,
    ),
    Fault(
        "recorders/log/reader.py",
        "limit_ns = None if is_last else chosen[number].region.spans[order].first_ns",
        "limit_ns = None",
        READING,
    ),
    Fault(
        "recorders/log/container/chunks.py",
        "if checksum not in (0, zlib.crc32(data)):",
        "if checksum and not zlib.crc32(data):",
        "tests/recorders/test_log_damage.py",
    ),
    Fault(
        "recorders/log/layout.py",
        'records["mcap publish_time"] = stream.publish_time_ns',
        'records["mcap publish_time"] = stream.log_time_ns',
        f"{WRITING} {READING}",
    ),
    Fault(
        "recorders/log/loops.py",
        "wrong |= (words[offset + places[k]] ^ expected[k]) & mask[k]",
        "wrong = (words[offset + places[k]] ^ expected[k]) & mask[k]",
        "tests/recorders/test_log_foreign.py tests/recorders/test_log_damage.py",
    ),
    # blocks, engine, sources
    Fault(
        "replay/engine/streams/blocks.py",
        "np.concatenate([ragged.stream.times(order) for ragged in everything])",
        "np.concatenate([ragged.stream.publish_time_ns for ragged in everything])",
        "tests/replay/engine/test_engine.py",
    ),
    Fault(
        "replay/engine/streams/blocks.py",
        "positions[heads[k]] < positions[heads[first]]",
        "positions[heads[k]] > positions[heads[first]]",
        ENGINE,
    ),
    Fault(
        "replay/engine/streams/blocks.py",
        "events.is_last[event - 1] = False",
        "events.is_last[event - 1] = True",
        ENGINE,
    ),
    Fault(
        "replay/engine/streams/sources.py",
        "if there is None or (there.schema_name, there.metadata) != stated:",
        "if there is None:",
        ENGINE,
    ),
    Fault(
        "replay/engine/streams/sources.py",
        'kind="stable")] = np.arange(len(ranks))',
        'kind="stable")[::-1]] = np.arange(len(ranks))',
        ENGINE,
    ),
    # the caches
    Fault(
        "replay/engine/compiling/cache.py",
        "return content if header.startswith(_digest(content)) else None",
        "return content",
        "tests/replay/engine/test_compile.py",
    ),
    Fault(
        "replay/engine/compiling/kernel_cache.py",
        "{getattr(kind, 'fields', '')} ",
        "",
        "tests/replay/engine/test_compile.py",
    ),
    # evaluation, consistency, metrics
    Fault(
        "replay/judging/errors/evaluation.py",
        "(stream.publish_time_ns - epochs[run])[known] * 1e-9",
        "(stream.publish_time_ns - epochs[0])[known] * 1e-9",
        EVALUATION,
    ),
    Fault(
        "replay/engine/vectors/tangent.py",
        "(span <= gap_limit_s * 1e9)",
        "(span < gap_limit_s * 1e9)",
        EVALUATION,
    ),
    Fault(
        "replay/judging/errors/evaluation.py",
        "tail = 0.5 * (1 - probability)\n    interval",
        "tail = 1 - probability\n    interval",
        EVALUATION,
    ),
    Fault(
        "replay/judging/tables.py",
        "sigma = np.sqrt(np.diagonal(errors.covariance, axis1=1, axis2=2))",
        "sigma = np.diagonal(errors.covariance, axis1=1, axis2=2)",
        EVALUATION,
    ),
    Fault(
        "replay/judging/consistency/consistency.py",
        "return error**2 / np.diagonal(covariance, axis1=-2, axis2=-1)",
        "return error**2 / np.diagonal(covariance, axis1=-2, axis2=-1) ** 2",
        "tests/replay/judging/test_consistency.py",
    ),
    Fault(
        "replay/judging/consistency/consistency.py",
        "np.pi * chi2.ppf(probability, 2) * np.sqrt(squared)",
        "np.pi * chi2.ppf(probability, 2) * squared",
        "tests/replay/judging/test_consistency.py",
    ),
    Fault(
        "replay/judging/metrics/metrics.py",
        'sums["squared"] / sums["degrees"]',
        'sums["squared"] / sums["messages"]',
        f"{EVALUATION} tests/replay/judging/test_metrics.py",
    ),
    Fault(
        "replay/judging/metrics/metrics.py",
        '1 - sums["accepted"] / sums["messages"]',
        'sums["accepted"] / sums["messages"]',
        f"{EVALUATION} tests/replay/judging/test_metrics.py",
    ),
    # tracks, sets, verification
    Fault(
        "replay/judging/tracks/tracks.py",
        "rows, columns = linear_sum_assignment(counts, maximize=True)",
        "rows, columns = np.arange(len(target)), counts.argmax(axis=1)",
        "tests/replay/estimators/test_report_tracker.py tests/replay/judging/test_metrics.py",
    ),
    Fault(
        "replay/judging/tracks/tracks.py",
        'shares = table.loc[table["reports"] > reports, column]',
        'shares = table.loc[table["reports"] >= reports, column]',
        "tests/replay/estimators/test_report_tracker.py tests/replay/judging/test_metrics.py",
    ),
    Fault(
        "replay/judging/sets/distances.py",
        "costs = np.minimum(cdist(first, second), cutoff) ** order",
        "costs = np.minimum(cdist(first, second) ** order, cutoff)",
        "tests/replay/judging/test_set_distances.py",
    ),
    Fault(
        "replay/judging/sets/distances.py",
        "pairs = pairs[pairs < cutoff**order]",
        "pairs = pairs[pairs <= cutoff**order]",
        "tests/replay/judging/test_set_distances.py",
    ),
    Fault(
        "replay/judging/sets/errors.py",
        'elements["mean"][end - sizes["elements"][step] : end]',
        'elements["mean"][end - sizes["elements"][0] : end]',
        "tests/replay/judging/test_set_errors.py",
    ),
    Fault(
        "replay/judging/consistency/verification.py",
        "last = np.append(falling[1:] != falling[:-1], True)",
        "last = np.ones(len(falling), bool)",
        FUSION,
    ),
    Fault(
        "replay/judging/consistency/verification.py",
        'np.searchsorted(curve.false_accept, false_accept, side="right") - 1',
        'np.searchsorted(curve.false_accept, false_accept, side="left") - 1',
        FUSION,
    ),
    Fault(
        "replay/judging/consistency/verification.py",
        "right = (fused.score > (fused.threshold or 0.0)) == fused.genuine",
        "right = (fused.score >= (fused.threshold or 0.0)) == fused.genuine",
        FUSION,
    ),
    Fault(
        "replay/judging/consistency/verification.py",
        "weight = np.where(genuine, drawn[probe], drawn[probe] * drawn[gallery])",
        "weight = drawn[probe] * drawn[gallery]",
        FUSION,
    ),
    # the tangent space, distributions, samplings
    Fault(
        "replay/engine/vectors/tangent.py",
        "relative = compose(conjugate(truth[:, columns]), estimate[:, columns])",
        "relative = compose(estimate[:, columns], conjugate(truth[:, columns]))",
        "tests/replay/engine/test_tangent.py",
    ),
    Fault(
        "replay/distributions/wrapped_normal_kernels.py",
        "variances[k] = min(spread[k, k] - 2.0 * math.log1p",
        "variances[k] = min(spread[k, k] - math.log1p",
        "tests/replay/distributions/test_wrapped_normal.py",
    ),
    Fault(
        "replay/distributions/bingham_kernels.py",
        "greatest = z[d - 1]",
        "greatest = z[0]",
        "tests/replay/estimators/test_bingham_filter.py",
    ),
    Fault(
        "replay/sampling/samplers.py",
        "weights[0] = kappa / spread",
        "weights[0] = 1 / (2 * spread)",
        "tests/replay/sampling/test_samplings.py",
    ),
    Fault(
        "replay/sampling/samplers.py",
        "return q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]",
        "return q",
        "tests/replay/sampling/test_samplings.py",
    ),
    # estimators
    Fault(
        "replay/estimators/networks/pairwise.py",
        "entry = information[i, row, k] - shares[i] * common[row, k]",
        "entry = information[i, row, k] - shares[1 - i] * common[row, k]",
        "tests/replay/estimators/test_covariance_intersection.py",
    ),
    Fault(
        "replay/estimators/orientation/inertial.py",
        "_isotropic(model.drift_sigma_rad * math.sqrt(elapsed_s), noise)",
        "_isotropic(model.drift_sigma_rad * elapsed_s, noise)",
        "tests/replay/estimators/test_inertial.py",
    ),
    Fault(
        "replay/estimators/orientation/inertial.py",
        "covariance[i, i] += model.drift_sigma_rad**2 * elapsed_s",
        "covariance[i, i] += model.drift_sigma_rad**2",
        "tests/replay/estimators/test_inertial.py",
    ),
    Fault(
        "replay/estimators/biometrics/pairs.py",
        "learnt = ~judged & (pairs.fold[pairs.probe] != fold)",
        "learnt = ~judged",
        FUSION,
    ),
    Fault(
        "replay/estimators/biometrics/pairs.py",
        "judged = pairs.fold[pairs.gallery] == fold",
        "judged = pairs.fold[pairs.probe] == fold",
        FUSION,
    ),
    Fault(
        "replay/estimators/biometrics/biometrics.py",
        "prior = np.log(genuine.sum() / (~genuine).sum())",
        "prior = 0.0",
        FUSION,
    ),
    Fault(
        "replay/judging/tracks/tracks.py",
        "live_ns = round(live_s * 1e9)",
        "live_ns = round(live_s * 1e6)",
        "tests/replay/estimators/test_report_tracker.py",
    ),
    Fault(
        "replay/timeline/show.py",
        "return digest.hexdigest()",
        'return "0" * 64',
        "tests/replay/timeline/test_timeline.py",
    ),
    # the pipeline
    Fault(
        "pipeline/runs/estimates.py",
        "add_to_hash(digest, source)",
        "pass",
        "tests/pipeline/test_experiments.py",
    ),
    Fault(
        "pipeline/runs/estimates.py",
        'digest.update(hashlib.file_digest(file, "sha256").digest())',
        "pass",
        "tests/pipeline/test_command_line.py",
    ),
    Fault(
        "pipeline/runs/recorded.py",
        "record = partial(_record, scenario, dict(parameters), seed)",
        "record = partial(_record, scenario, dict(parameters), 0)",
        "tests/pipeline/test_experiments.py",
    ),
    Fault(
        "pipeline/output/claims.py",
        'if has_none or not re.search(r"\\bnan\\b", claim.ours):',
        "if True:",
        "tests/pipeline/test_claims.py",
    ),
    Fault(
        "pipeline/output/claims.py",
        'verdict = "not shown" if holds is None else "confirmed" if holds else "refuted"',
        'verdict = "confirmed" if holds else "refuted"',
        "tests/pipeline/test_claims.py",
    ),
    Fault(
        "pipeline/output/results.py",
        "return float(value) if value is not None and math.isfinite(value) else None",
        "return float(value) if value is not None and not math.isnan(value) else None",
        "tests/pipeline/test_experiments.py",
    ),
    Fault(
        "pipeline/runs/experiment.py",
        "experiment = build(Experiment, {**merge(values, own), **over}, where)",
        "experiment = build(Experiment, {**over, **merge(values, own)}, where)",
        "tests/pipeline/test_experiments.py",
    ),
    Fault(
        "pipeline/logs/information.py",
        "if defaults.get(name) != value}",
        "if name not in defaults}",
        "tests/pipeline/test_command_line.py",
    ),
    # what is read, what a replay starts from, how runs fail
    Fault(
        "replay/engine/vectors/components.py",
        "return [names.index(name) for name in wanted]",
        "return [*range(len(wanted))]",
        "tests/replay/engine/test_components.py",
    ),
    Fault(
        "replay/engine/vectors/components.py",
        "end, end + TANGENT_WIDTHS[kind]",
        "end, end + numbers.stop - numbers.start",
        "tests/replay/engine/test_components.py",
    ),
    Fault(
        "replay/engine/streams/measurements.py",
        "found[missing] = sigma**2 * np.eye(len(rows))",
        "found[missing] = sigma * np.eye(len(rows))",
        VECTORS,
    ),
    Fault(
        "replay/engine/streams/measurements.py",
        "missing = unknown(found)",
        "missing = np.isnan(found).all(axis=(1, 2))",
        VECTORS,
    ),
    Fault(
        "replay/engine/streams/measurements.py",
        "np.ascontiguousarray(stream[field][:, columns])",
        "np.ascontiguousarray(stream[field][:, : len(columns)])",
        VECTORS,
    ),
    Fault(
        "replay/engine/streams/priors.py",
        "whole[:, layout.rows][:, :, layout.rows]",
        "whole[:, layout.rows]",
        VECTORS,
    ),
    Fault("pipeline/runs/initial_states.py", 'start_ns, side="left"', 'start_ns, side="right"', SPANS),
    Fault(
        "pipeline/runs/initial_states.py",
        "covariance[own, own] = sigma**2",
        "covariance[own, own] = sigma",
        SPANS,
    ),
    Fault(
        "pipeline/runs/initial_states.py",
        "is_late = source.start_ns is not None and len(prior) and prior.times(order)[0]",
        "is_late = source.start_ns is not None and len(prior) and prior.publish_time_ns[0]",
        SPANS,
    ),
    Fault(
        "pipeline/runs/initial_states.py",
        'mean, covariance = stream["mean"][before - 1], stream["covariance"][before - 1]',
        'mean, covariance = stream["mean"][-1], stream["covariance"][-1]',
        SPANS,
    ),
    Fault(
        "pipeline/runs/initial_states.py",
        "zero_ns = source.zero_ns(order)",
        'zero_ns = source.zero_ns("publish_time")',
        SPANS,
    ),
    Fault(
        "replay/engine/streams/failures.py",
        "places = np.array([*map(merged.index, _reasons(part)), len(merged)])",
        "places = np.array([*range(len(_reasons(part))), len(merged)])",
        FAILING,
    ),
    Fault(
        "replay/engine/replaying/monitor.py",
        "output.stream.publish_time_ns < self._end_ns[run]",
        "output.stream.publish_time_ns <= self._end_ns[run]",
        FAILING,
    ),
    Fault(
        "replay/engine/replaying/soundness.py",
        "if time_ns[row] < last_ns:",
        "if time_ns[row] <= last_ns:",
        FAILING,
    ),
    Fault(
        "replay/engine/replaying/soundness.py",
        "factor[i, column] = entry / factor[column, column]",
        "factor[i, column] = entry",
        FAILING,
    ),
    Fault(
        "replay/engine/replaying/coverage.py",
        "median = np.argmax(2 * reached >= reached[-1], axis=0)",
        "median = np.argmax(reached >= reached[-1], axis=0)",
        FAILING,
    ),
    Fault(
        "replay/judging/metrics/metrics.py",
        'output.rows["estimated_s"].sum()',
        'output.rows["estimated_s"].mean()',
        FAILING,
    ),
    Fault(
        "pipeline/runs/ensemble.py",
        "is_part=not part.is_all",
        "is_part=False",
        FAILING,
    ),
    Fault(
        "replay/estimators/localization/solutions.py",
        "in_order = np.lexsort((last, run))",
        "in_order = np.arange(len(run))",
        "tests/replay/estimators/test_angle_streams.py",
    ),
    Fault(
        "replay/judging/sets/evaluation.py",
        "self.bound_holds & self.in_arena & ~self.inside",
        "self.bound_holds & ~self.inside",
        "tests/replay/estimators/test_set_membership.py",
    ),
    Fault(
        "replay/engine/replaying/replaying.py",
        "if len(times_ns) and times_ns[0] < start_ns:",
        "if len(times_ns) and times_ns[0] > start_ns:",
        SPANS,
    ),
    # what is written over, and how
    Fault(
        "pipeline/output/outputs.py",
        'taken[_identity(path)] = f"output {path}"',
        'taken[path] = f"output {path}"',
        OUTPUTS,
    ),
    Fault(
        "pipeline/output/outputs.py",
        "return state.st_dev, state.st_ino",
        "return path.parent.resolve(), path.name",
        OUTPUTS,
    ),
    Fault(
        "pipeline/output/outputs.py",
        "return run is not None and run.seed is not None and not _is_estimates(run)",
        "return run is not None and run.seed is not None",
        OUTPUTS,
    ),
    Fault(
        "recorders/atomic.py",
        "            place.rename(old)\n            check(old)",
        "            place.rename(old)",
        "tests/recorders/test_atomic.py tests/pipeline/test_outputs.py",
    ),
    Fault(
        "recorders/atomic.py",
        "return not others and (not members or",
        "return (not members or",
        "tests/recorders/test_atomic.py",
    ),
    Fault(
        "recorders/atomic.py",
        "            old.rename(place)\n",
        "            shutil.rmtree(old)\n",
        "tests/recorders/test_atomic.py",
    ),
    Fault(
        "recorders/log/container/reading.py",
        "return entry if entry.message_end_time else None",
        "return entry",
        "tests/recorders/test_log_foreign.py",
    ),
    Fault(
        "recorders/log/container/reading.py",
        "if known[number].offset >= end:",
        "if known[number].offset > position:",
        "tests/recorders/test_log_damage.py tests/recorders/test_log_by_hand.py",
    ),
    Fault(
        "recorders/parsing.py",
        "parse_float=number, parse_constant=number), text",
        "parse_float=number), text",
        "tests/recorders/test_parameters.py",
    ),
]
