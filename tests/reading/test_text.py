"""Numbers, words, JSON, YAML and tables of others."""

import json
import os
from pathlib import Path

import pytest
import yaml

from mvest.errors import GeometryError, InputError
from mvest.files import write_atomically
from mvest.reading.documents import parse_json, read_mapping, read_yaml
from mvest.reading.text import (
    MAX_LINE,
    check_words,
    number,
    one_line,
    read_bytes,
    read_columns,
    read_numbers,
    read_text,
    refusing,
)

ODD = ("", "1_0", "0x10", "nan", "1e309", "9" * 5000, "-2e9", "٣", "1,5", "1\n2")


@pytest.mark.parametrize("text", ODD)
def test_what_is_no_decimal_number_within_sense_is_refused(text):
    with pytest.raises(InputError, match="expected a finite number") as caught:
        number(text)
    assert len(str(caught.value)) < 100
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", ["a\ud800", "\x1b[2J", "\uffff", "a" * 20_001])
def test_words_that_no_output_can_hold_are_refused(text):
    with pytest.raises(InputError, match=r"U\+|characters"):
        check_words(text)


def test_words_and_lines():
    text = "größer,\n\tzweite Zeile \u202e \U0001f600"
    assert check_words(text) == text
    assert one_line("a\n b\x1b[2J\ud800\u202e" + "c" * 500, 20).isprintable()
    assert len(one_line("c" * 10**6)) == 300


def test_files_are_read_within_bounds(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf12")
    assert read_text(path) == "12"
    assert read_bytes(path, 5)
    with pytest.raises(InputError, match="5 bytes, expected at most 4"):
        read_bytes(path, 4)
    path.write_bytes(b"\xff")
    with pytest.raises(InputError, match="byte 0 is no UTF-8"):
        read_text(path)
    with pytest.raises(InputError, match="is missing"):
        read_text(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="no regular file"):
        read_text(tmp_path / "pipe")


@pytest.mark.parametrize(
    "text",
    [
        "{", "[" * 100_000, "NaN", "[1e999]", "-" + "1" * 5000, '"\\ud800"', '{"\\udfff": 1}',
    ],
)  # fmt: skip
def test_json_that_is_refused(text):
    with pytest.raises(InputError) as caught:
        parse_json(text, "it")
    assert str(caught.value).startswith("it is not JSON: ")
    assert len(str(caught.value)) < 200


def test_json_that_is_read(tmp_path):
    data = {"a": [1, 2.5e-300, None, True, "\U0001f600 \x1b"], "b": {}, "c": 2**64 - 1}
    (tmp_path / "a.json").write_text(json.dumps(data))
    assert read_mapping(tmp_path / "a.json") == data
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(InputError, match="holds a list, expected a mapping"):
        read_mapping(tmp_path / "a.json")


@pytest.mark.parametrize(
    "value",
    ["1" + "0" * 400, "1.0e+300", '"a\\uD800"', '"\\e[2J"', '"' + "a" * 20_001 + '"',
     "!!python/object:os.system a"],
)  # fmt: skip
def test_a_value_of_yaml_that_is_refused(tmp_path, value):
    path = tmp_path / "a.yaml"
    path.write_text(f"name: a\nframes:\n- time: {value}\n")
    with pytest.raises(InputError) as caught:
        read_yaml(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert "line 3" in said
    assert said.isprintable()
    assert len(said) - len(str(path)) <= 250


def test_plain_values_of_yaml_are_as_another_reader_has_them(tmp_path):
    text = (
        "a: 1\nb: -2.5\nc: 1.0e-3\nd: 1e-3\ne: yes\nf: ~\ng: [0, [x, {y: 1}]]\nh: '0x10'\n"
        "1: one\ni: |\n  two\n  lines\nj: ''\nk:\nl: \"1_0\"\nm: 0\nn: +.5\no: true\n"
    )
    (tmp_path / "a.yaml").write_text(text)
    assert read_yaml(tmp_path / "a.yaml") == yaml.safe_load(text)
    odd = ["0xfff", "190:20:30.15", "017", "1_0.5", "-.INF", ".nan", "2024-01-02"]
    (tmp_path / "a.yaml").write_text(f"a: [{', '.join(odd)}]")
    assert read_yaml(tmp_path / "a.yaml") == {"a": list(odd)}


@pytest.mark.parametrize(
    ("text", "words"),
    [("a: 1\n---\nb: 2\n", "single document"), ("- 1\n", "holds a list"), ("", "holds a NoneType"),
     ("a: [" + "0," * 60_000 + "0]\n", "more than 50000 values"), ("a: 1\na: 2\n", "occurs twice"),
     ("1: a\n1: b\n", "occurs twice"), ("a: " + "[" * 30, "20 deep"), ("a: &x 1\n", "anchors")],
)  # fmt: skip
def test_a_document_that_is_refused(tmp_path, text, words):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_yaml(tmp_path / "a.yaml")


def test_tables(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(' y , x \n\n 1,"2"\n3,4.5\n')
    assert read_numbers(path, ("x", "y")).tolist() == [[2, 1], [4.5, 3]]
    path.write_text("x,y\n1,2\n3,1_0\n")
    with pytest.raises(InputError, match=r"a\.csv: y of row 1"):
        read_numbers(path, ("x", "y"))
    for text, words in (
        ("x,y,z\n1,2,3\n", "columns x,y,z, expected x,y"), ("x,y\n", "no rows"), ("", "none"),
        ("x,y\n1,2,3\n", "row 0 has 3 cells"), ('x,y\n"1,2\n', "no comma-separated text"),
        ("x,y\na\x1bb,1\n", r"the character U\+001B"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_columns(path, ("x", "y"))


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (GeometryError("open"), GeometryError, "a.stl: open"),
        (RuntimeError("a\n\x1b[31m b"), InputError, "a.stl: damaged or no STL file: a �[31m b"),
        (GeometryError("/nowhere/a.stl: open"), GeometryError, "a.stl: open"),
    ],
)
def test_everything_becomes_one_line(error: Exception, kind: type, words: str) -> None:
    path = Path("/nowhere/a.stl")
    with pytest.raises(kind) as caught, refusing(path, "STL file"):
        raise error
    message = str(caught.value)
    assert message.startswith(f"/nowhere/{words}")
    assert message.count("nowhere") == 1
    assert len(message.removeprefix("/nowhere/")) <= MAX_LINE


def test_a_text_is_not_lost_for_one_character(tmp_path):
    write_atomically(tmp_path / "a.md", "1.5 ± 0.1 MPa, a\ud800b")
    assert (tmp_path / "a.md").read_text(encoding="utf-8") == "1.5 ± 0.1 MPa, a?b"
