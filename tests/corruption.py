"""Damages input files at random, by seed, and tells what the program makes of them; as a process of its own.

``python corruption.py PROJECT FIRST LAST`` prints a line before and after each case, so that whoever reads them
knows where it died. PROJECT holds images and models as `make_cases` leaves them.
"""

import contextlib
import io
import logging
import resource
import shutil
import signal
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap

Random = np.random.Generator

_COUNTS = (0, 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
_NUMBERS = (float("nan"), float("inf"), 0.0, -1.0, 1e300, 1e-300, -1e9, 1e15)
_WORDS = ("nan", "inf", "-1", "0", "1e300", "1e-300", "99999999999999999999", "4294967295", "abc", "", "é")
_SECONDS = 30
_BYTES = 8 << 30


def damage_bytes(data: bytes, rng: Random) -> bytes:
    """Flip bits, cut off, or overwrite with a wrong count, an odd number, noise; or insert noise."""
    place = int(rng.integers(max(len(data) - 8, 1)))
    noise = rng.bytes(int(rng.integers(1, 40)))
    kind = rng.integers(6)
    if kind == 0:
        changed = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    if kind == 1:
        return data[:place]
    if kind == 2:
        return data[:place] + struct.pack("<Q", _COUNTS[rng.integers(len(_COUNTS))]) + data[place + 8 :]
    if kind == 3:
        return data[:place] + struct.pack("<d", _NUMBERS[rng.integers(len(_NUMBERS))]) + data[place + 8 :]
    if kind == 4:
        return data[:place] + noise + data[place:]
    return data[:place] + noise + data[place + len(noise) :]


def damage_text(data: bytes, rng: Random) -> bytes:
    """Remove, repeat or cut a line, or put another word into it; or damage the bytes."""
    lines = data.decode().splitlines()
    kind = rng.integers(6)
    number = int(rng.choice([n for n, line in enumerate(lines) if line[:1] != "#"]))
    if kind == 0:
        return damage_bytes(data, rng)
    if kind == 1:
        del lines[number]
    elif kind == 2:
        lines.insert(number, lines[int(rng.integers(len(lines)))])
    elif kind == 3:
        lines[number] = lines[number][: int(rng.integers(len(lines[number]) + 1))]
    else:
        words = lines[number].split(" ")
        words[int(rng.integers(min(len(words), 14)))] = _WORDS[int(rng.integers(len(_WORDS)))]
        lines[number] = " ".join(words)
    return "\n".join(lines).encode()


def make_cases(project: Path) -> None:
    """Complete the project of `test_undistortion` by all that is to be damaged.

    Pictures of its plane, its model as text, masks, a workspace of COLMAP's, and one with a finished run in it.
    """
    model = pycolmap.Reconstruction(project / "sparse" / "0")
    ground = np.random.default_rng(0).integers(0, 256, (64, 120, 3), np.uint8)
    for image in model.images.values():
        # The plane is 3 units away and the focal length 90 pixels: each 0.1 units of translation are 3 pixels.
        shift = round(30 * image.cam_from_world().translation[0])
        path = project / "images" / image.name
        assert cv2.imwrite(str(path), ground[:, 12 - shift : 108 - shift])
        mask = np.full((64, 96), 255, np.uint8)
        mask[:8] = 0
        (project / "masks" / image.name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(project / "masks" / f"{image.name}.png"), mask)
    (project / "text").mkdir()
    model.write_text(project / "text")
    pycolmap.undistort_images(project / "dense", project / "sparse" / "0", project / "images")
    shutil.copytree(project / "dense", project / "finished")
    code = run_command(["--workspace", str(project / "finished")])
    assert code == "0 ", code


def _damage_one(folder: Path, pattern: str, rng: Random, damage: Callable[[bytes, Random], bytes]) -> str:
    files = sorted(path for path in folder.rglob(pattern) if path.is_file())
    path = files[int(rng.integers(len(files)))]
    path.write_bytes(damage(path.read_bytes(), rng))
    return path.name


def prepare(project: Path, seed: int, case: Path) -> tuple[str, list[str]]:
    """Make the damaged copy of a project in the folder `case`; return what was damaged, and the command for it."""
    rng = np.random.default_rng(seed)
    model, images = case / "model", project / "images"
    kind = ("binary", "text", "binary", "text", "image", "workspace", "mask", "finished")[seed % 8]
    if kind == "finished":
        shutil.copytree(project / "finished", case / "finished")
        pattern = str(rng.choice(["*.bin", "*.sph", "*.json", "fused.ply*"]))
        folder = case / "finished" / ("stereo" if pattern == "*.bin" else "")
        return _damage_one(folder, pattern, rng, damage_bytes), ["--workspace", str(case / "finished")]
    if kind == "workspace":
        shutil.copytree(project / "dense", case / "dense")
        pattern = str(rng.choice(["patch-match.cfg", "*.bin", "*.png"]))
        damage = damage_text if pattern == "patch-match.cfg" else damage_bytes
        return _damage_one(case / "dense", pattern, rng, damage), ["--workspace", str(case / "dense")]
    shutil.copytree(project / ("text" if kind == "text" else "sparse/0"), model)
    arguments = ["--model", str(model), "--output", str(case / "out")]
    if kind == "mask":
        shutil.copytree(project / "masks", case / "masks")
        name = _damage_one(case / "masks", "*.*", rng, damage_bytes)
        arguments += ["--masks", str(case / "masks")]
    elif kind == "image":
        shutil.copytree(images, case / "images")
        images = case / "images"
        name = _damage_one(images, "*.*", rng, damage_bytes)
    else:
        name = _damage_one(model, "*.*", rng, damage_text if kind == "text" else damage_bytes)
    return name, [*arguments, "--images", str(images)]


def run_command(arguments: list[str]) -> str:
    """Run the command; its exit code, and its sentence where it failed, or what it should not have done."""
    from colmap_sph.app import cli

    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
            code = cli.main(["run", *arguments, "--threads", "1", "--min-shared-points", "2"])
    except BaseException as error:
        return f"BROKEN {error!r}".replace("\n", " ")
    said = [line for line in output.getvalue().splitlines() if line.startswith("error: ")]
    if "Traceback" in output.getvalue() or "Warning:" in output.getvalue():
        return "BROKEN " + output.getvalue().replace("\n", " | ")
    if (code in (0, 5)) != (not said) or len(said) > 1:
        return f"BROKEN exit code {code} with {said}"
    return f"{code} {said[0] if said else ''}"


def is_mended(workspace: Path, finished: Path, damaged: str) -> bool:
    """Whether the maps and the cloud are what they were before the file called `damaged` was.

    Of larger files the records know the size and some blocks: what lies between may stay as it is.
    """
    for path in (*finished.rglob("*.bin"), *finished.glob("fused.ply*")):
        expected, found = path.read_bytes(), (workspace / path.relative_to(finished)).read_bytes()
        unseen = path.name == damaged and len(found) == len(expected) > 64 << 10
        if found != expected and not unseen:
            return False
    return True


def main(project: Path, first: int, last: int) -> None:
    """Run cases `first` to `last` - 1."""
    from colmap_sph.project.undistortion.process import ChildProcess

    warnings.simplefilter("error")
    logging.captureWarnings(False)
    # A process of its own for COLMAP takes longer to start than most of its work.
    ChildProcess.call = lambda _, function, argument, what: function(argument)  # type: ignore[assignment, method-assign]
    ChildProcess.start_for = lambda _, function: None  # type: ignore[assignment, method-assign]
    resource.setrlimit(resource.RLIMIT_AS, (_BYTES, _BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for seed in range(first, last):
        case = project / "case"
        shutil.rmtree(case, ignore_errors=True)
        case.mkdir()
        name, arguments = prepare(project, seed, case)
        print("BEGIN", seed, name, flush=True)
        signal.alarm(_SECONDS)
        result = run_command(arguments)
        signal.alarm(0)
        if (case / "finished").exists() and not is_mended(case / "finished", project / "finished", name):
            result = f"BROKEN {name} is not as before, with {result}"
        print("END", seed, result, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
