"""The sentences that commands print: one script over a few small logs, its output by command.

Tables are left out: which number stands under which heading is tested in
`tests/pipeline/test_known_answers.py`.
"""

import io
import logging
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

from fuselog.pipeline.command_line import main
from fuselog.pipeline.output import terminal

ROOT = Path(__file__).parents[2]
PAGES = ("page.html", "pages.html")
# In this order: what a line writes, later ones read. Of a line that is wrong its error is kept.
SCRIPT = """
record landmarks --set duration_s=5 --set landmarks=4 -o run.mcap
record landmarks --set duration_s=5 --set landmarks=4 --seed 1 -o other.mcap
record navigation --set duration_s=11 --set unit.rate_hz=20 -o car.mcap
replay run.mcap -e ekf -e ukf -o est.mcap
replay other.mcap -e ekf --set sigma_range_m=0.02 -o sure.mcap
replay run.mcap -e ekf -e dead-reckoning -o wide.mcap --set ekf.sigma_bearing_rad=0.1 --parameters
evaluate est.mcap
evaluate line.tum --truth shifted.tum
compare run.mcap other.mcap -e ekf -e ukf --out compared
compare est.mcap sure.mcap
compare est.mcap wide.mcap -e ekf
diagnose run.mcap -e ekf --out diagnosed
diagnose run.mcap -e ekf --set /robot1/odometry.forward_mps_scale=1.3 --tried
stress run.mcap -e ekf
observability run.mcap
explore run.mcap -e ekf -e ukf -e iekf
explore run.mcap -e network
calibrate run.mcap -e ekf
deploy run.mcap -e smoother:ekf -o never
noise run.mcap
ellipsoid car.mcap --field /body/inertial.specific_force_mps2
ellipsoid car.mcap --field /body/inertial
check run.mcap --against ekf.golden.xz --update -e ekf
check run.mcap --against ekf.golden.xz
check other.mcap --against ekf.golden.xz
info run.mcap
info est.mcap
info car.mcap --all
lint run.mcap
lint car.mcap --set /body/inertial.specific_force_scale=0.102
cut run.mcap --start 1 --end 3 -o cut.mcap
relabel other.mcap --topic /=/b/ -o b.mcap
merge run.mcap b.mcap --offset b.mcap=-0.5 -o both.mcap
merge run.mcap other.mcap -o never.mcap
constrain car.mcap -o constrained.mcap --set rolling_hz=10
export est.mcap --to tum -o tum
import table drive.csv --guess -o mapping.toml
import table drive.csv --mapping mapping.toml -o drive.mcap
run landmarks --runs 2 --set duration_s=5 --out result
report result -o page.html
info result
sweep landmarks --runs 2 --set duration_s=5 --over range_bearing.sigma_range_m=0.1,0.2 --out swept
report compared diagnosed swept -o pages.html
view run.mcap --save view.rrd
view view.rrd --start 1
catalog run.mcap other.mcap drive.csv -o logs.parquet
catalog logs.parquet --where seed<1
catalog logs.parquet --where sed<1
replay logs.parquet -e ekf -o replayed
compare logs.parquet -e ekf -e ukf --out both
lint logs.parquet --where seed<1 --out linted
diagnose logs.parquet --where seed<1 -e ekf --out diagnoses
check logs.parquet --against ekf.golden.xz --out checked
run logs.parquet -e ekf --out ran
""".strip().splitlines()


def texts(folder: Path) -> dict[str, str]:
    """The sentences of every command in an empty folder; it is left there what they write."""
    found = defaultdict[str, list[str]](list)
    with chdir(folder), _alike():
        _write_files()
        for line in SCRIPT:
            command, *others = line.split()
            found[command].append(_said([command, *others]))
        said: set[str] = set()
        for name in PAGES:
            assert Path(name).is_file(), "\n".join(each for those in found.values() for each in those)
            lines = [*_page(Path(name).read_text(encoding="utf-8"))]
            found["report"].append(
                f"# {name}\n" + "\n".join(each for each in lines if each not in said) + "\n"
            )
            said.update(lines)
    return {command: "\n".join(sections) for command, sections in found.items()}


@contextmanager
def _alike() -> Iterator[None]:
    """Make a machine's own width, cache and time of no account."""
    width = terminal.out.width
    terminal.out.width = terminal.err.width = 1000
    try:
        with patch.object(terminal, "TOLD_EVERY_S", 1e9):
            yield
    finally:
        terminal.out.width = terminal.err.width = width


def _said(arguments: list[str]) -> str:
    """A command, and below it what it prints; lines of standard error begin with a bar."""
    out, err = io.StringIO(), io.StringIO()
    cache = {"FUSELOG_CACHE": "empty"} if arguments[0] == "cache" else {}
    logs = patch.object(logging.getLogger(), "handlers", [])  # so that the command makes its own
    with redirect_stdout(out), redirect_stderr(err), patch.dict(os.environ, cache), logs:
        code = main(arguments)
    lines = [f"$ fuselog {' '.join(arguments)}" + (f"   # exit code {code}" if code else "")]
    lines += [
        *_masked(out.getvalue()).splitlines(),
        *(f"| {each}" for each in err.getvalue().splitlines()),
    ]
    return "\n".join(each.rstrip() for each in lines) + "\n"


def _masked(text: str) -> str:
    """A text without tables, and what is of this machine: how long it took, where it is, its version."""
    text = re.sub(r"^ .*\n─+\n(?: .*\n(?!─))*", "", text, flags=re.MULTILINE)
    text = re.sub(r"\d[\d.,]* [mµ]?s per message", "TIME per message", text)
    text = re.sub(r"a run takes (\d[\d.,]* times )?as long", "a run takes RATIO times as long", text)
    text = re.sub(r"(fuselog \S+, input )[0-9a-f]+", r"\1SHA-256", text)
    return text.replace(str(ROOT), "ROOT").replace(f"fuselog {version('fuselog')}", "fuselog VERSION")


def _page(page: str) -> Iterator[str]:
    """What a page says, without its scripts, styles, figures, tables and settings."""
    text = re.sub(r"<(script|style|svg|title|table|pre)\b.*?</\1>", "", page, flags=re.DOTALL)
    lines = (re.sub(r"<[^>]*>", "", line).strip() for line in text.splitlines())
    yield from filter(None, map(_masked, lines))


def _write_files() -> None:
    """Trajectories and a table that commands of the script read."""
    for name, apart in (("line.tum", 0.0), ("shifted.tum", 0.01)):
        rows = (f"{time} {time + apart * (time % 3) ** 2} {apart} 0 0 0 0 1\n" for time in range(9))
        Path(name).write_text("".join(rows), encoding="utf-8")
    rows = (
        f"{10 + 0.1 * n:.1f},{0.2 * n:.2f},{1 + 0.1 * n:.2f},{2 + (n % 3) * 0.01:.2f}" for n in range(40)
    )
    head = "time_s,x_m,y_m,speed_mps"
    Path("drive.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
