"""Finished workspaces in which something has happened: damage, loss, and files of the user's own."""

import os
import shutil
from pathlib import Path

import numpy as np

from colmap_sph.project.map_files import write_depth_map
from hostile.cases import Case, Stage, all_names, files_below, model_run, workspace_run
from hostile.damage import flip_bits
from hostile.grounds import NAMES

_OURS = (
    "colmap_sph/pairs",
    "colmap_sph/photometric",
    "colmap_sph/state",
    "stereo/depth_maps",
    "stereo/normal_maps",
)
_DAMAGE = (
    *(
        "cut",
        "flipped",
        "flipped",
        "flipped and dated back",
        "removed",
        "replaced",
        "zeroed",
        "emptied",
        "appended to",
    ),
    *("a folder", "touched", "forbidden", "in a read-only folder", "a folder removed"),
)


# ---- damage -------------------------------------------------------------------------------------------------


def make_damaged(stage: Stage) -> Case:
    """Damage one file of what was made, and run again."""
    by_model = stage.chance(0.5)
    dense = (
        stage.copy_project(finished=True) / "dense" if by_model else stage.copy_workspace(stage.grounds.adopted)
    )
    clean = stage.grounds.project("plain") / "dense" if by_model else stage.grounds.adopted
    arguments = model_run(dense.parent) if by_model else workspace_run(dense)
    ours = [path for part in _OURS for path in files_below(dense / part)]
    ours += files_below(dense, "fused*", "cloud.json", "report.json")
    # What COLMAP has undistorted for this program is as much its own.
    images = files_below(dense / "images")
    ours += images if by_model else []
    theirs = files_below(dense / "sparse") + files_below(dense / "stereo", "*.cfg") + ([] if by_model else images)
    is_ours = stage.chance(0.8)
    files = ours if is_ours else theirs
    path = files[int(stage.rng.integers(len(files)))]
    word = _damage(stage, path, files)
    # Maps of which no record tells might be another program's.
    is_lost = (word.endswith("removed") and "colmap_sph/state" in str(path)) or path.name == "cloud.json"
    more = ("--overwrite",) if is_lost else ("--verify",)
    # What the user has done to the rights of files, or put in their place, is for him to undo.
    is_his = word in ("forbidden", "in a read-only folder", "a folder")
    return Case(
        f"{path.relative_to(dense)} {word}",
        arguments,
        dense,
        names=all_names(),
        # What is not ours is an input: it may be refused, or be another one.
        # Of what is up to date no byte is read, unless that is asked for.
        same_as=clean if is_ours and not is_his else None,
        same_at_once=not word.startswith("flipped"),
        again=(*arguments, *more) if is_ours and not is_his else (),
        attempts=2,
        as_user=word in ("forbidden", "in a read-only folder"),
    )


def _damage(stage: Stage, path: Path, files: list[Path]) -> str:
    rng = stage.rng
    before = path.stat()
    data = path.read_bytes()
    word = str(stage.pick(*_DAMAGE))
    if word == "cut":
        path.write_bytes(data[: int(rng.integers(len(data) + 1))])
    elif word.startswith("flipped"):
        path.write_bytes(flip_bits(data, rng))
    elif word == "replaced":
        same = [other for other in files if other.suffix == path.suffix]
        path.write_bytes(same[int(rng.integers(len(same)))].read_bytes())
    elif word == "zeroed":
        path.write_bytes(bytes(len(data)))
    elif word == "emptied":
        path.write_bytes(b"")
    elif word == "appended to":
        path.write_bytes(data + data[:100])
    elif word == "forbidden":
        path.chmod(0)
    elif word == "in a read-only folder":
        path.unlink()
        path.parent.chmod(0o555)
    elif word == "touched":
        path.touch()
    elif word == "a folder removed":
        shutil.rmtree(path.parent) if path.parent.name not in ("dense", "sparse") else path.unlink()
    else:
        path.unlink()
        if word == "a folder":
            path.mkdir()
    if word == "flipped and dated back":
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return word


# ---- the user's own files -----------------------------------------------------------------------------------

_PLACES = (
    *(
        "notes.txt",
        "images/notes.txt",
        "images/cam/mine.png",
        "sparse/project.ini",
        "sparse/0/images.bin",
        "stereo/own.cfg",
    ),
    *(
        "stereo/depth_maps/other.jpg.geometric.bin",
        "stereo/normal_maps/mine/x.bin",
        "stereo/depth_maps/x.photometric.bin",
    ),
    *(
        "stereo/consistency_graphs/x.bin",
        "masks/N_0_0.png.png",
        "masks/own.png",
        "colmap_sph/notes.txt",
        "fused.ply.bak",
    ),
    *(
        "colmap_sph/pairs/mine.npz",
        "colmap_sph/pairs/sub/x.npz",
        "colmap_sph/photometric/mine.npz",
        "colmap_sph/state/mine.json",
    ),
    *(
        "colmap_sph/undistorting/mine.txt",
        "colmap_sph/fusion/mine.ply",
        "colmap_sph/local/meshed-poisson.ply",
        "meshed.ply",
    ),
    *(
        "colmap_sph/1-2.tmp",
        "stereo/.1-2.tmp.txt",
        "scene.mvs",
        "run-mine.sh",
        "truth/x.npz",
        "database.db",
        ".hidden",
    ),
    *(
        "colmap_sph/local/images/mine.txt",
        "colmap_sph/local/fused.ply.mesh",
        "masks/cam/notes.txt",
        "images/N_0_0.png.xmp",
    ),
)


def make_shared(stage: Stage) -> Case:
    """The user keeps files of his own in the workspace, or has edited or replaced some of those in it."""
    by_model = stage.chance(0.6)
    dense = (
        stage.copy_project(finished=True) / "dense" if by_model else stage.copy_workspace(stage.grounds.adopted)
    )
    kept = [_put_file(stage, dense) for _ in range(int(stage.rng.integers(0, 4)))]
    words = [str(path.relative_to(dense)) for path in kept]
    more = [("--overwrite",), ("--overwrite", "--max-image-size", "100"), ("--normals.radius", "3"), ()]
    arguments = model_run(dense.parent) if by_model else workspace_run(dense)
    change = str(
        stage.pick("nothing", "model inside", "images inside", "edited", "link", "foreign maps", "masks inside")
    )
    protected = list(kept)
    if change == "edited":
        path = dense / str(stage.pick("stereo/patch-match.cfg", "stereo/fusion.cfg"))
        path.write_text("N_0_1.png\n__all__\n" if path.name[:5] == "patch" else "\n".join(NAMES[:3]) + "\n")
        protected.append(path)
    elif change == "link":
        target = stage.world / "elsewhere"
        target.mkdir()
        (target / "mine.txt").write_text("the user's\n")
        (dense / str(stage.pick("mine", "images/mine", "stereo/mine", "colmap_sph/mine"))).symlink_to(target)
    elif change == "foreign maps":
        shutil.rmtree(dense)
        shutil.copytree(stage.grounds.prepared, dense)
        protected += _write_foreign_results(dense, kept)
        arguments = workspace_run(dense)
        by_model = False
    elif change in ("model inside", "images inside", "masks inside") and by_model:
        arguments = _move_inside(dense, change)
        protected += [path for part in ("input", "sparse/0", "images/input") for path in files_below(dense / part)]
    given = more[int(stage.rng.integers(4))]
    if not by_model:
        given = tuple(word for word in given if word not in ("--max-image-size", "100"))
        protected += [*files_below(dense / "images"), *files_below(dense / "sparse")]
    return Case(
        f"{change}; files {', '.join(words)}; {' '.join(given)}",
        (*arguments, *given),
        dense,
        tuple(dict.fromkeys(protected)),
        names=all_names(),
    )


def _put_file(stage: Stage, dense: Path) -> Path:
    path = dense / str(stage.pick(*_PLACES))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"the user's {stage.rng.integers(1000)}\n")
    return path


def _write_foreign_results(dense: Path, kept: list[Path]) -> list[Path]:
    """Put maps and a cloud by another program into a workspace, and the user's files back."""
    depth = np.full((90, 120), 7, np.float32)
    made = [*kept, dense / "fused.ply", dense / "fused.ply.vis"]
    for path in made:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"the user's own {path.name}\n")
    for kind in ("photometric", "geometric"):
        path = dense / "stereo" / "depth_maps" / f"N_0_0.png.{kind}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_depth_map(path, depth)
        made.append(path)
    return made


def _move_inside(dense: Path, change: str) -> tuple[str, ...]:
    """Move an input of the run into the workspace; returns the arguments."""
    root = dense.parent
    model = root / "sparse" / "0"
    images = root / "images"
    masks: list[str] = []
    if change == "model inside":
        model = Path(shutil.move(model, dense / "input"))
    elif change == "images inside":
        images = Path(shutil.move(images, dense / "input"))
    else:
        shutil.copytree(images, dense / "masks", dirs_exist_ok=True)
        masks = ["--masks", str(dense / "masks")]
    arguments = ["run", "--model", str(model), "--images", str(images), "--output", str(dense), "--threads", "1"]
    return (*arguments, *masks)
