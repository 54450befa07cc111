"""Numbers in text: the parser in C++ reads the float64 that Python reads, bit for bit, or nothing; the writer in C++
writes what Python writes."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import geokit as gk
from geokit.formats.text_files import decimal
from geokit.formats.text_files.decimal import ROWS, parse, written_lines, written_rows
from geokit.native.parsers import extension
from geokit.native.parsers.extension import parsers
from geokit.points import _io as io
from tests.support.effort import of_all

pytestmark = pytest.mark.skipif(parsers() is None, reason="built without a compiler")

WORDS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(allow_nan=False, allow_infinity=False, width=32).map(lambda value: f"{value:.9g}"),
    st.integers(-(10**40), 10**40).map(str),
    st.from_regex(r"[+-]?[0-9]{1,30}(\.[0-9]{0,30})?([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    st.from_regex(r"[+-]?\.[0-9]{1,25}([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    # Halfway between two float64 numbers, where the next digit decides or evenness does.
    st.integers(2**53, 2**54 - 1).map(lambda value: f"{2 * value + 1}e0"),
    st.tuples(st.integers(2**53, 2**54 - 1), st.integers(0, 22)).map(
        lambda pair: f"{(2 * pair[0] + 1) * 10 ** pair[1]}"
    ),
)


def bits(values) -> np.ndarray:
    return np.asarray(values, np.float64).ravel().view(np.uint64)


@pytest.mark.slow
@settings(max_examples=of_all(40, 150), deadline=None)
@given(st.lists(WORDS, min_size=1, max_size=40), st.integers(1, 3), st.sampled_from([" ", "\t", ",", " ; "]))
def test_each_number_is_the_one_that_python_reads(words, columns, separator):
    words = words[: max(len(words) // columns, 1) * columns]
    columns = min(columns, len(words))
    lines = [separator.join(words[at : at + columns]) for at in range(0, len(words), columns)]
    text = "\n".join(lines).encode()
    # Chunks shorter than a line, too.
    for chunk in (7, 64, 1 << 18):
        table = parse(text, 0, len(text), chunk)
        assert table.shape == (len(lines), columns)
        np.testing.assert_array_equal(bits(table), bits([float(word) for word in words]))


def test_hundred_thousand_numbers_of_every_size():
    chance = random.Random(4)
    words = [repr(struct.unpack("<d", struct.pack("<Q", chance.getrandbits(64)))[0]) for _ in range(60_000)]
    words += [f"{chance.gauss(0, 1):.{chance.randrange(25)}e}" for _ in range(40_000)]
    words = [word for word in words if word not in ("nan", "inf", "-inf")]
    words = words[: len(words) // 4 * 4]
    text = "\n".join(" ".join(words[at : at + 4]) for at in range(0, len(words), 4)).encode()
    table = parse(text, 0, len(text), 4096)
    np.testing.assert_array_equal(bits(table), bits(list(map(float, words))))


@pytest.mark.parametrize(
    "word",
    [
        "0",
        "-0",
        "0e999999999",
        "1e309",
        "-1e309",
        "1e-400",
        "4.9e-324",
        "2.4703282292062327e-324",
        "1.7976931348623159e308",
        "2.2250738585072011e-308",
        "9007199254740993",
        "9007199254740993." + "0" * 30 + "1",
        "0." + "0" * 400 + "1e400",
        "1" + "0" * 300,
        "1" * 400,
        "8.5e22",
        "1e23",
        "99999999999999974834176",
        "+1.",
        ".5",
        "1E+2",
    ],
)
def test_numbers_at_the_edges(word):
    assert bits(parse(word.encode(), 0, len(word))).tolist() == bits(float(word)).tolist()


def test_words_for_no_number():
    assert np.isnan(parse(b"nan NaN -nan 1", 0, 14)).tolist() == [[True, True, True, False]]


@pytest.mark.parametrize(
    "text",
    [
        b"1 2 x",
        b"1 2 1_0",
        b"1 2 0x10",
        b"1 2\n3 4 5",
        b"1 2\n3",
        b"1,2\n3 4",
        b"1,,2",
        b"1,2,",
        b"1 2 # more",
        b"1 2 inf",
        b"1 2e",
        b"1 e2",
        b"1 .",
        b"1 -",
        b"1 2-3",
        b"1 2\r3 4\n",
        b"1 2\x003",
        b"1 2\x0b3 4",
        b"\xff 1",
        b"1 2na",
    ],
)
def test_what_is_out_of_the_ordinary_is_left_alone(text):
    assert parse(text, 0, len(text)) is None


@pytest.mark.parametrize("text", [b"", b"\n\n", b" \r\n"])
def test_nothing(text):
    assert parse(text, 0, len(text)) is None


def test_blank_lines_and_carriage_returns():
    text = b"\r\n1 2\r\n\n  \t\r\n 3\t4 \r\n5 6"
    for chunk in range(1, len(text) + 1):
        assert parse(text, 0, len(text), chunk).tolist() == [[1, 2], [3, 4], [5, 6]]
    # A part of it: the line that is begun and the one that is not finished count as they are.
    assert parse(text, 4, len(text) - 3, 4) is None
    assert parse(text, 9, len(text) - 3, 4).tolist() == [[3, 4]]


@pytest.mark.slow
def test_damaged_text_is_read_as_python_reads_it_or_not_at_all():
    chance = random.Random(9)
    whole = "\n".join(
        f"{chance.gauss(0, 1)!r} {chance.gauss(0, 1e6):.3f} {chance.randrange(99)}" for _ in range(40)
    ).encode()
    answered = 0
    for _ in range(800):
        copy = bytearray(whole)
        for _ in range(chance.randrange(1, 4)):
            copy[chance.randrange(len(copy))] = chance.choice(b"0123456789.-+eE \n\t,;\r#nax\x00\xff")
        table = parse(bytes(copy), 0, len(copy), chance.choice((16, 100, 1 << 18)))
        if table is None:
            continue
        answered += 1
        rows = [[float(word) for word in line.split()] for line in bytes(copy).split(b"\n") if line.strip()]
        np.testing.assert_array_equal(table, rows)
    assert 80 < answered < 720


def written(*tables, **options) -> list[str]:
    return b"".join(written_lines(*tables, **options)).decode().splitlines()


@given(st.lists(st.floats(), min_size=1, max_size=40))
def test_each_number_is_written_as_python_writes_it(values):
    assert written(np.array(values)) == list(map(repr, values))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_numbers_written_next_to_powers(sign):
    twos = np.ldexp(1.0, np.arange(-1074, 1024))
    tens = np.array([float(f"{digits}e{power}") for digits in (1, 2, 12, 99) for power in range(-323, 307)])
    values = sign * np.concatenate([twos, np.nextafter(twos, 0), np.nextafter(twos, np.inf), tens, [np.inf, np.nan]])
    assert written(values) == list(map(repr, values.tolist()))


def test_columns_of_every_kind_written_side_by_side(monkeypatch):
    # Several parts, in their order, the last one short; the same without the extension.
    rows = 2 * ROWS + 3
    chance = np.random.default_rng(5)
    whole = chance.integers(-(2**63), 2**63 - 1, (rows, 2))
    columns = (chance.normal(size=(rows, 3)), whole, whole[:, 0].view(np.uint64), whole[:, 0] < 0)
    short = chance.normal(size=(rows, 2)).astype(np.float32)
    found = written(*columns, short, prefix="a ", separator=",")
    for at in (0, 1, ROWS - 1, ROWS, rows - 1):
        floats, numbers, plain, sign = (column[at].tolist() for column in columns)
        assert found[at] == "a " + ",".join(map(repr, [*floats, *numbers, plain, int(sign), *short[at].tolist()]))
    assert len(found) == rows
    assert b"".join(written_rows("<{}/{}>", whole[:2])).decode() == "".join("<{}/{}>".format(*row) for row in whole[:2])
    monkeypatch.setattr(extension, "parsers", lambda: None)
    assert written(*columns, short, prefix="a ", separator=",") == found


@pytest.mark.parametrize(("pattern", "room"), [(b"\0 \0", 1000), (b"\0 \0 \1", 2 * 77 - 1)])
def test_the_writer_refuses_what_does_not_fit(pattern, room):
    with pytest.raises(ValueError, match="pattern"):
        parsers().write_rows(np.zeros((2, 3), np.uint64), pattern, np.empty(room, np.uint8))


@pytest.mark.parametrize("kind", ["xyz", "csv", "pts", "pcd", "ply"])
def test_files_long_enough_for_the_parser(kind, tmp_path, monkeypatch):
    # The same file by either way, and the same complaint about damage.
    random_ = np.random.default_rng(2)
    points = random_.normal(size=(500, 3))
    path = tmp_path / f"a.{kind}"
    if kind == "ply":
        head = "ply\nformat ascii 1.0\nelement vertex 500\nproperty double x\nproperty double y\nproperty double z\n"
        rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
        path.write_text(f"{head}element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}3 0 1 2\n")
    else:
        io.save(path, points, encoding="ascii" if kind == "pcd" else None)
    used = []

    def spy(*arguments):
        used.append(parse(*arguments))
        return used[-1]

    monkeypatch.setattr(decimal, "parse", spy)
    monkeypatch.setattr(decimal, "SMALLEST", 100)
    monkeypatch.setattr("geokit.formats.ply.SMALLEST", 100)
    np.testing.assert_array_equal(io.load(path).points, points)
    assert len(used) == 1
    assert used[0].shape == (500, 3)
    whole = path.read_bytes()
    broken = whole[: len(whole) // 2] + b"x" + whole[len(whole) // 2 :]
    path.write_bytes(broken)
    with pytest.raises(gk.FileFormatError) as quick:
        io.load(path)
    monkeypatch.setattr(decimal, "SMALLEST", 1 << 40)
    monkeypatch.setattr("geokit.formats.ply.SMALLEST", 1 << 40)
    with pytest.raises(gk.FileFormatError) as slow:
        io.load(path)
    assert str(quick.value) == str(slow.value)
    assert "x" in str(quick.value)
