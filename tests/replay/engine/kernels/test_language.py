"""What a kernel may say, each in one small kernel: compiled it gives every bit of plain Python."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from fuselog.recorders.compiling.compile import compile_over_runs, compiled
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import varying

N = 4
REALS = np.array([[1.5, -2.0, 0.0, 3.25], [-0.5, 7.0, 1e-3, -1.0], [2.0, 2.0, -4.5, 0.25]])
WHOLES = np.array([[3, -7, 0, 2], [-5, 2, 4, -1], [1, 0, -2, 6]])
WORDS = WHOLES.astype(np.uint64)
TABLE = np.array([0.5, -1.0, 2.0, 8.0])
TABLE.setflags(write=False)
PAIRS = ((1, 0.5), (2, -1.5))


class Pair(NamedTuple):
    """Two numbers, and what they are called."""

    first: Any
    second: Any


class Given(NamedTuple):
    """What all kernels here read and fill."""

    x: np.ndarray
    k: np.ndarray
    words: np.ndarray
    out: np.ndarray


def branches(run: int, given: Given) -> None:
    x, k, out = given.x[run], given.k[run], given.out[run]
    if x[0] > 1.0:
        out[0] = 1.0
    elif k[0] == -5:
        out[0] = 2.0
    else:
        out[0] = 3.0
    if (x[1] > 0.0 and 1.0 / x[1] > 0.1) or not k[1]:
        out[1] = 4.0
    out[2] = 5.0 if x[2] < 0.0 < x[3] <= 3.25 != k[0] else k[3]
    if N == 4 and given.x.shape[1] == N:  # known
        out[3] = 6.0
    else:
        out[3] = undefined_name  # noqa: F821


def loops(run: int, given: Given) -> None:
    x, k, out = given.x[run], given.k[run], given.out[run]
    total, last = 0.0, -1
    for i in range(N):
        if k[i] < 0:
            continue
        for j in range(i, -1, -1):
            if x[j] > 2.0:
                break
            total += x[j]
            last = j
    out[0], out[1] = total, last
    rounds = 0
    while True:
        rounds += 1
        if rounds * rounds > 30 + k[0]:
            break
    out[2] = rounds + i  # the last round's
    left = 10.0
    while left > 0.0 and rounds > 0:
        left -= abs(x[0])
        rounds -= 1
    out[3] = left
    for place, (scale, shift) in enumerate(PAIRS):
        out[4 + place] = scale * x[place] + shift
    for a, b in zip((x[0], x[1]), (k[0], k[1]), strict=True):
        if a > b:
            out[6] += a * b


def widening(run: int, given: Given) -> None:
    """Integers that become real numbers, in a loop, in a branch, and as what is returned."""
    total = 0
    for i in range(N):
        total += given.x[run, i] if i > 1 else given.k[run, i]
    found = 1
    if given.k[run, 0] > 0:
        found = 0.5
    given.out[run, 0], given.out[run, 1] = total, found
    given.out[run, 2] = of_either(given.k[run, 1], given.x[run, 1])
    flag = given.x[run, 0] > 0
    flag = flag + 1
    if given.k[run, 1] > 0:
        flag = 0.5
    given.out[run, 3] = flag
    given.out[run, 4], given.out[run, 5] = both_of(given.k[run, 1], given.x[run, 1])


def of_either(k: Any, x: Any) -> Any:
    if k > 0:
        return k
    for i in range(3):
        if x < i:
            return 0.5 * i
    return x


def both_of(k: Any, x: Any) -> Any:
    if k > 0:
        return k, x
    return x, k


def shifted(pair: Pair, by: float = 1.0, *more: float) -> Pair:
    return pair._replace(second=pair.second + by * len(more))


def tuples(run: int, given: Given) -> None:
    x, k, out = given.x[run], given.k[run], given.out[run]
    pair = Pair(x[0], second=k[1])
    for _ in range(2):
        pair = Pair(pair.second, pair.first)
    pair = shifted(shifted(pair, 0.5, x[1], x[2]), by=2.0)
    (a, b), c = pair, x[2]
    both = (a, b) if a > b else (b, a)
    a, b = b, a
    numbers = (*both, a, b, 7)
    out[0], out[1] = both
    out[2] = numbers[2] + numbers[-1] + len(numbers) + sum_of(numbers[1:3]) + c
    out[3] = numbers[k[3] % 5]
    out[4] = (a, b) == (b, a) or (1, x[0]) != (1, x[0])
    out[5] = sum_of(tuple(each * x[i] for i, each in enumerate(numbers) if i < 3))
    out[6] = getattr(pair, "second") + PAIRS[1][1]  # noqa: B009


def sum_of(numbers: tuple[Any, ...]) -> Any:
    total = 0.0
    for each in numbers:
        total = total + each
    return total


def parts_of_arrays(run: int, given: Given) -> None:
    x, out = given.x, given.out[run]
    own = x[run]
    out[0] = own[-1] + own[given.k[run, 0] % 4 - 4] + x.T[1, run] + x[:, 2][run]
    tail = own[1:]
    head = own[: len(tail) - 1]
    out[1] = tail[-1] + head[0] + len(head) + own[-3:-1][1]
    out[2] = x[run:, 1:][0, 1] + x.shape[0] * x.shape[1] + tail.size
    out[3:5] = 7.0
    out[5:7] = own[:2]
    out[5] += own[2]
    out[-1] -= own[3]
    out[6] *= 2.0
    out[6] /= 4.0
    of_row = (own, 0)
    if own[0] > 0.0:
        of_row = (x[0], own[1])
    out[2] += of_row[0][1] * of_row[1]
    out[4] //= 2.0
    out[4] %= 2.5
    out[3] **= 2


def rows(run: int, given: Given) -> None:
    """Arithmetic of rows, element by element."""
    x, out = given.x, given.out[run]
    total = 0.0
    for k in (2, 0, 1):
        total += x[k] * (1.0 + k) - x[run] / 3.0
    out[:4] = total
    out[3:] = 2.0 - out[:4]
    out[1:3] -= -out[2:4] * x[run, 1:3]
    long = np.zeros((2, 9))
    long[0] += out[0]
    long[1] = long[0]
    out[6] = long[1, 8]


def own_arrays(run: int, given: Given) -> None:
    """Memory of known sizes: zeroed anew in every round, filled by another function."""
    out = given.out[run]
    for i in range(3):
        work = np.zeros((2, N))
        like = np.empty_like(work)
        fill(work[1], given.x[run])
        like[:] = work
        like[0] = float(i)
        work[0, i] += 1.0
        out[i] = like[0, 1] + work[1, i] + work[0, 0] + work.T[i, 1]
    whole = np.zeros(2, dtype=np.int64)
    whole[1] = given.k[run, 0]
    out[3] = whole[0] + whole[1]


def fill(target: np.ndarray, source: np.ndarray) -> None:
    for i in range(len(target)):
        target[i] = source[i] * 2.0


def constants(run: int, given: Given) -> None:
    out = given.out[run]
    out[0] = TABLE[given.k[run, 0] % 4] + TABLE[-1] + np.pi + float("inf")
    out[1] = (3.0, 1.0, 4.0, 1.5)[given.k[run, 0] % 4]
    out[2] = (3, 1, 4, 1)[given.k[run, 1] % 4] // 2
    out[3] = len("four") + bool(TABLE.shape == (4,)) + abs(-2) + min(3, 2.5) + max(1, 2) + 7 // 2 + 2**5


def integers(run: int, given: Given) -> None:
    a, b, out = given.k[run, 0], given.k[run, 1], given.out[run]
    c = b if b != 0 else 3
    out[0], out[1], out[2] = a // c, a % c, a / c
    out[3], out[4] = -a * b - a**3, (a & 6) | (b ^ 3)
    out[5] = (a << 2) + (b >> 1) + (a > b) + (a == b) * 2 + (not a)
    out[6] = abs(a) + min(a, b) + max(a, b, 2) + int(given.x[run, 3]) + np.sign(a)


def words(run: int, given: Given) -> None:
    """As a hash does: modulo 2 to the 64."""
    a = given.words[run, 0]
    a = a * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    a = a ^ (a >> np.uint64(33))
    b = a << np.uint64(13)
    given.words[run, 2] = a % np.uint64(1000) + b // np.uint64(3) + (a | b) - (a & b)
    given.out[run, 0] = a >> np.uint64(11)
    given.out[run, 1] = float(a > b) + (a == a)


def early(run: int, given: Given) -> None:
    if given.k[run, 0] < 0:
        return
    given.out[run, 0] = 1.0
    for i in range(N):
        if given.x[run, i] < 0.0:
            given.out[run, 1] = i
            return
    given.out[run, 2] = 5.0


def chosen_by(flag: bool) -> Callable[..., Any]:
    """A closure: of what is known one side is left."""

    def scaled(x: Any, scale: float | None = None) -> Any:
        if scale is None:
            return x
        return x * scale if flag else x - scale

    return scaled


TIMES, MINUS = chosen_by(True), chosen_by(False)


@compiled
def served(x: float) -> float:
    return x + 0.125


def calls(run: int, given: Given) -> None:
    x, out = given.x[run], given.out[run]
    out[0], out[1], out[2] = TIMES(x[0]), TIMES(x[0], 3.0), MINUS(x[0], scale=3.0)
    for i, function in enumerate((TIMES, MINUS)):
        out[3 + i] = function(x[1], 0.5)
    out[5] = served(x[2])


KERNELS = (
    branches,
    loops,
    widening,
    tuples,
    parts_of_arrays,
    rows,
    own_arrays,
    constants,
    integers,
    words,
    early,
    calls,
)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.__name__)
@pytest.mark.parametrize("checked", ["0", "1"])
def test_compiled_gives_every_bit_of_plain_python(
    kernel: Callable[..., None], checked: str, monkeypatch: pytest.MonkeyPatch
):
    """Also where its indices are checked."""
    monkeypatch.setenv("FUSELOG_BOUNDSCHECK", checked)
    plain, found = (Given(REALS.copy(), WHOLES.copy(), WORDS.copy(), np.zeros((3, 7))) for _ in range(2))
    with np.errstate(all="ignore"):
        for run in range(3):
            kernel(run, plain)
    compile_over_runs(kernel)(3, found)
    for name, expected, got in zip(Given._fields, plain, found, strict=True):
        assert got.tobytes() == expected.tobytes(), (name, got, expected)


# --- arguments ---------------------------------------------------------------------------------------


@varying(1, map=2)
class Scene(NamedTuple):
    """Arrays that vary in one and in two of their first axes."""

    rows: np.ndarray
    map: np.ndarray


def summing(run: int, scene: Scene, scale: Any, flag: Any, out: np.ndarray) -> None:
    total = 0.0
    for i in range(scene.map.shape[1]):
        total += float(scene.map[run, i]) * (scale if flag else 1)
    out[run] = total + scene.rows[run, -1]


def test_arrays_of_any_size_layout_and_kind_are_read_as_they_lie():
    loop = compile_over_runs(summing)
    grid = np.arange(-20, 20).reshape(5, 8)
    for laid in (grid, grid[:, ::2], grid[::-1, ::-1], grid.T[:5], np.asfortranarray(grid)):
        for dtype in ("f8", "i8", "i4", "u4", "i1", "u1", "?"):
            array = laid.astype(dtype, order="K")[:, 1:]
            for scale, flag in ((2, True), (0.5, np.True_), (np.int64(3), False), (np.float64(3), 1)):
                rows = np.zeros((5, len(dtype) + 2)) + 0.25
                out, expected = np.zeros(5), np.zeros(5)
                loop(5, Scene(rows, array), scale, flag, out)
                for run in range(5):
                    summing(run, Scene(rows, array), scale, flag, expected)
                assert out.tolist() == expected.tolist(), (dtype, array.strides)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros(2, np.float32),
        np.zeros(2, complex),
        np.zeros(2, ">f8"),
        np.zeros(2, "i4,f8")["f1"],
        np.array([None, 1.0]),
        [1.0, 2.0],
        "text",
    ],
    ids=lambda wrong: getattr(wrong, "dtype", type(wrong)),
)
def test_what_a_kernel_does_not_take_is_refused(wrong: Any):
    """Also where one of the same kind in this machine's order was given before."""
    loop, out = compile_over_runs(early_of), np.zeros(2)
    loop(2, np.zeros(2), out)
    with pytest.raises(BadInput, match=r"a kernel takes (64-bit )?numbers"):
        loop(2, wrong, out)


def early_of(run: int, values: Any, out: np.ndarray) -> None:
    out[run] = values[run]


# --- what is refused ---------------------------------------------------------------------------------


def with_try(run: int, out: np.ndarray) -> None:
    try:
        out[run] = 1.0
    finally:
        pass


def with_growth(run: int, out: np.ndarray) -> None:
    work = np.zeros(run)
    out[run] = work[0]


def made(number: float) -> np.ndarray:
    array = np.zeros(3)
    array[0] = number
    return array


def with_returned_memory(run: int, out: np.ndarray) -> None:
    out[run] = made(out[run])[0]


def with_a_list(run: int, out: np.ndarray) -> None:
    out[run] = [1.0, 2.0][0]


def with_itself(run: int, out: np.ndarray) -> None:
    with_itself(run, out)


CHANGING = np.zeros(3)


def with_what_could_change(run: int, out: np.ndarray) -> None:
    out[run] = CHANGING[0]


def with_a_sum(run: int, out: np.ndarray) -> None:
    out[run] = np.sum(out)


def with_two_kinds(run: int, out: np.ndarray) -> None:
    found: Any = 1.0
    if run > 3:
        found = (1.0, 2.0)
    out[run] = found


def with_mixed_signs(run: int, out: np.ndarray) -> None:
    out[run] = np.uint64(run) + run


def with_a_real_range(run: int, out: np.ndarray) -> None:
    for _ in range(2.7):
        out[run] += 1.0


def with_a_measured_range(run: int, out: np.ndarray) -> None:
    for _ in range(1, out[run]):
        out[run] += 1.0


def with_rows_of_two_sizes(run: int, out: np.ndarray) -> None:
    own = np.zeros(3)
    own[:2] = own + np.zeros(2)


def with_a_root_of_a_row(run: int, out: np.ndarray) -> None:
    own = np.zeros(3)
    own[:] = np.sqrt(own)


def with_a_row_as_truth(run: int, out: np.ndarray) -> None:
    if np.zeros(3) + 1.0:
        out[run] = 1.0


REFUSED = {
    with_rows_of_two_sizes: "rows of different sizes",
    with_a_root_of_a_row: "a number is needed, not a row of an array",
    with_a_row_as_truth: "an array is neither true nor false",
    with_try: "a kernel has no try statements",
    with_growth: "an array that is created here needs known sizes; pass it as scratch",
    with_returned_memory: "it returns an array that it created; pass it an array to fill",
    with_a_list: "a kernel has no List",
    with_itself: "with_itself calls itself",
    with_what_could_change: "a kernel uses an outside array that could change; pass it as an argument",
    with_a_sum: "a kernel that creates no arrays cannot call sum, which needs allocates=True",
    with_two_kinds: "found is a tuple here and a Number before",
    with_a_real_range: r"range\(2.7\) accepts only integers; convert them with int\(\)",
    with_a_measured_range: r"range\(1, out\[run\]\) accepts only integers",
    with_mixed_signs: "signed and unsigned integers are mixed; convert one of them",
}


@pytest.mark.parametrize("kernel", REFUSED, ids=lambda kernel: kernel.__name__)
def test_what_a_kernel_cannot_say_is_told_with_its_line(kernel: Callable[..., None]):
    with pytest.raises(BadInput, match=REFUSED[kernel]) as refused:
        compile_over_runs(kernel)(2, np.zeros(2))
    said = str(refused.value)
    assert "\n" not in said
    assert "test_language.py, line " in said or "calls itself" in said


# --- indices beyond an array -------------------------------------------------------------------------


def at(values: np.ndarray, place: Any) -> Any:
    return values[place]


def looking(run: int, values: np.ndarray, place: int, out: np.ndarray) -> None:
    for i in range(2):
        out[run] += at(values[run], place + i)
    out[run] += values[run, 0]


@pytest.mark.parametrize(("place", "rows"), [(3, 3), (-5, 3), (10**12, 3), (0, 2), (0, 0)])
def test_with_the_check_an_index_beyond_an_array_is_an_index_error(
    place: int, rows: int, monkeypatch: pytest.MonkeyPatch
):
    """In what a kernel calls and in itself, of an empty array too; nowhere where all are inside."""
    monkeypatch.setenv("FUSELOG_BOUNDSCHECK", "1")
    loop, out = compile_over_runs(looking), np.zeros(3)
    loop(3, REALS, 2, out)
    assert out.tolist() == (REALS[:, 2] + REALS[:, 3] + REALS[:, 0]).tolist()
    where = "at" if rows == 3 else "looking"
    with pytest.raises(IndexError, match=rf"in {where} \(.*test_language\.py, line \d+\)"):
        loop(3, REALS[:rows], place, out)
