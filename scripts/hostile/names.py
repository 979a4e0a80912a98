"""Names of images that no system likes, in the model and, where the disk takes them, on disk."""

import os
import shutil
import string
from pathlib import Path

from hostile.cases import Case, Random, Stage, files_below, model_run, workspace_run
from hostile.grounds import NAMES

_ODD: tuple[bytes, ...] = (
    *(
        b"",
        b" ",
        b".",
        b"..",
        b"/",
        b"x/",
        b"./x.png",
        b"a//b.png",
        b"a/./b.png",
        b"a/../x.png",
        b"x.png/.",
        b"~",
        b"-",
    ),
    *(b"../x.png", b"../../x.png", b"../dense/fused.ply", b"images/../../x.png", b"/etc/passwd", b"//x.png"),
    *(
        b"a\nb.png",
        b"a\r.png",
        b"a\tb.png",
        b"\n",
        b"x.png\n",
        b" x.png",
        b"x.png ",
        b"a b.png",
        b"a  b.png",
        b"\x7f.png",
    ),
    *(
        b"#x.png",
        b"#",
        b"__all__",
        b"__auto__",
        b"__auto__, 20",
        b"a,b.png",
        b"a, b.png",
        b"x.png,",
        b";x",
        b"a=b.png",
    ),
    *(
        b"\x1b]0;title\x07.png",
        b"\x1b[2J\x1b[31mred.png",
        b"\x08\x08\x08.png",
        b"\xc2\x9b31m.png",
        b"\x01\x02.png",
    ),
    *(
        b"[red]x[/].png",
        b"\\[/]x.jpg",
        b"[/]",
        b"[link=file:///]x[/link].png",
        b":smile:.png",
        b"{x}.png",
        b"%s%n%d.png",
    ),
    *(
        b"$(touch pwned).png",
        b"`touch pwned`.png",
        b"'; touch pwned; '.png",
        b'"x".png',
        b"--output",
        b"-rf.png",
        b"*",
    ),
    *(
        b"CON.png",
        b"NUL",
        b"a:b.png",
        b"C:\\x.png",
        b"cam0\\x.png",
        b"\\\\server\\x.png",
        b"COM1.png.",
        b"x.png::$DATA",
    ),
    *(
        b"\xff\xfe.png",
        b"\xc3\x28.png",
        b"\xed\xa0\x80.png",
        b"\xf0\x9f\x92\xa9.png",
        "ｅ́.png".encode(),
        "é.png".encode(),
    ),
    *(
        "\u202egnp.x.png".encode(),
        "\u200bx.png".encode(),
        "\ufeffx.png".encode(),
        "\u2028x.png".encode(),
        "写真.png".encode(),
    ),
    *(
        b".hidden.png",
        b".123-456.tmp",
        b"x.geometric.bin",
        b"N_0_1.png.photometric.bin",
        b"N_0_1.png/x.png",
        b"cam",
    ),
    *(
        b"n_0_1.png",
        b"N_0_1.PNG",
        b"N_0_1.png",
        b"cloud.json",
        b"fused.ply",
        b"x" * 200,
        b"x" * 238 + b".png",
        b"x" * 300,
    ),
    *(
        b"d/" * 60 + b"x.png",
        b"d/" * 3000 + b"x.png",
        b"e" * 5000,
        b"x.jpg",
        b"x",
        b"x.tar.gz",
        b"x.PnG",
        b"x.",
        b"...",
    ),
)
_LETTERS = (
    *string.printable,
    "é",
    "ß",
    "\u0301",
    "\u200d",
    "😀",
    "\u202e",
    "\x00"[:0],
    "\x85",
    "\x1b",
    "/",
    "\\",
    "\n",
    " ",
    "#",
)


def make(stage: Stage) -> Case:
    """Give one to four images odd names; sometimes through a workspace of COLMAP's."""
    rng = stage.rng
    in_workspace = stage.chance(0.3)
    if in_workspace:
        root = stage.copy_workspace(stage.grounds.prepared)
        model = root / "sparse"
    else:
        root = stage.copy_project()
        is_text = stage.chance(0.25)
        if is_text:
            shutil.rmtree(root / "sparse" / "0")
            shutil.copytree(root / "text", root / "sparse" / "0")
        model = root / "sparse" / "0"
    chosen = rng.permutation(NAMES)[: int(rng.integers(1, 4))]
    renamed = {str(old): _odd_name(rng) for old in chosen}
    for old, new in renamed.items():
        _rename_in_model(model, old, new)
        _rename_on_disk(root / "images", old, new)
    names = {os.fsdecode(new): old for old, new in renamed.items() if _can_be_judged(new, [*renamed.values()])}
    names |= {name: name for name in NAMES if name not in renamed}
    words = f"{'workspace' if in_workspace else 'model'} with names {', '.join(map(repr, renamed.values()))}"
    if in_workspace:
        kept = (*files_below(root / "images"), *files_below(root / "sparse"), root / "stereo" / "patch-match.cfg")
        return Case(words, workspace_run(root), root, kept, names=names)
    more = ("--dry-run",) if stage.chance(0.1) else ()
    return Case(words, model_run(root, *more), root / "dense", names={} if more else names)


def _odd_name(rng: Random) -> bytes:
    if rng.random() < 0.7:
        return _ODD[rng.integers(len(_ODD))]
    letters = rng.choice(_LETTERS, int(rng.integers(1, 30)))
    return "".join(letters).encode() + (b".png" if rng.random() < 0.7 else b"")


def _can_be_judged(name: bytes, others: list[bytes]) -> bool:
    """Whether it is clear whose map is whose."""
    return others.count(name) == 1 and bool(name) and name not in (b"N_0_1.png", b"N_0_1.PNG", b"n_0_1.png")


def _rename_in_model(model: Path, old: str, new: bytes) -> None:
    path = model / "images.bin"
    if path.exists():
        path.write_bytes(path.read_bytes().replace(old.encode() + b"\0", new + b"\0"))
        return
    path = model / "images.txt"
    path.write_bytes(path.read_bytes().replace(b" " + old.encode() + b"\n", b" " + new + b"\n"))


def _rename_on_disk(images: Path, old: str, new: bytes) -> None:
    target = os.path.join(os.fsencode(images), new)  # noqa: PTH118  # bytes that need not be a text
    # Not out of the world.
    if new.startswith(b"/") or new.count(b"..") > 1:
        return
    try:
        os.makedirs(os.path.dirname(target), exist_ok=True)  # noqa: PTH103, PTH120
        (images / old).rename(os.fsdecode(target))
    except (OSError, ValueError, RecursionError):
        pass
