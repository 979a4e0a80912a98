"""Links, pipes, devices, sockets and folders in place of the files and folders of a project or workspace."""

import os
import shutil
import socket
import stat
from collections.abc import Callable
from pathlib import Path

from hostile.cases import Case, Stage, all_names, model_run, workspace_run

# Below a workspace: what is there before, and what the program will want to make.
_PLACES = (
    *(
        "images",
        "sparse",
        "stereo",
        "stereo/depth_maps",
        "stereo/normal_maps",
        "stereo/consistency_graphs",
        "masks",
    ),
    *("colmap_sph", "colmap_sph/pairs", "colmap_sph/photometric", "colmap_sph/state", "colmap_sph/log.txt"),
    *(
        "colmap_sph/report.json",
        "colmap_sph/cloud.json",
        "colmap_sph/undistortion.json",
        "colmap_sph/undistorting",
    ),
    *("colmap_sph/.fusion.tmp", "colmap_sph/local", "fused.ply", "fused.ply.vis", "stereo/patch-match.cfg"),
    *("stereo/fusion.cfg", "sparse/images.bin", "sparse/cameras.bin", "sparse/points3D.bin", "sparse/rigs.bin"),
    *(
        "images/N_0_1.png",
        "images/cam",
        "images/cam/x.png",
        "run-colmap-geometric.sh",
        "run-colmap-photometric.sh",
    ),
    *("stereo/depth_maps/N_0_1.png.geometric.bin", "stereo/normal_maps/cam", "colmap_sph/state/cam"),
    *(
        "stereo/normal_maps/N_0_0.png.photometric.bin",
        "colmap_sph/photometric/cam",
        "colmap_sph/images.json",
        "colmap_sph/originals.json",
    ),
)
_PROJECT_PLACES = (
    *("images", "images/N_0_0.png", "images/cam", "images/cam/x.png", "sparse", "sparse/0", "sparse/0/images.bin"),
    *("sparse/0/cameras.bin", "sparse/0/points3D.bin", "sparse/0/rigs.bin", "sparse/0/frames.bin", "database.db"),
    *("masks", "masks/N_0_0.png.png", "masks/cam", "dense"),
)
_DEVICES = {"zero": (1, 5), "full": (1, 7), "null": (1, 3), "random": (1, 8)}


def make(stage: Stage) -> Case:
    """Put one or two odd things into a project, or into a workspace that is fresh, half-way or finished."""
    outside = stage.world / "outside"
    shutil.copytree(stage.grounds.project("plain") / "images", outside / "images")
    (outside / "file.txt").write_text("the user's\n")
    # Some of the places are inputs, and a link there is as good as the folder itself.
    if stage.chance(0.35):
        root = stage.copy_project()
        replaced = [_replace(stage, root, str(stage.pick(*_PROJECT_PLACES)), outside)]
        more = ("--masks", str(root / "masks")) if "masks" in replaced[0] else ()
        # Whoever makes all of the workspace a link wants it elsewhere.
        is_led_away = replaced[0].startswith("dense:") and (root / "dense").is_dir()
        dense = (root / "dense").resolve() if is_led_away else root / "dense"
        return Case("; ".join(replaced), model_run(root, *more), dense, names=all_names())
    by_model = stage.chance(0.5)
    if by_model:
        root = stage.copy_project(finished=stage.chance(0.8))
        dense = root / "dense"
        dense.mkdir(exist_ok=True)
    else:
        dense = stage.copy_workspace(stage.grounds.adopted if stage.chance(0.7) else stage.grounds.prepared)
    number = 1 + stage.chance(0.3)
    words = [_replace(stage, dense, str(stage.pick(*_PLACES)), outside) for _ in range(number)]
    options: tuple[tuple[str, ...], ...] = (("--overwrite",), ("--normals.radius", "3"), ("--dry-run",), ())
    given = options[stage.rng.choice(4, p=[0.3, 0.25, 0.05, 0.4])]
    arguments = model_run(root, *given) if by_model else workspace_run(dense, *given)
    return Case(f"{'; '.join(words)} {' '.join(given)}", arguments, dense, names=all_names())


def _replace(stage: Stage, root: Path, place: str, outside: Path) -> str:
    path = root / place
    kept = outside / "kept" / place.replace("/", "_")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink() or path.exists():
            kept.parent.mkdir(exist_ok=True)
            path.rename(kept)
        return f"{place}: {_put(stage, path, kept, outside)}"
    except OSError as error:  # beside or below what was replaced before
        return f"{place}: nothing ({error.strerror})"


def _put(stage: Stage, path: Path, kept: Path, outside: Path) -> str:
    was_folder = kept.is_dir()
    elsewhere = kept if kept.exists() and stage.chance(0.6) else outside / ("images" if was_folder else "file.txt")
    kinds: dict[str, Callable[[], object]] = {
        "a link to what was there": lambda: path.symlink_to(elsewhere),
        "a link to a new name outside": lambda: path.symlink_to(outside / "new"),
        "a relative link outside": lambda: path.symlink_to(os.path.relpath(elsewhere, path.parent)),
        "a link to itself": lambda: path.symlink_to(path),
        "a link to its folder": lambda: path.symlink_to(path.parent),
        "a pipe": lambda: os.mkfifo(path),
        "a socket": lambda: _bind(path),
        "a device": lambda: _make_device(stage, path),
        "a link to a device": lambda: path.symlink_to(f"/dev/{stage.pick(*_DEVICES)}"),
        "a link to a pipe": lambda: _link_to_pipe(path, outside),
        "a folder or a file": lambda: path.write_text("x") if was_folder else path.mkdir(),
        "an empty file": path.touch,
        "a full folder": lambda: shutil.copytree(outside / "images", path),
    }
    # A log is appended to wherever it lies; other files are replaced, whatever else they are called.
    if kept.is_file() and path.name != "log.txt":
        kinds["a hard link to what was there"] = lambda: os.link(kept, path)
    word = str(stage.pick(*kinds))
    kinds[word]()
    return word


def _bind(path: Path) -> None:
    # The name of a socket may be no longer than 107 bytes.
    here = Path.cwd()
    os.chdir(path.parent)
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(path.name)
    os.chdir(here)


def _make_device(stage: Stage, path: Path) -> None:
    number = _DEVICES[str(stage.pick(*_DEVICES))]
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(*number))
    except PermissionError:
        os.mkfifo(path)


def _link_to_pipe(path: Path, outside: Path) -> None:
    pipe = outside / "pipe"
    if not pipe.exists():
        os.mkfifo(pipe)
    path.symlink_to(pipe)
