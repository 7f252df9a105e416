"""Strict reading: every mistake is named by file and dotted key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import pytest

from uvgs_bench.errors import ConfigError
from uvgs_bench.store.documents import read_document, write_atomically


@dataclass(frozen=True, slots=True)
class Wheel:
    radius_mm: float
    kind: Literal["steel", "rubber"] = "steel"

    def __post_init__(self) -> None:
        if self.radius_mm <= 0:
            raise ValueError("radius must be positive")


@dataclass(frozen=True, slots=True)
class Cart:
    name: str
    wheels: tuple[Wheel, ...]
    hues: dict[str, float] | None = None


GOOD = 'schema = 1\nname = "c"\n[[wheels]]\nradius_mm = 3.5\n'


@pytest.fixture
def write(tmp_path):
    def _write(text: str):
        path = tmp_path / "cart.toml"
        path.write_text(text)
        return path

    return _write


def test_good_document(write):
    assert read_document(write(GOOD), Cart) == Cart("c", (Wheel(3.5),))


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        (GOOD.replace("radius_mm", "radius_m"), "wheels.0.radius_m", "did you mean 'radius_mm'"),
        (GOOD.replace("radius_mm", "colour"), "wheels.0.colour", "expected one of: radius_mm, kind"),
        (GOOD.replace("3.5", "-1.0"), "wheels.0", "radius must be positive"),
        (GOOD.replace("3.5", '"wide"'), "wheels.0.radius_mm", "expected a number"),
        (GOOD.replace('name = "c"', "name = 3"), "name", "valid string"),
        (GOOD.replace('name = "c"\n', ""), "name", "required"),
        (GOOD + 'kind = "wood"\n', "wheels.0.kind", "'steel' or 'rubber'"),
        (GOOD.replace("schema = 1", "schema = 9"), "schema", "expected 1"),
        (GOOD.replace("schema = 1", ""), "schema", "is missing"),
        (GOOD + "[hues]\nred = 'x'\n", "hues.red", "expected a number"),
    ],
)
def test_every_mistake_names_file_and_key(write, text, key, says):
    path = write(text)
    with pytest.raises(ConfigError) as caught:
        read_document(path, Cart)
    assert caught.value.path == str(path)
    assert caught.value.key == key
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_folder_and_broken_files_are_one_line(tmp_path, write):
    for path, says in [
        (tmp_path / "none.toml", "no such file"),
        (tmp_path, "is a folder"),
        (write("name = = 3"), "not valid TOML"),
    ]:
        with pytest.raises(ConfigError, match=says):
            read_document(path, Cart)
    binary = tmp_path / "b.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is no text"):
        read_document(binary, Cart)


def test_a_write_that_is_refused_leaves_the_old_file(tmp_path):
    path = tmp_path / "deep" / "a.txt"
    write_atomically(path, "one")
    with pytest.raises(ConfigError, match="--force"):
        write_atomically(path, "two", force=False)
    assert path.read_text() == "one"
    write_atomically(path, "two", force=True)
    assert path.read_text() == "two"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
