"""The site is built as `make docs` builds it, and its notebooks run.

Tests import what builds and runs: every process of the suite reads this file.
"""

import re
from pathlib import Path

import pytest
from PIL import Image

from fuselog.pipeline.runs.inputs import shipped
from tests.docs import first_views, gallery, reference
from tests.replay.timeline.test_first_view import FIRST

ROOT = Path(__file__).parents[2]


@pytest.mark.paper
@pytest.mark.filterwarnings("default")
def test_the_site_is_built_without_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Links, anchors and pictures are there; no page fetches anything from elsewhere.

    As `mkdocs build --strict` builds it, in this process.
    """
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    from tests.docs import notebooks

    monkeypatch.chdir(ROOT)
    config = load_config(str(ROOT / "mkdocs.yml"), strict=True, site_dir=str(tmp_path))
    config.plugins.on_startup(command="build", dirty=False)
    build(config)  # strict: raises where anything is warned of
    pages = {path.relative_to(tmp_path).with_suffix("").as_posix() for path in tmp_path.rglob("*.html")}
    sources = {*(ROOT / "docs").rglob("*.md"), *notebooks.NOTEBOOKS}
    assert pages >= {path.relative_to(ROOT / "docs").with_suffix("").as_posix() for path in sources}
    for notebook in notebooks.NOTEBOOKS:
        page = tmp_path / "notebooks" / f"{notebook.stem}.html"
        links = re.findall(r'<a\b[^>]*\bhref="?([^"#> ]+)', page.read_text(encoding="utf-8"))
        local = {link for link in links if not re.match(r"\w+:|/", link)}
        assert local
        assert {link for link in local if not (page.parent / link).exists()} == set()
    commands = (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "fuselog replay run.mcap -e ekf" in re.sub(r"<[^>]+>", "", commands)


def test_what_a_page_must_not_have() -> None:
    from tests.docs import hooks

    for bad in (
        '<script src="https://cdn.org/a.js">',
        "<link href=//fonts.org/a.css>",
        '<img src="a.png">',
    ):
        with pytest.raises(Exception, match="page: <"):
            hooks.on_post_page(bad, page="page", config={})
    hooks.on_post_page(
        '<a href="https://rerun.io">, <img alt="a robot" src="a.png">', page="", config={}
    )


def test_links_of_notebooks_lead_to_pages() -> None:
    """As they stand they lead to the sources; one to a page that is not there stops the build."""
    from mkdocs.config import load_config
    from mkdocs.exceptions import PluginError
    from mkdocs.structure.files import File, Files
    from mkdocs.structure.pages import Page

    from tests.docs import hooks

    config = load_config(str(ROOT / "mkdocs.yml"))
    names = ["your-model.md", "notebooks/own-model.ipynb"]
    files = Files(
        [File(name, config.docs_dir, config.site_dir, use_directory_urls=False) for name in names]
    )
    notebook = files.get_file_from_path(names[1])
    assert notebook is not None
    page = Page(None, notebook, config)
    kept = '<a href="https://rerun.io/a.md"> <a href="#top">'
    source = f'<a href="../your-model.md#methods"> {kept}'
    pointed = hooks.on_page_content(source, page, config, files)
    assert pointed == f'<a href="../your-model.html#methods"> {kept}'
    with pytest.raises(PluginError, match=r"own-model.ipynb: links to ../my-model.md, which is no page"):
        hooks.on_page_content('<a href="../my-model.md">', page, config, files)


def test_the_gallery_has_every_experiment() -> None:
    page = gallery.gallery()
    for name in shipped("experiments"):
        assert len(re.findall(rf"`fuselog run {name}(?: --data FOLDER)?`", page)) == 1, name
    shown = {name: gallery.picture_of(name) for name in shipped("experiments")}
    assert [name for name, picture in shown.items() if picture is None] == [
        "false-causes",
        "faults-together",
    ]
    assert all(picture.is_relative_to(gallery.DOCS) for picture in shown.values() if picture)


def test_every_simulated_scenario_has_its_first_view() -> None:
    """Small enough to stay in the repository: all in less than 1.2 MB."""
    assert first_views.sections().keys() == FIRST.keys()
    pictures = [first_views.PICTURES / f"{name}.webp" for name in FIRST]
    assert {*first_views.PICTURES.iterdir()} == {*pictures}
    assert sum(picture.stat().st_size for picture in pictures) < 1_200_000
    for picture in pictures:
        with Image.open(picture) as image:
            assert image.size == first_views.SIZE


def test_the_reference_has_every_name() -> None:
    pages = reference.reference()
    for kind, (entries, _) in reference.KINDS.items():
        for entry in entries.values():
            assert f"\n## {entry.name}\n" in pages[f"reference/{kind}.md"]
    robot = pages["reference/models.md"].partition("## robot\n")[2].partition("\n## ")[0]
    assert "    | `gate_probability` | `0.999` |  | number > 0 <= 1 | measurements" in robot
    odometry = pages["reference/messages.md"].partition("## Odometry\n")[2]
    assert "| 2 | `forward_mps` | `optional double` |" in odometry


@pytest.mark.paper
@pytest.mark.usefixtures("blank_figures")
def test_notebooks_print_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the figures that the kernel of a notebook shows by itself."""
    import nbformat

    from tests.docs import notebooks

    for path in notebooks.NOTEBOOKS:
        kept = nbformat.read(path, as_version=4)
        for cell in kept.cells:
            cell["outputs"] = [
                each for each in cell.get("outputs", []) if each.output_type != "display_data"
            ]
        place = tmp_path / path.stem
        place.mkdir()
        monkeypatch.chdir(place)
        texts = [re.sub(r"\d+\.py", "cell.py", text) for text in notebooks.printed(kept)]
        assert texts
        assert notebooks.printed_here(path) == texts, f"{path.name}: python -m tests.docs.notebooks"
