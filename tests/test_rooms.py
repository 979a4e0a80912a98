"""The walls between the rooms of the package: which may import which."""

import ast
import re
from pathlib import Path

import pytest

import colmap_sph

PACKAGE = Path(colmap_sph.__file__).parent
GROUND = {"errors", "scene"}
MAY_IMPORT = {
    "errors": set(),
    "scene": {"errors"},
    "_native": set(),
    "platforms": set(),
    "stereo": {*GROUND, "_native"},
    "project": {*GROUND, "platforms"},
    "pages": {*GROUND, "platforms", "stereo", "project"},
    "pipeline": {*GROUND, "platforms", "_native", "stereo", "project", "pages"},
    "products": {*GROUND, "platforms", "stereo", "project"},
    "evaluation": {"errors", "platforms"},
    "synthetic": {"errors"},
    "app": {*GROUND, "platforms", "stereo", "project", "pages", "pipeline", "products", "evaluation", "synthetic"},
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


# Of modules that some systems have only, and that tell systems apart.
SYSTEM_MODULES = {
    *(
        "_winapi",
        "ctypes",
        "fcntl",
        "grp",
        "msvcrt",
        "multiprocessing",
        "platform",
        "psutil",
        "pty",
        "pwd",
        "resource",
    ),
    *("select", "syslog", "termios", "tty", "winreg"),
}
# What Windows or macOS lack, or do in another way, of modules that all have.
SYSTEM_NAMES = re.compile(
    r"""os\.(
        O_(?!RDONLY$|WRONLY$|RDWR$|APPEND$|CREAT$)\w+ | exec\w+ | fork\w* | spawn\w+ | wait\w* | W[A-Z]\w*
        | kill\w* | get(e|res)?[ug]id | getpgid | setsid | nice | [fl]?chown | f?statvfs | mkfifo | mknod | uname
        | name | sep | altsep | linesep | sched_\w+ | posix_\w+ | p(read|write)v? | sendfile | copy_file_range
        | f?sync | fdatasync | symlink | link | readlink | replace | rename\w* | register_at_fork | cpu_count
    )
    | signal\.(SIG(?!INT$|TERM$|_IGN$|_DFL$)\w+ | pthread_\w+ | alarm | setitimer | siginterrupt | sigwait\w*)
    | sys\.(platform | getwindowsversion)
    | shutil\.(chown | move)
    | cv2\.(imread | imwrite)""",
    re.VERBOSE,
)
# Methods of paths: links are told from folders, and files replaced, in the ways of all systems.
SYSTEM_METHODS = {
    "symlink_to",
    "hardlink_to",
    "is_symlink",
    "is_junction",
    "readlink",
    "rename",
    "write_text",
    "owner",
}
# That Linux has these names needs no other system: what is meant is a place in the files of a user, or a method.
EXCEPTIONS = {
    ("app/standard_streams.py", "select"),  # of a stream that does not block, which Windows has none of
    ("pipeline/program.py", "platform"),  # Python's version
    ("project/claim.py", "is_symlink"),  # of an entry of a folder
    ("project/cloud_output.py", "shutil.move"),  # to a temporary name
    ("project/sparse_model.py", "write_text"),  # COLMAP's
}


def test_only_one_room_knows_systems() -> None:
    """All others are free of what some have only; what is left out here, they would find out by failing."""
    found = set()
    for path in modules():
        if room_of(path) == "platforms":
            continue
        place = path.relative_to(PACKAGE).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {(place, name) for name in imported(path) & SYSTEM_MODULES}
        found |= {(place, name) for name in map(system_name, ast.walk(tree)) if name}
    assert found == EXCEPTIONS


def system_name(node: ast.AST) -> str | None:
    """What a part of a program asks of the system that not all systems have."""
    match node:
        case ast.Attribute(value=ast.Name(id=module), attr=name) if SYSTEM_NAMES.fullmatch(f"{module}.{name}"):
            return f"{module}.{name}"
        case ast.Attribute(attr=name) if name in SYSTEM_METHODS:
            return name
        # With two arguments, it is that of text; with names, of records.
        case ast.Call(func=ast.Attribute(attr="replace"), args=[_], keywords=[]):
            return "replace"
        case ast.Call(func=ast.Name(id="open"), args=[_, ast.Constant(value=str(mode))], keywords=keywords):
            return None if "b" in mode or "newline" in {each.arg for each in keywords} else "open"
        case ast.Constant(value=str(text)) if re.match(r"/(proc|sys|dev|tmp|etc|var|run)\b", text):
            return text
    return None


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("os.sched_getaffinity(0)", "os.sched_getaffinity"),
        ("os.open(path, os.O_RDONLY | os.O_NOFOLLOW)", "os.O_NOFOLLOW"),
        ("os.open(path, os.O_RDONLY)", None),
        ("signal.signal(signal.SIGHUP, f)", "signal.SIGHUP"),
        ("signal.signal(signal.SIGTERM, signal.SIG_IGN)", None),
        ("made.replace(target)", "replace"),
        ("text.replace('a', 'b')", None),
        ("replace(record, field=1)", None),
        ("path.write_text('x')", "write_text"),
        ("open('/proc/self/cgroup', 'rb')", "/proc/self/cgroup"),
        ("open(path, 'w')", "open"),
        ("sys.platform == 'win32'", "sys.platform"),
    ],
)
def test_what_only_some_systems_have_is_found(code: str, name: str | None) -> None:
    assert {found for found in map(system_name, ast.walk(ast.parse(code))) if found} == ({name} if name else set())


def test_types_are_read_in_one_place() -> None:
    """Threads that ask msgspec for a new type at the same time end the process: one module lets them not."""
    reading = re.compile(r"msgspec\.(convert|json\.decode|json\.Decoder)\(")
    found = {path.relative_to(PACKAGE).as_posix() for path in modules() if reading.search(path.read_text("utf-8"))}
    assert found == {"project/state/typed.py"}


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
