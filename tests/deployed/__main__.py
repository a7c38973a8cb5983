"""Deploys every model by every method that deploys, compiles it, and compares it with the replay.

By every compiler that is here, and with the sanitizers where it has them.

`python -m tests.deployed [MODEL or METHOD ...]` prints a line for every pair, of our models and those of
the pages; the exit code is 1 where one differs. `--keep` keeps all of it in docs/deploy.json, of which
the page's tables are made, with what filters of a robot take on the emulated target.
"""

import json
import subprocess
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from fuselog.pipeline.deploying.certificate import CERTIFICATE
from fuselog.recorders.errors import BadInput
from tests.claims.pages import DEPLOYED
from tests.deployed.building import COMPILERS, furthest_of_all, missing_of_target, on_target
from tests.deployed.hostile import hold_out_by_all
from tests.deployed.models import Tried, deployed, models, robot_log
from tests.deployed.mutants import ROBOT, mutants_of, survivors

METHODS = ("ekf", "iekf", "ukf", "lrkf:s2kf-25", "sqrt:ekf", "sqrt:ukf")
ON_TARGET = ("ekf", "ukf", "sqrt:ekf", "sqrt:ukf")
EQUAL = 1e-12  # how far the C may be from the replay, as a share of numbers that are larger than one
FLOAT = 1e-3  # the same in single precision


def costs(folder: Path) -> dict[str, Any]:
    """Read what a filter costs of its certificate."""
    certificate = json.loads((folder / CERTIFICATE).read_text(encoding="utf-8"))
    memory = {name: certificate["memory"][name] for name in ("text", "stack")}
    return {"states": certificate["states"], **certificate["worst"], **memory}


@click.command()
@click.argument("names", nargs=-1)
@click.option("--keep", is_flag=True, help="Keep all pairs in docs/deploy.json.")
def main(names: tuple[str, ...], keep: bool) -> None:
    """Deploy all pairs, or those of these models and methods."""
    if not COMPILERS:
        raise click.ClickException("there is no C compiler here")
    found: dict[str, dict[str, Any]] = {}
    unfit = wrong = 0
    with TemporaryDirectory() as place:
        folder = Path(place)
        for tried in models(folder):
            for method in METHODS:
                if names and not {tried.model, method} & {*names}:
                    continue
                began = time.perf_counter()
                try:
                    made = deployed(tried, method, folder)
                except BadInput as error:
                    fits = "lacks" not in str(error)
                    wrong, unfit = wrong + fits, unfit + 1 - fits
                    said = str(error).partition(".mcap: ")[2]
                else:
                    away, calls = furthest_of_all(made), hold_out_by_all(made)
                    wrong += not away <= EQUAL
                    found.setdefault(tried.model, {})[method] = {"furthest": away, **costs(made)}
                    said = f"furthest {away:.1e}, {calls} hostile calls"
                taken_s = time.perf_counter() - began
                click.echo(f"{taken_s:5.1f} s  {tried.model:26}{method:14}{said}")
        if not names:
            wrong += _tried_mutants(folder)
        pairs = [pair for each in found.values() for pair in each.values()]
        click.echo(f"{len(pairs)} pairs compared, {wrong} are not as they should be; {unfit} do not fit")
        if keep and not names and not wrong:
            _keep(found, unfit, folder)
    raise SystemExit(min(wrong, 1))


def _tried_mutants(folder: Path) -> int:
    """Count the errors of one character that the test of a robot's filter does not notice."""
    tried = Tried("robot", robot_log(folder), None, {"model": "robot", **ROBOT})
    made = deployed(tried, "ekf", folder / "mutants")
    planted = list(mutants_of((made / f"{made.name.lower()}.c").read_text(encoding="utf-8")))
    missed = survivors(made, planted)
    for each in missed:
        click.echo(f"not noticed in {each.function}: {each.line[0]} as {each.line[1]}")
    click.echo(f"{len(planted)} errors of one character planted, {len(missed)} not noticed")
    return len(missed)


def _keep(found: Mapping[str, Any], unfit: int, folder: Path) -> None:
    taken = {}
    if missing := missing_of_target():
        raise click.ClickException(f"there is no {missing} here, so that nothing is kept")
    tried = Tried("robot", robot_log(folder), None, {"model": "robot"})
    for method in ON_TARGET:
        for single in (False, True):
            place = folder / "target"
            place.mkdir(exist_ok=True)
            made = deployed(tried, method, place, single=single)
            row = on_target(made, FLOAT if single else EQUAL)
            taken[f"{method} {'float' if single else 'double'}"] = row._asdict()
            click.echo(f"robot {method}, {'float' if single else 'double'}: {row}")
    said = [["gcc", "-dumpfullversion"], ["gcc", "-dumpmachine"], ["arm-none-eabi-gcc", "-dumpversion"]]
    version, machine, arm = (
        subprocess.run(each, capture_output=True, text=True, check=True).stdout.strip() for each in said
    )
    kept = {
        "day": datetime.now(UTC).date().isoformat(),
        "compiler": f"gcc {version} for {machine} with -O2",
        "target_compiler": f"gcc {arm} for arm-none-eabi with -O2",
        "unfit": unfit,
        "pairs": found,
        "target": taken,
    }
    DEPLOYED.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    click.echo(f"kept in {DEPLOYED}")


if __name__ == "__main__":
    main()
