"""Every mistake a user can make is one clear sentence and exit code 2, and nothing is written."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from fuselog.recorders.log import open_log, read_streams, write_log
from fuselog.recorders.recording import record_run

pytestmark = pytest.mark.usefixtures("blank_figures")

REPLAY_EKF = "replay {} -e ekf"

# What is given, and words that the sentence must have: what is wrong, and what to do.
TABLE: dict[str, tuple[str, ...]] = {
    # nothing, too much, unknown
    "record": ("either a scenario", "--again"),
    "record landmarks --again log.mcap": ("either a scenario", "--again"),
    "record landmark": ("no scenario 'landmark'", "did you mean 'landmarks'"),
    "record zzz": ("no scenario 'zzz'", "landmarks-adverse", ".toml"),
    "record zzz.toml": ("zzz.toml", "no such file"),
    "record folder": ("no scenario 'folder'",),
    "record garbled.toml": ("garbled.toml", "TOML"),
    "record scenario.toml": ("scenario.toml", 'recorder = "NAME"'),
    "record mrclam": ("fuselog import mrclam",),
    "import landmarks mrclam": ("fuselog record landmarks",),
    "import zzz mrclam": ("no recorder 'zzz'",),
    "replay log.mcap": ("Missing option '-e'", "fuselog replay --help"),
    "replay log.mcap -e efk": ("no estimator 'efk'", "did you mean 'ekf'"),
    "replay log.mcap -e ekf --model robt": ("no model 'robt'", "did you mean 'robot'"),
    "replay log.mcap -e ekf --model vehicle": (
        "does not fit",
        "no topic that vehicle needs",
        "/robot1/prior",
    ),
    "replay log.mcap -e triad --model robot": ("--model", "methods such as ekf", "not to triad"),
    "replay log.mcap -e ekf --every 0": ("'every_s' is 0", "greater than 0"),
    "replay log.mcap -e ekf --every soon": ("--every", "soon"),
    "replay log.mcap -e ekf --late drop": (
        "only if they are processed in order of arrival",
        "--arrival-order",
    ),
    "replay log.mcap -e ekf --arrival-order --late drp": ("wait:SECONDS", "did you mean 'drop'"),
    "replay log.mcap -e ekf --arrival-order --late drop:1": ("has no duration", "give --late drop"),
    "replay log.mcap -e ekf --arrival-order --late wait": ("zero or more seconds", "wait:0.5"),
    "replay log.mcap -e ekf --arrival-order --late rewind:-1": ("zero or more seconds", "rewind:0.5"),
    "replay log.mcap -e ekf --arrival-order --late wait:soon": ("--late wait:soon", "seconds"),
    "replay log.mcap -e smoother:ekf --arrival-order --late rewind:1": (
        "smoother:ekf",
        "a smoother uses later messages",
        "--late drop",
    ),
    "replay log.mcap -e ekf --every 0.1 --arrival-order --late rewind:1": ("--every", "--late wait"),
    "replay log.mcap -e ekf --arrival-order --late drop --start-from truth --start 1": (
        "--start-from truth",
        "use only one of these options",
    ),
    "run landmarks --late drop": ("only if they are processed in order of arrival",),
    "run reactor --arrival-order": ("study reactor replays in the order of the stamps", "leave out"),
    'replay log.mcap -e ekf --set estimate=["bias_rnge_m"]': (
        "this model cannot estimate a parameter of this name",
        "'bias_range_m'",
    ),
    'replay log.mcap -e ekf --set estimate=["sigma_speed"]': (
        "this model cannot estimate a parameter of this name",
        "bias_bearing_rad",
    ),
    'replay log.mcap -e ekf --set estimate=["bias_range_m"]': ("estimate_sigma.bias_range_m=",),
    'replay log.mcap -e ekf --set estimate=["bias_range_m"] --set estimate_sigma.bias_range_m=0': (
        "'estimate_sigma.bias_range_m' is 0",
        "greater than 0",
    ),
    'replay log.mcap -e ekf --set estimate=["bias_range_m","bias_range_m"] '
    "--set estimate_sigma.bias_range_m=1": ("twice",),
    "replay log.mcap -e ekf --set estimate_drift.bias_range_m=1": ("bias_range_m is not in `estimate`",),
    "replay log.mcap -e ekf --set mode=calm": ("mode = calm", "one motion", "leave out"),
    "replay log.mcap -e ekf --set sigma_rnge_m=1": ("no such", "'sigma_range_m'"),
    "replay log.mcap -e ekf --set point_variance_m2=1": (
        "model robot",
        "no parameter 'point_variance_m2'",
    ),
    "replay log.mcap -e analytic": ("model robot lacks exact moments of its motion",),
    "run landmarks --set ekf.model=robt": ("no model 'robt'", "did you mean 'robot'"),
    "models robt": ("no model 'robt'", "did you mean 'robot'"),
    "replay log.mcap -e ekf:x": ("no variants", "'ekf'"),
    "replay log.mcap -e a/b --set a/b.kind=ekf": ("'a/b'", "letters"),
    "evaluate log.estimates.mcap --metric acuracy": ("no metric 'acuracy'", "'accuracy'"),
    "run zzz": ("no experiment 'zzz'", "landmarks", ".toml"),
    "run landmarks --set study=zzz": ("no study 'zzz'", "localization"),
    "estimators efk": ("no estimator 'efk'", "'ekf'"),
    "scenarios zzz": ("no scenario 'zzz'", "landmarks"),
    "recrod landmarks": ("No such command 'recrod'", "fuselog --help"),
    # logs cut, merged, relabelled
    "cut log.mcap": ("Missing option '-o'",),
    "cut log.mcap -o new.csv": ("new.csv", "ends in .mcap"),
    "cut log.mcap -o log.mcap": ("would replace the log log.mcap",),
    "cut log.mcap -o other.mcap": ("other.mcap: exists", "a log that fuselog cut wrote"),
    "cut cut.mcap -o new.mcap": ("cut.mcap", "--recover"),
    "cut damaged.mcap -o new.mcap": ("damaged.mcap", "--recover"),
    "cut log.mcap --start 3 -o new.mcap": ("no messages in this span", "from 0 to 2 s"),
    "cut log.mcap --start 1 --end 1 -o new.mcap": ("the end must be after the start",),
    "cut log.mcap --topics /robot1/odometri -o new.mcap": ("log.mcap", "'/robot1/odometry'"),
    "cut log.mcap --topics /robot2/* -o new.mcap": ("log.mcap: no topic /robot2/*",),
    "cut log.mcap --decimate /robot2/*=2 -o new.mcap": ("no topic /robot2/*",),
    "cut log.mcap --decimate /robot1/truth -o new.mcap": ("--decimate /robot1/truth", "NAME=VALUE"),
    "cut log.mcap --decimate /robot1/truth=0 -o new.mcap": ("/robot1/truth=0", "as 10", "as 5Hz"),
    "cut log.mcap --decimate /robot1/truth=0Hz -o new.mcap": ("/robot1/truth=0Hz", "as 5Hz"),
    "cut log.mcap --decimate /robot1/truth=often -o new.mcap": ("/robot1/truth=often", "as 5Hz"),
    "cut json.mcap --topics /robot1/odometry -o new.mcap": ("json.mcap", "the encoding 'json'"),
    "cut json.mcap --topics /robot1/o* -o new.mcap": ("json.mcap", "import it first"),
    "cut nan.mcap -o new.mcap": ("nan.mcap", "is NaN in message"),
    "merge log.mcap -o new.mcap": ("log.mcap", "needs at least two logs"),
    "merge log.mcap other.mcap -o new.mcap": (
        "other.mcap",
        "topic /landmarks (5 in all) is also in log.mcap",
        "fuselog relabel other.mcap --topic /=/b/",
    ),
    "merge log.mcap zzz.mcap -o new.mcap": ("zzz.mcap", "No such file"),
    "merge log.mcap log.estimates.mcap -o log.mcap": ("would replace the log log.mcap",),
    "merge log.mcap log.estimates.mcap -o new.mcap --offset log.mcp=1": (
        "no log log.mcp",
        "did you mean 'log.mcap'",
    ),
    "merge log.mcap log.estimates.mcap -o new.mcap --offset log.mcap": (
        "--offset log.mcap",
        "LOG=SECONDS",
    ),
    "merge log.mcap log.estimates.mcap -o new.mcap --offset log.mcap=soon": ("LOG=SECONDS", "-0.5"),
    "merge log.mcap log.estimates.mcap -o new.mcap --offset log.mcap=nan": (
        "is nan",
        "give a number of seconds",
    ),
    "relabel log.mcap -o new.mcap": ("nothing to rename",),
    "constrain log.mcap -o new.mcap": ("has no inertial unit",),
    "relabel log.mcap --topic /robot1/truht=/truth -o new.mcap": ("did you mean '/robot1/truth'",),
    "relabel log.mcap --topic /robot1/truth=truth -o new.mcap": ("=truth", "/old=/new"),
    "relabel log.mcap --topic /robot1/=/b -o new.mcap": ("/robot1/=/b", "/robot1/=/robot2/"),
    "relabel log.mcap --topic /robot1/truth=/landmarks -o new.mcap": (
        "2 topics would have the name /landmarks",
    ),
    "relabel log.mcap --component x=y -o new.mcap": ("no component 'x'", "x_m"),
    "relabel log.mcap --component x_m=y_m -o new.mcap": ("would have two components y_m",),
    "relabel log.mcap --component x_m=a,b -o new.mcap": ("x_m=a,b", "without a comma"),
    "relabel log.mcap --component x_m=a --component x_m=b -o new.mcap": ("x_m=b", "each name only once"),
    # parameters of all levels: names, types, bounds
    "record landmarks --set duration_s": ("--set duration_s", "key=value"),
    "record landmarks --set =1": ("--set =1", "key=value"),
    "record landmarks --set robots=1 --set robots.x=1": ("--set robots.x=1", "already has a value"),
    "record landmarks --set duraton_s=1": ("no parameter 'duraton_s'", "did you mean 'duration_s'"),
    "record landmarks --set duration_s=soon": ("'duration_s' is 'soon'", "number"),
    "record landmarks --set duration_s=-1": ("'duration_s' is -1", "greater than 0"),
    "record landmarks --set duration_s=nan": ("'duration_s' is nan", "finite"),
    "record landmarks --set duration_s=1e12": ("not enough memory",),
    "record landmarks --set robots=1.5": ("'robots' is 1.5", "integer"),
    "record landmarks --set range.rate=1": ("no parameter 'range.rate'", "'rate_hz'"),
    "record landmarks --set range=1": ("'range' is 1", "dictionary"),
    "record axis --set step_s=1e12": ("lasts 1e+14 s", "2262"),
    "record batch-reactor --set start=[-1,-1]": (
        "start = (-1.0, -1.0)",
        "grow without bound",
        "shorter or fewer steps",
    ),
    "record biometric-scores --set users=100000": ("'users' is 100000", "5000"),
    "record landmarks --seed -1": ("--seed", "-1"),
    "record landmarks --run -1": ("--run", "-1"),
    "record landmarks --compression gz": ("'gz'", "'zstd', 'lz4', 'none'"),
    "replay log.mcap -e ekf --set gate=1": ("--set gate", "did you mean 'gate_probability'"),
    "replay log.mcap -e ekf --set ukf.kappa=1": ("--set ukf", "ekf"),
    "replay log.mcap -e ekf --set ekf=1": ("--set ekf=1", "ekf.PARAMETER=VALUE"),
    "replay log.mcap -e ekf --set ekf.gate=1": ("estimator ekf", "'gate'", "'gate_probability'"),
    "replay log.mcap -e ekf --set gate_probability=2": (
        "estimator ekf",
        "is 2",
        "less than or equal to 1",
    ),
    "replay log.mcap -e ukf --set kappa=-5": ("kappa", "above -3"),
    "run landmarks --set duraton_s=1": ("--set duraton_s", "did you mean 'duration_s'"),
    "run landmarks --set efk.gate_probability=1": ("--set efk", "did you mean 'ekf'"),
    "run landmarks --set ekf.gate=1": ("estimator ekf", "'gate'"),
    "run landmarks --set range.rate=1": ("no parameter 'range.rate'", "'rate_hz'"),
    "run landmarks --set gap_limit_s=-1": ("'gap_limit_s' is -1",),
    "run landmarks --set options.x=1": ("options of study localization", "'x'"),
    "run landmarks --set metrics=['acuracy']": ("no metric 'acuracy'", "'accuracy'"),
    "run landmarks --set record.scenario=landmark": ("no scenario 'landmark'", "'landmarks'"),
    "run landmarks --runs 0": ("experiment landmarks", "'runs' is 0"),
    "run landmarks --seed -1": ("'seed' is -1",),
    "run landmarks --logs -1": ("--logs", "-1"),
    "run landmarks --data mrclam": ("imports nothing", "--data"),
    "run mrclam": ("needs real data", "--data"),
    "run mrclam --data mrclam --runs 2": ("a fixed number of runs", "leave out seed and runs"),
    "run bingham-2d --runs 1": ("standard errors, which need at least two runs", "--runs 2"),
    "run acoustic --set options.multipliers=[2]": ("options of study acoustic", "multipliers", "1"),
    "run acoustic --set options.modes=[]": ("options of study acoustic", "modes", "bearings-only"),
    "run los-two-sensors --set options.scenarios=[]": ("options of study los", "the 5 of the paper"),
    "run lcd-sampling --set options.sizes=[]": ("options of study lcd-sampling", "'sizes'"),
    "run lcd-sampling --runs 3": ("experiment lcd-sampling", "makes no runs; leave out --runs"),
    "run garbled.toml": ("garbled.toml", "TOML"),
    "run deep.toml": ("deep.toml", "nested more than 50 levels deep"),
    "record deep.toml": ("deep.toml", "nested more than 50 levels deep"),
    "run digits.toml": ("digits.toml", "whole number of more than 4300 digits"),
    "run untitled.toml": ("untitled.toml", "'title' is missing"),
    "run unknown.toml": ("unknown.toml", "did you mean 'runs'"),
    "run both.toml": ("both.toml", "give exactly one of [record], [import]"),
    "run nothing.toml": ("[record]", "[import]"),
    "run no-scenario.toml": ("no scenario 'landmark'", "'landmarks'"),
    "run label.toml": ("'a/b'", "letters"),
    "run misfit.toml": ("estimator ekf does not fit", "range_bearing"),
    # times
    "replay log.mcap -e ekf --gap-limit -1": ("--gap-limit", "-1"),
    "replay log.mcap -e ekf --gap-limit nan": ("--gap-limit", "nan"),
    "replay log.mcap -e ekf --start 1 --end 0.5": ("--start 1 --end 0.5", "after the start"),
    "replay log.mcap -e ekf --start 9": ("log.mcap", "from 0 to 2 s"),
    "replay log.mcap -e ekf --end -9": ("log.mcap", "from 0 to 2 s"),
    "replay log.mcap -e ekf --start 1e300": ("--start", "1e+300"),
    "replay log.mcap -e ekf --start nan": ("--start", "nan"),
    # logs that are none, or broken
    "info zzz.mcap": ("zzz.mcap", "No such file"),
    "info folder": ("folder", "directory", "fuselog import table folder"),
    "info line.tum": ("line.tum", "not an MCAP", "fuselog import table line.tum"),
    "info text.mcap": ("text.mcap", "not an MCAP"),
    "info empty.mcap": ("empty.mcap", "not an MCAP"),
    "info cut.mcap": ("cut.mcap", "cut off", "--recover"),
    REPLAY_EKF.format("zzz.mcap"): ("zzz.mcap", "No such file"),
    REPLAY_EKF.format("folder"): ("folder", "no logs to replay"),
    REPLAY_EKF.format("text.mcap"): ("text.mcap", "not an MCAP"),
    REPLAY_EKF.format("empty.mcap"): ("empty.mcap", "not an MCAP"),
    REPLAY_EKF.format("cut.mcap"): ("cut.mcap", "cut off", "--recover"),
    REPLAY_EKF.format("damaged.mcap"): ("damaged.mcap", "--recover"),
    REPLAY_EKF.format("json.mcap"): ("json.mcap", "/robot1/odometry"),
    REPLAY_EKF.format("nan.mcap"): ("nan.mcap", "/robot1/odometry"),
    REPLAY_EKF.format("other-fields.mcap"): ("other-fields.mcap", "/robot1/odometry", "forward_mps"),
    # logs that an estimator cannot use
    REPLAY_EKF.format("other-schema.mcap"): ("other-schema.mcap", "does not fit", "odometry"),
    REPLAY_EKF.format("no-odometry.mcap"): ("no-odometry.mcap", "does not fit", "odometry"),
    REPLAY_EKF.format("no-prior.mcap"): ("no-prior.mcap", "does not fit", "prior"),
    REPLAY_EKF.format("no-landmarks.mcap"): ("no-landmarks.mcap", "does not fit", "landmarks"),
    REPLAY_EKF.format("no-range_bearing.mcap"): ("does not fit", "range_bearing"),
    REPLAY_EKF.format("empty-prior.mcap"): ("/robot1/prior", "prior"),
    REPLAY_EKF.format("bad-prior.mcap"): ("/robot1/prior", "positive definite"),
    REPLAY_EKF.format("still.mcap"): ("still.mcap", "no messages", "/robot1/odometry"),
    REPLAY_EKF.format("log.estimates.mcap"): ("does not fit", "the log has /estimates"),
    # several logs
    "replay log.mcap log.mcap -e ekf": ("log.estimates.mcap", "two logs"),
    "replay log.mcap moved/../log.mcap -e ekf": ("log.estimates.mcap", "two logs"),
    "replay two-robots.mcap log.mcap -e ekf --out new": ("log.mcap", "/robot2", "ensemble"),
    "replay log.mcap noisy.mcap -e ekf --out new": ("noisy.mcap", "/robot1/range_bearing", "ensemble"),
    "replay log.mcap other.mcap -e ekf --out new.mcap": ("--out new.mcap", "folder"),
    # estimates
    "evaluate zzz.mcap": ("zzz.mcap", "No such file"),
    "evaluate log.mcap": ("log.mcap", "no estimates", "fuselog replay"),
    "evaluate line.tum": ("line.tum", "not an MCAP", "with --truth"),
    "evaluate moved/log.estimates.mcap": ("moved/log.mcap", "is missing", "--log"),
    "evaluate log.estimates.mcap --log zzz.mcap": ("zzz.mcap", "No such file"),
    "evaluate log.estimates.mcap --log other.mcap": ("seed 0", "seed 1"),
    "evaluate log.estimates.mcap --log log.mcap --log log.mcap": ("1 estimates", "2 --log"),
    "record --again mrclam.mcap": ("mrclam.mcap", "No such file"),
    # real data
    "import score-matrices text.mcap": ("text.mcap", "not a folder"),
    "import mrclam zzz": ("zzz", "no such file or folder"),
    "import mrclam text.mcap": ("text.mcap", "not a folder"),
    "import mrclam folder": ("Barcodes.dat", "no such file"),
    "import mrclam mrclam --set sigma=1": ("importer mrclam", "'sigma"),
    "import mrclam mrclam-no-Barcodes": ("Barcodes.dat", "no such file"),
    "import mrclam mrclam-no-Landmark_Groundtruth": ("Landmark_Groundtruth.dat", "no such file"),
    "import mrclam mrclam-no-Robot1_Groundtruth": ("Robot1_Groundtruth.dat", "no such file"),
    "import mrclam mrclam-no-Robot1_Odometry": ("Robot1_Odometry.dat", "no such file"),
    "import mrclam mrclam-no-Robot1_Measurement": ("Robot1_Measurement.dat", "no such file"),
    "import mrclam mrclam-empty-Robot1_Groundtruth": ("Robot1_Groundtruth.dat", "no data"),
    "import mrclam mrclam-empty-Robot1_Odometry": ("Robot1_Odometry.dat", "no data"),
    "import mrclam mrclam-empty-Landmark_Groundtruth": ("Landmark_Groundtruth.dat", "no data"),
    "import mrclam mrclam-words": ("Robot1_Odometry.dat", "row 1", "fast, expected a number"),
    "import mrclam mrclam-columns": ("Robot1_Odometry.dat", "expected 3"),
    "import mrclam mrclam-ragged": ("Robot1_Odometry.dat", "columns"),
    "import mrclam mrclam-past": ("Robot1_Odometry.dat", "expected a time in seconds since 1970"),
    "import mrclam mrclam-nan": ("Robot1_Groundtruth.dat", "row 1", "nan"),
    "run mrclam --data folder": ("Barcodes.dat", "no such file"),
    # results
    "report": ("Missing argument 'RESULTS...'",),
    "report zzz": ("zzz", "no result.json", "fuselog run"),
    "report log.mcap": ("log.mcap", "no result.json"),
    "report result-garbled": ("result-garbled/result.json", "run the experiment again"),
    "report result-list": ("result-list/result.json", "not a result"),
    "report result-foreign": ("result-foreign/result.json", "'fuselog' is missing"),
    "report result-newer": (
        "result-newer/result.json",
        "a newer version of fuselog",
        "(format 2, this version reads 1)",
    ),
    "report result-older": ("result-older/result.json", "an older version of fuselog", "write it again"),
    "report result-damaged": ("result-damaged", "run the experiment again"),
    "diagnose log.mcap other.mcap -e ekf": ("2 logs", "give one log", "fuselog tune takes"),
    # where to write
    "record landmarks --out folder": ("'folder' is a directory",),
    "record landmarks --out /dev/null": ("/dev/null", "not a regular file"),
    "record landmarks --out /proc/x.mcap": ("/proc/x.mcap", "cannot be written"),
    "record landmarks --out text.mcap/x.mcap": ("text.mcap/x.mcap", "cannot be written"),
    "replay log.mcap -e ekf --out log.mcap": ("log.mcap", "would replace the log"),
    "replay log.mcap -e ekf --out /proc/x": ("/proc/x", "cannot be written"),
    # trajectory files, and estimates as trajectories
    "evaluate line.tum --truth zzz": ("zzz", "No such file"),
    "evaluate log.estimates.mcap --truth line.tum": ("log.estimates.mcap", "is not a text file"),
    "evaluate garbled.toml --truth line.tum": ("garbled.toml", "line 1 is not a pose", "12 numbers"),
    "evaluate line.tum --truth line.tum --truth-format kitti": ("line 1 has 8 columns", "kitti"),
    "evaluate line.tum line.tum --truth line.tum": ("line.tum", "one trajectory", "at a time"),
    "evaluate line.tum --truth line.tum --log log.mcap": (
        "--log",
        "--truth to trajectory files",
    ),
    "evaluate line.tum --truth line.tum --align se3": (
        "line.tum",
        "not on one line",
        "another alignment",
    ),
    "evaluate line.tum --truth line.tum --align se4": ("'se4'", "'sim3'"),
    "evaluate line.tum --truth line.tum --delta 0": ("delta is 0", "positive"),
    "evaluate line.tum --truth line.tum --delta 99": ("8 frames long", "delta smaller than 99"),
    "evaluate line.tum --truth line.tum --time-offset 99": ("has no stamps within", "within 0.01 s"),
    "evaluate line.tum --truth line.tum --time-offset soon": ("--time-offset", "soon"),
    "evaluate line.tum --truth line.tum --out folder": ("folder", "not a result of fuselog", "--out"),
    "evaluate log.estimates.mcap --format tum": ("--format", "trajectory files", "--truth"),
    "evaluate log.estimates.mcap --time-offset 1": ("--time-offset", "trajectory files"),
    "evaluate log.estimates.mcap --delta -1": ("delta is -1", "positive"),
    "evaluate log.estimates.mcap --out folder": ("folder", "not a result of fuselog", "--out"),
    "evaluate log.estimates.mcap --out /proc/x": ("/proc/x", "cannot be written"),
    "run landmarks --out folder": ("folder", "not a result of fuselog", "--out"),
    "run landmarks --out .": (".", "not a result of fuselog"),
    "run landmarks --out text.mcap": ("text.mcap", "is a file"),
    "run landmarks --out text.mcap/x": ("text.mcap/x", "cannot be written"),
    "run landmarks --out /proc/x": ("/proc/x", "cannot be written"),
    "report result --out folder": ("'folder' is a directory",),
    "report result --out /proc/x.html": ("/proc/x.html", "cannot be written"),
    # the timeline
    "view zzz": ("zzz", "No such file"),
    "view folder": ("folder/timeline.rrd",),
    "view text.mcap --save new.rrd": ("text.mcap", "not an MCAP"),
    "view log.mcap --save new.rrd --focus zzz": ("--focus zzz", "robot1"),
    "view log.mcap --connect zzz": ("zzz", "rerun+http://"),
}


def _listing(folder: Path) -> dict[str, int]:
    return {str(path): path.lstat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("arguments", TABLE)
def test_mistakes_are_one_sentence_and_change_nothing(
    arguments: str, world: Path, fuselog: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(world)
    before = _listing(world)
    said = fuselog(*arguments.split())
    assert said.code == 2
    assert said.out == ""
    sentence = said.err.removesuffix("\n")
    assert sentence.startswith("fuselog: ")
    assert "\n" not in sentence
    for words in TABLE[arguments]:
        assert words in sentence
    assert _listing(world) == before


@pytest.mark.parametrize(
    "arguments",
    [
        "replay empty-odometry.mcap -e ekf",
        "replay empty-range_bearing.mcap -e ekf",
        "replay empty-landmarks.mcap -e ekf",
        "replay empty-truth.mcap -e ekf",
        "replay no-truth.mcap -e ekf",
        "replay cut.mcap -e ekf --recover",
    ],
)
def test_what_is_poor_but_no_mistake_is_replayed(
    arguments: str,
    world: Path,
    fuselog: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No landmark seen, no truth, no odometry: there is less to say, and that is said."""
    monkeypatch.chdir(world)
    out = tmp_path / "estimates.mcap"
    said = fuselog(*arguments.split(), "--out", str(out))
    assert said.code == 0, said.err
    assert out.exists()


def test_a_tracebacks_place_is_shown_on_request(
    world: Path, fuselog: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "FUSELOG_TRACEBACK", "1")
    with pytest.raises(Exception, match="No such file"):
        fuselog("info", str(world / "zzz.mcap"))


@pytest.mark.parametrize("name", ["$\\foo$", "$\\frac{1}$", "a$b"])
def test_a_name_with_dollar_signs_is_drawn_as_it_is(
    name: str, fuselog: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matplotlib takes what stands between two of them for a formula, which this is none of."""
    monkeypatch.chdir(tmp_path)
    recording, run = record_run("landmarks", {"duration_s": 2.0}, 0)
    streams = [replace(each, topic=each.topic.replace("robot1", name)) for each in recording.streams]
    write_log("odd.mcap", streams, run)
    assert fuselog("replay", "odd.mcap", "-e", "ekf").code == 0
    said = fuselog("evaluate", "odd.estimates.mcap", "--out", "result")
    assert said.code == 0, said.err
    assert Path("result/figures").exists()
    assert fuselog("view", "odd.estimates.mcap", "--save", "odd.rrd").code == 0


@pytest.mark.parametrize("name", ["\0", "robot\x1b[31m"])
def test_a_topic_that_cannot_be_printed_is_refused(
    name: str, world: Path, fuselog: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Other writers take any name: it reaches no figure, no file name and no terminal."""
    monkeypatch.chdir(tmp_path)
    log = open_log(world / "log.estimates.mcap")
    with Path("odd.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, stream in read_streams(log, list(log.topics)).items():
            schema = stream.schema
            schema_id = writer.register_schema(schema.full_name, "protobuf", schema.descriptor_set)
            odd = topic.replace("robot1", name)
            channel = writer.register_channel(odd, "protobuf", schema_id, dict(stream.metadata))
            for row, time_ns in enumerate(stream.publish_time_ns.tolist()):
                values = {key: column[row].tolist() for key, column in stream.columns.items()}
                message = schema.message_class(**values).SerializeToString()
                writer.add_message(channel, time_ns, message, time_ns)
        writer.finish()
    for command in ("evaluate odd.mcap --log LOG --out result", "view odd.mcap --save odd.rrd"):
        said = fuselog(*command.replace("LOG", str(world / "log.mcap")).split())
        assert said.code == 2
        assert said.err.count("\n") == 1
        assert "its name has characters that cannot be printed" in said.err
        assert name not in said.err
