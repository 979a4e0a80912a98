"""One version, in all the places that name it."""

import re
import tomllib
from pathlib import Path

import colmap_sph

ROOT = Path(__file__).resolve().parents[1]


def test_all_places_name_the_same_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: *(\S+)$", citation, re.MULTILINE) == [project["version"]]
    assert re.findall(r"^license: *(\S+)$", citation, re.MULTILINE) == [project["license"]]
    assert colmap_sph.__version__ == project["version"]


def test_the_changelog_tells_of_this_version_and_begins_with_what_is_unreleased() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## \[(.+?)\]", changelog, re.MULTILINE)
    assert sections[0] == "Unreleased"
    assert sections[1] == colmap_sph.__version__
