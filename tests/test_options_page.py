"""docs/options.md says what the code says."""

import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from colmap_sph.app.option_list import option_groups
from colmap_sph.app.run_command import RunCommand


@pytest.mark.usefixtures("scripts_on_path")
def test_the_page_of_options_is_current() -> None:
    docs = importlib.import_module("make_option_docs")
    assert docs.PAGE.read_text(encoding="utf-8") == docs.page(), "run python scripts/make_option_docs.py"


def stated_defaults() -> Iterator[tuple[str, str]]:
    """Flags and defaults in the tables of options of README and usage.md."""
    root = Path(__file__).resolve().parents[1]
    for document in (root / "README.md", root / "docs/usage.md"):
        place = 0
        for line in document.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.split("|")]
            if not line.startswith("|"):
                place = 0
            elif "default" in cells:
                place = cells.index("default")
            elif place:
                flags = re.findall(r"`(--[\w.-]+)", cells[place - 1])
                yield from zip(flags, cells[place].split(", "), strict=False)


def same(stated: str, default: str) -> bool:
    return stated == default or (bool(re.fullmatch(r"-?[\d.]+", stated)) and float(stated) == float(default))


def test_documents_state_the_defaults() -> None:
    """Where it is one word or number, and not one that depends on another option."""
    defaults = {option.flag: option.default for group in option_groups(RunCommand) for option in group.options}
    stated = [
        (flag, default)
        for flag, default in stated_defaults()
        if re.fullmatch(r"[\w.-]+", default) and default != "off" and defaults.get(flag)
    ]
    assert len(stated) > 15
    assert [(flag, default) for flag, default in stated if not same(default, defaults[flag])] == []
