"""The table of what stress does to our own estimators: whole, explained, and as it comes out today."""

from tests.docs.stressed import PAGE, kept, rendered, shipped, stressed


def test_the_page_shows_what_is_kept_and_each_is_explained() -> None:
    page, rows = PAGE.read_text(encoding="utf-8"), kept()
    assert page == rendered(page, rows)
    assert "| `landmarks` | `ekf`" in page
    assert [row for row in rows if row.verdict != "harmless" and not row.why] == []
    there = {(row.experiment, row.estimator) for row in rows}
    wanted = {(name, label) for name, labels in shipped() for label in labels}
    assert wanted - there == {("set-filter", "filter"), ("set-filter", "filter-l8")}  # want their bounds
    assert there <= wanted


def test_a_few_come_out_as_they_are_kept() -> None:
    """One that is in proportion, one whose samples are random."""
    told = {(row.experiment, row.estimator): row for row in kept()}
    rows = stressed("reactor", ["analytic", "rukf-12"])
    for row in rows:
        assert row[:5] == told["reactor", row.estimator][:5]
    assert len(rows) == 2
