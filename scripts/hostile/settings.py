"""Configuration files and options with whatever can be typed into them."""

from colmap_sph.app.option_list import option_groups
from colmap_sph.app.run_command import RunCommand
from hostile.cases import Case, Stage, model_run, workspace_run
from hostile.damage import WORDS, damage_text

_FILES = ("stereo/patch-match.cfg", "stereo/patch-match.cfg", "stereo/fusion.cfg")
_LINES = (
    *(
        "N_0_0.png",
        "__all__",
        "__auto__, 20",
        "__auto__, -1",
        "__auto__",
        "N_0_1.png, N_0_2.png",
        "",
        " ",
        "#",
        ",",
    ),
    *(
        "N_0_0.png, N_0_0.png",
        "none.png",
        "cam/x.png",
        "cam\\x.png",
        "N_0_0.png,,",
        "\ufeffN_0_0.png",
        "../x",
        "\x1b[31m",
    ),
    *("x" * 100_000, "\x00", "é", "__all__, N_0_0.png", "N_0_0.png \t", "__auto__, 99999999999999999999999"),
)
_VALUES = (
    *WORDS,
    *(
        "1e-9",
        "2",
        "3",
        "7",
        "0.5",
        "100",
        "1000000",
        "2147483648",
        "-1e-300",
        "64",
        "65",
        "½",
        "1_000",
        "+1",
        "1e1",
    ),
    *(
        "False",
        "false",
        "yes",
        "off",
        "none",
        "1GiB",
        "0",
        "0B",
        "1 B",
        "9" * 400,
        "1e400GiB",
        "-5GiB",
        "1kib",
        "GiB",
    ),
    *(
        "spherical",
        "frame",
        "colmap",
        "best-pixel",
        "geometric",
        "photometric",
        "/",
        ".",
        "../..",
        "/dev/null",
        "~",
        "--",
    ),
)
# The only numbers that a machine may be too small for.
_SKIPPED = {"--help", "--help-all"}


def make(stage: Stage) -> Case:
    """Odd lines in a configuration file of a workspace, or one to three odd options."""
    return _options(stage) if stage.chance(0.75) else _file(stage)


def _file(stage: Stage) -> Case:
    dense = stage.copy_workspace(stage.grounds.prepared)
    path = dense / str(stage.pick(*_FILES))
    data = path.read_bytes()
    if stage.chance(0.4):
        path.write_bytes(damage_text(data, stage.rng))
    else:
        number = int(stage.rng.integers(1, 12))
        end = str(stage.pick("\n", "\r\n", "\r"))
        path.write_text(end.join(_LINES[i] for i in stage.rng.integers(len(_LINES), size=number)), newline="")
    return Case(f"{path.name}: {path.read_bytes()[:200]!r}", workspace_run(dense), dense)


def _options(stage: Stage) -> Case:
    flags = [option.flag for group in option_groups(RunCommand) for option in group.options]
    flags = [flag for flag in flags if flag not in _SKIPPED]
    given: list[str] = []
    for _ in range(int(stage.rng.integers(1, 4))):
        flag = str(stage.pick(*flags))
        value = str(stage.pick(*_VALUES))
        is_path = flag in ("--model", "--images", "--masks", "--workspace") and value[:1] in "/.~"
        if flag == "--output" or is_path:
            value = str(stage.world / "none")  # what is written to must be in the world
        if "\0" not in value:
            given += [flag] if stage.chance(0.05) else [flag, value]
    root = stage.copy_project()
    # Where options name other folders, all of the world may be written to, but the project.
    kept = tuple(root.rglob("*"))
    base = workspace_run(stage.copy_workspace(stage.grounds.prepared)) if stage.chance(0.2) else model_run(root)
    arguments = base if stage.chance(0.95) else ("run",)
    return Case(" ".join(given)[:300], (*arguments, *given), stage.world, kept)
