"""Files for machines elsewhere, which nothing here runs: they parse, and name what is there."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import colmap_sph

ROOT = Path(__file__).resolve().parents[1]
WORKFLOW = ROOT / ".github/workflows/wheels.yml"
# What conda-forge calls what PyPI calls otherwise.
CONDA_NAMES = {
    "opencv-contrib-python-headless": "py-opencv",
    "openimageio": "py-openimageio",
    "xxhash": "python-xxhash",
}

pytestmark = pytest.mark.skipif(not WORKFLOW.exists(), reason="needs the checkout's files")


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def requirement(text: str) -> tuple[str, str]:
    """The name and the bounds of a requirement."""
    parts = re.fullmatch(r"([\w-]+)(?:\[\w+\])?\s*(.*)", text)
    assert parts, text
    return parts[1], parts[2]


def test_the_conda_recipe_has_the_projects_dependencies_and_version():
    recipe = yaml.safe_load((ROOT / "conda/recipe.yaml").read_text())
    assert recipe["context"]["version"] == project()["project"]["version"] == colmap_sph.__version__
    wanted = dict(map(requirement, project()["project"]["dependencies"]))
    expected = {CONDA_NAMES.get(name, name): bounds for name, bounds in wanted.items()}
    expected |= {"python": project()["project"]["requires-python"], "lazrs-python": ""}  # laspy[lazrs]
    assert dict(map(requirement, recipe["requirements"]["run"])) == expected


def test_actions_of_the_workflow_are_pinned_and_it_has_no_secrets():
    text = WORKFLOW.read_text()
    jobs = yaml.safe_load(text)["jobs"]
    used = [step["uses"] for job in jobs.values() for step in job["steps"] if "uses" in step]
    assert used
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action) for action in used)
    assert "secrets" not in str(jobs)
    assert [name for name, job in jobs.items() if "id-token" in job.get("permissions", {})] == ["publish"]


def test_tests_that_wheels_are_given_exist():
    settings = project()["tool"]["cibuildwheel"]
    commands = " ".join([*settings["test-command"], *(each["test-command"] for each in settings["overrides"])])
    named = re.findall(r"tests/\w+\.py", commands)
    assert named and all((ROOT / name).is_file() for name in named)
    assert all((ROOT / name).exists() for name in settings["test-sources"])


def test_the_image_is_given_all_that_the_build_reads():
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    given = project()
    read = {given["project"]["readme"], *given["project"]["license-files"]}
    assert kept >= {"pyproject.toml", "CMakeLists.txt", *read, *given["tool"]["scikit-build"]["wheel"]["packages"]}
