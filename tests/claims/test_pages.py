"""README, pages and stored results agree: what one of them says and another does not is found here."""

import json
import re
from pathlib import Path

import pytest

from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.results import Outcome, result_folder, write_outcome
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.importers.tables.mapping import shipped as shipped_mappings
from tests.bench import __main__ as bench
from tests.claims import pages
from tests.docs.reference import PLACES

README = (pages.ROOT / "README.md").read_text(encoding="utf-8")
SYSTEMS = (pages.ROOT / "docs" / "papers" / "index.md").read_text(encoding="utf-8")
GENERATED = {"gallery.md", *PLACES}  # pages that the build adds
ONES = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven"]


@pytest.mark.parametrize("path", pages.PAGES, ids=lambda path: path.stem)
def test_a_page_says_what_the_results_say(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    assert pages.rendered(page) == page, "make docs makes it anew"
    prose = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", prose):
        assert (path.parent / link).exists() or link in GENERATED, link


def test_every_experiment_has_its_result_and_every_claim_its_page() -> None:
    """The results are of the experiments as they ship: a changed one is to be run again."""
    assert set(pages.stored()) == set(shipped("experiments"))
    templates = "".join(path.read_text(encoding="utf-8") for path in pages.PAGES)
    for name, result in pages.stored().items():
        experiment = pages.as_shipped(name)
        settings = experiment.model_dump(mode="json", by_alias=True, exclude_none=True)
        stated = {key: value for key, value in result.settings.items() if key != "parameters"}
        assert stated == settings, f"make docs-claims NAMES={name}"
        assert templates.count(f"{{{name}.claims}}") == (result.verdicts != "0, 0, 0, 0"), name


def test_verdicts_follow_from_the_numbers_that_are_kept() -> None:
    """Claims are made anew from the metrics of each stored result, by what its experiment states."""
    for name, result in pages.stored().items():
        assert pages.decided(name) == result.stated_claims, name
        refuted = [claim for claim in result.stated_claims if claim["verdict"] == "refuted"]
        assert all(claim["why"] for claim in refuted), name


def test_the_systems_are_all_there_and_counted() -> None:
    """The table of systems has every experiment with claims once, beside its own counts."""
    rows = re.findall(r"^\| .*?\| (`.*?) \| ([\d, ;]+) \|", SYSTEMS, re.MULTILINE)
    assert f"{ONES[len(rows)]} systems" in SYSTEMS.partition("\n")[0]
    assert f"{ONES[len(rows)]} published systems" in README
    named = []
    for experiments, counts in rows:
        names = re.findall(r"`(.*?)`", experiments)
        assert counts.split("; ") == [pages.stored()[name].verdicts for name in names], names
        named += names
    with_claims = {name for name, each in pages.stored().items() if each.verdicts != "0, 0, 0, 0"}
    assert sorted(named) == sorted(with_claims)
    demo = pages.as_shipped("landmarks")
    assert f"replays {ONES[len(demo.estimators)]} estimators" in README


def test_a_changed_result_changes_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    claims = [Claim("a | b", "1", "2", "refuted", "why"), Claim("c", "1", "1", "confirmed")]
    outcome = Outcome({"ekf.rmse_m": 0.25, "ekf.nees.case": [1.0, float("nan")]}, claims)
    with result_folder(tmp_path / "result") as folder:
        write_outcome(folder, "mine", {"seed": 3, "runs": 7, "data": "/home/me"}, outcome)
    monkeypatch.setattr(pages, "FOLDER", tmp_path / "kept")
    kept = json.loads(pages.store(tmp_path / "result").read_text(encoding="utf-8"))
    assert kept["settings"] == {"seed": 3, "runs": 7}
    assert "files" not in kept
    monkeypatch.setattr(pages, "stored", lambda: {"mine": pages.Stored(kept)})
    template = "{mine[ekf.rmse_m]:.2f} and {mine[ekf.nees.case][0]:.0f}\n\n{mine.claims}"
    text = pages.rendered(f"A\n<!-- results\n{template}\n-->\nold\n<!-- end -->\nZ")
    assert text.partition("-->\n")[2] == (
        "0.25 and 1\n\n"
        "`fuselog run mine` (seed 3, 7 runs): 1 confirmed, 1 refuted, 0 inconclusive, "
        "0 not reproducible.\n\n"
        "| claim | paper | ours | verdict |\n|---|---|---|---|\n"
        "| a \\| b | 1 | 2 | refuted: why |\n| c | 1 | 1 | confirmed |\n<!-- end -->\nZ"
    )
    assert pages.rendered(text) == text
    kept["metrics"]["ekf.rmse_m"] = 0.5
    assert "0.50 and 1\n" in pages.rendered(text)


def test_a_benchmark_is_kept_beside_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SPEED", tmp_path / "speed.json")
    bench.keep("phd", [["GM-PHD, us; a peer", "2", "6", "3 times"]])
    bench.keep("log", [["read: fuselog, mcap", "2", "8", "4.2"]])
    bench.keep("phd", [["GM-PHD, us; a peer", "2", "10", "5 times"]])
    speed = pages.Speed(json.loads((tmp_path / "speed.json").read_text(encoding="utf-8")))
    monkeypatch.setattr(pages, "speed", lambda: speed)
    template = "{speed[GM-PHD, us; a peer]:.0f} and {speed[read: fuselog, mcap]:.1f}, {speed.machine}"
    said = pages.rendered(f"<!-- results\n{template}\n-->\n<!-- end -->")
    assert f"-->\n5 and 4.2, {bench.machine()}\n" in said
    assert "cores" in bench.machine()


def test_the_data_sets_are_all_there() -> None:
    """Every experiment that imports data stands once in the table, every mapping in that of mappings."""
    catalogue = pages.Catalogue()
    imports = [name for name in shipped("experiments") if pages.as_shipped(name).import_]
    named = re.findall(r"`(?:fuselog run )?([a-z0-9-]+)(?: --data PATH)?`", catalogue.data_sets)
    assert sorted(named) == sorted(imports)
    assert re.findall(r"^\| `(.*?)`", catalogue.mappings, re.MULTILINE) == shipped_mappings()
    page = (pages.ROOT / "docs" / "your-log.md").read_text(encoding="utf-8")
    assert catalogue.data_sets in page
    assert catalogue.mappings in page
