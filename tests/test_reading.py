"""What a file holds is what it has to be, or a message says where it is not."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from jaxtyping import Float
from msgspec import Meta

from doojax.reading import checked, parsed, read_arrays, read_json, read_lines


@dataclass(frozen=True)
class Part:
    count: Annotated[int, Meta(ge=1)]


@dataclass(frozen=True)
class Whole:
    part: Part
    length: float
    points: Float[np.ndarray, "N 3"] | None = None


SOUND = {"part": {"count": 2}, "length": 1}


def test_what_is_sound_is_taken():
    assert checked(SOUND, Whole) == Whole(Part(2), 1.0)
    assert checked({**SOUND, "points": np.zeros((4, 3))}, Whole).points.shape == (4, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": True}, "length is True, expected float, got bool"),
        ({"length": "1"}, "length is '1', expected float, got str"),
        ({"part": {"count": 0}}, "part.count is 0, expected int >= 1"),
        ({"part": {}}, "part: it lacks count"),
        ({"part": {"count": 1, "size": 2}}, "it has unknown part.size"),
        ({"width": 2}, "it has unknown width"),
        ({"points": np.zeros((4, 2))}, r"points is float64 \(4, 2\), expected "),
    ],
)
def test_what_is_not_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        checked({**SOUND, **change}, Whole)


def test_text_with_a_mark_without_one_and_in_another_encoding(tmp_path):
    file = tmp_path / "a.json"
    for start in (b"", b"\xef\xbb\xbf"):
        file.write_bytes(start + '{"name": "Ø"}'.encode())
        assert read_json(file, dict[str, str], "a name") == {"name": "Ø"}
    file.write_bytes('{"name": "Ø"}'.encode("cp1252"))
    with pytest.raises(ValueError, match=r"a\.json is not text in UTF-8 \(byte 10\)"):
        read_json(file, dict[str, str], "a name")


def test_json_that_is_nested_too_deep():
    with pytest.raises(ValueError, match="nested too deep"):
        parsed("[" * 1_000_000)


def test_a_line_that_is_being_written_is_left_out(tmp_path):
    file = tmp_path / "lines.jsonl"
    assert read_lines(file, dict[str, int], "a line") == []
    file.write_text('{"a": 1}\n{"a": 2')
    assert read_lines(file, dict[str, int], "a line") == [{"a": 1}]


def test_archives_that_are_none(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(file, header=np.frombuffer(b'{"x": 1}', np.uint8), points=np.zeros(3))
    assert read_arrays(file, "a record")[0] == {"x": 1}
    whole = file.read_bytes()
    for damaged in (b"", whole[:-40], whole[:60] + b"????" + whole[64:], b"PK\x03\x04"):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.npz is not a record \("):
            read_arrays(file, "a record")


def test_damaged_bytes_are_not_quoted_at_length(tmp_path):
    """The length of a name within the archive is damaged: zipfile says what it took for the name."""
    file = tmp_path / "one.npz"
    np.savez(file, header=np.frombuffer(b'{"x": 1}', np.uint8), numbers=np.zeros(4000))
    content = bytearray(file.read_bytes())
    content[27] = 6  # the high byte of the first name's length
    file.write_bytes(content)
    with pytest.raises(ValueError, match="is not a record") as raised:
        read_arrays(file, "a record")
    assert len(str(raised.value)) < 1000
