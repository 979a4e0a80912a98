"""The walls between the rooms of the package: which may import which."""

import ast
from pathlib import Path

import pytest

import colmap_sph

PACKAGE = Path(colmap_sph.__file__).parent
GROUND = {"errors", "scene"}
MAY_IMPORT = {
    "errors": set(),
    "scene": {"errors"},
    "_native": set(),
    "stereo": {*GROUND, "_native"},
    "project": GROUND,
    "pages": {*GROUND, "stereo", "project"},
    "pipeline": {*GROUND, "_native", "stereo", "project", "pages"},
    "products": {*GROUND, "stereo", "project"},
    "evaluation": {"errors"},
    "synthetic": {"errors"},
    "app": {*GROUND, "stereo", "project", "pages", "pipeline", "products", "evaluation", "synthetic"},
}
# Loads the rooms when they are asked for, by name.
FRONT_DOOR = {"__init__", "__main__"}


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules() -> list[Path]:
    return sorted(path for path in PACKAGE.rglob("*.py") if room_of(path) not in FRONT_DOOR)


def imported(path: Path) -> set[str]:
    """Full names of what a module imports, wherever in it; of ``from a import b`` both ``a`` and ``a.b``."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def rooms_entered(path: Path) -> set[str]:
    ours = {name.split(".")[1] for name in imported(path) if name.startswith("colmap_sph.")}
    return (ours & MAY_IMPORT.keys()) - {room_of(path)}


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_import_goes_through_a_wall(path: Path) -> None:
    assert rooms_entered(path) <= MAY_IMPORT[room_of(path)]


def test_every_room_has_its_walls() -> None:
    assert {room_of(path) for path in modules()} == MAY_IMPORT.keys() - {"_native"}


def test_only_the_project_knows_colmaps_library() -> None:
    """And `synthetic`, which writes models of its own, as a user's COLMAP would."""
    assert {room_of(path) for path in modules() if "pycolmap" in imported(path)} == {"project", "synthetic"}


@pytest.mark.parametrize("library", ["sqlite3", "pathlib", "pycolmap", "json", "os.path", "shutil"])
def test_the_method_knows_no_files(library: str) -> None:
    """But for the names of options: a folder of masks is one of fusion's."""
    users = {path.name for path in modules() if room_of(path) == "stereo" and library in imported(path)}
    assert users == ({"fusion.py"} if library == "pathlib" else set())


def test_folders_hold_what_a_newcomer_can_see_at_a_glance() -> None:
    for folder in {path.parent for path in modules()}:
        assert len(list(folder.glob("[!_]*.py"))) <= 20, folder


def test_no_module_is_long() -> None:
    for path in modules():
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, path
