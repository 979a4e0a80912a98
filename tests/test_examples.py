"""The examples in the documentation of functions run, and give what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

import colmap_sph

PACKAGE = Path(colmap_sph.__file__).parent


def modules_with_examples() -> list[str]:
    files = sorted(path for path in PACKAGE.rglob("*.py") if ">>> " in path.read_text(encoding="utf-8"))
    names = (".".join(("colmap_sph", *path.relative_to(PACKAGE).with_suffix("").parts)) for path in files)
    return [name.removesuffix(".__init__") for name in names]


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_give_what_they_say(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0


def test_what_a_user_of_the_library_calls_first_has_an_example() -> None:
    shown = {name.removeprefix("colmap_sph.stereo.") for name in modules_with_examples()}
    assert {"partners.pairs", "rectification", "matching", "vote", "normals", "colmap_sph.scene"} <= shown
