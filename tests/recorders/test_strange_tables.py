"""Tables as strangers write them: read right, or refused, or under an assumption that is stated."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.recorders.strange_tables import draw, judge


def test_no_table_is_read_wrongly_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    verdicts, wrong = Counter[str](), []
    for _ in range(60):
        drawn = draw(tmp_path, rng)
        verdict, why = judge(drawn)
        drawn.path.unlink()
        verdicts[verdict] += 1
        wrong += [f"{drawn.choices}: {why}"] if verdict == "wrong" else []
    with capsys.disabled():
        print(f"\ntables read right without a question: {verdicts['right']} of 60")
    assert not wrong
    assert verdicts["right"] >= 54
