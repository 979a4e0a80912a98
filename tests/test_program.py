"""Which code a result's key holds: what its maker reaches by import, all of it, and nothing else."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import colmap_sph
from colmap_sph.pipeline import program
from colmap_sph.pipeline.program import reached_modules

PACKAGE = Path(colmap_sph.__file__).parent
MAKERS = {name: f"colmap_sph.pipeline.stages.{name}" for name in ("undistort", "match", "vote", "confirm", "fuse")}
ROOMS_THAT_MAKE_NOTHING = ("app", "evaluation", "synthetic")

LOADED = """
import importlib, json, sys
importlib.import_module(sys.argv[1])
ours = {name: module.__file__ for name, module in sys.modules.items() if name.partition(".")[0] == "colmap_sph"}
print(json.dumps([name for name, file in ours.items() if file.endswith(".py")]))
"""


@pytest.mark.parametrize("maker", MAKERS.values())
def test_what_an_import_loads_is_in_the_key(maker: str) -> None:
    """As Python itself says, in a process of its own."""
    done = subprocess.run([sys.executable, "-P", "-c", LOADED, maker], capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout)) <= set(reached_modules(maker))


@pytest.mark.parametrize("maker", MAKERS.values())
def test_no_key_holds_what_makes_nothing(maker: str) -> None:
    rooms = {name.split(".")[1] for name in reached_modules(maker) if name.count(".")}
    assert rooms.isdisjoint(ROOMS_THAT_MAKE_NOTHING)
    shared = {"context", "execute", "keys", "options", "plan", "reconstruct", "report", "workers"}
    assert {f"colmap_sph.pipeline.{name}" for name in shared}.isdisjoint(reached_modules(maker))


def imported(node: ast.AST) -> set[str]:
    """Full names of what code imports of the package, by Python's parser, but not for type checkers only."""
    if isinstance(node, ast.Import):
        names = {alias.name for alias in node.names}
    elif isinstance(node, ast.ImportFrom) and node.module:
        names = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    elif isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        names = set().union(*map(imported, node.orelse))
    else:
        names = set().union(*map(imported, ast.iter_child_nodes(node)))
    return {name for name in names if name.partition(".")[0] == "colmap_sph"}


def test_imports_are_found_as_python_finds_them() -> None:
    """In all code of the package: none is written so that a search of its text misses it."""
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_bytes()
        assert set(program._ours_imported(source)) == imported(ast.parse(source)), path


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the package's code that may be edited, in its place for digests."""
    copy = tmp_path / "colmap_sph"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("*.so", "_native", "__pycache__"))
    monkeypatch.setattr(program, "_ROOT", copy)
    return copy


def digests() -> dict[str, str]:
    program.program_digest.cache_clear()
    program._looked_at.cache_clear()
    return {name: program.program_digest(module) for name, module in MAKERS.items()}


@pytest.mark.parametrize(
    ("edited", "redone"),
    [
        ("app/cli.py", set()),
        ("app/run_command.py", set()),
        ("pipeline/plan.py", set()),
        ("pipeline/reconstruct.py", set()),
        ("pipeline/workers.py", set()),
        ("synthetic/village.py", set()),
        ("evaluation/evaluate.py", set()),
        ("project/undistortion/image.py", {"undistort"}),
        ("project/undistortion/model.py", set()),
        ("stereo/partners/partner_choice.py", {"fuse"}),
        ("stereo/matching.py", {"match"}),
        ("stereo/vote.py", {"vote", "confirm"}),
        ("stereo/confirm.py", {"confirm"}),
        ("stereo/refinement.py", {"confirm"}),
        ("stereo/fusion.py", {"fuse"}),
        ("stereo/poses/ties.py", {"match", "vote", "confirm"}),
        ("project/masks.py", {"undistort", "match", "vote", "confirm", "fuse"}),
        ("scene.py", {"undistort", "match", "vote", "confirm", "fuse"}),
    ],
)
def test_an_edit_changes_the_keys_of_what_it_makes(edited: str, redone: set[str], copy: Path) -> None:
    """The keys of later stages follow from those of earlier ones: see test_resume."""
    before = digests()
    path = copy / edited
    path.write_text(path.read_text() + "\n# edited\n")
    after = digests()
    assert {name for name in before if before[name] != after[name]} == redone
    program.program_digest.cache_clear()
    program._looked_at.cache_clear()
