"""What a run is given to work on: defaults, and every mistake told in a sentence that names the right option."""

import errno
import os
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pycolmap
import pytest
from projects import prepare
from test_undistortion import make_project

from colmap_sph.app import cli
from colmap_sph.errors import ColmapSphError, InputError, OptionError
from colmap_sph.project.project import Project, open_workspace
from colmap_sph.project.sparse_model import models_inside

SUMMARY = Path(__file__).resolve().parent.parent / "workflows" / "batch_summary.py"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project, which is the current folder, with a dense workspace of COLMAP's."""
    make_project(tmp_path)
    pycolmap.undistort_images(tmp_path / "dense", tmp_path / "sparse/0", tmp_path / "images")
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ---- where the result goes, and what is found --------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("project/sparse/0", "project/dense"),
        ("project/sparse/12", "project/dense-12"),
        ("project/sparse/1", "project/dense-1"),
        ("project/sparse/00", "project/dense"),
        ("project/sparse/best", "project/sparse/best/dense"),
        ("project/sparse", "project/dense"),
        ("2024/sparse/0", "2024/dense"),
        ("2024", "dense"),
        ("project/model", "project/model/dense"),
    ],
)
def test_default_output(tmp_path: Path, model: str, expected: str) -> None:
    assert Project(tmp_path / model).root == tmp_path / expected


@pytest.mark.parametrize(
    ("link", "target", "model", "expected"),
    [
        ("mine/sparse", "store/sparse", "mine/sparse/0", "mine/dense"),
        ("mine/sparse/1", "store/sparse/0", "mine/sparse/1", "mine/dense-1"),
        ("mine/best", "store/sparse/0", "mine/best", "store/dense"),
        ("mine/sparse/best", "store/sparse/1", "mine/sparse/best", "store/dense-1"),
    ],
)
def test_default_output_of_links(tmp_path: Path, link: str, target: str, model: str, expected: str) -> None:
    """What is linked to is often not to be written to: the result goes beside `sparse` as it is typed."""
    (tmp_path / target).mkdir(parents=True)
    (tmp_path / "store/sparse/0").mkdir(exist_ok=True)
    (tmp_path / link).parent.mkdir(parents=True)
    (tmp_path / link).symlink_to(tmp_path / target)
    (tmp_path / "mine/database.db").touch()
    project = Project(tmp_path / model)
    assert project.root == tmp_path / expected
    assert runpy.run_path(str(SUMMARY))["default_output"](tmp_path / model) == tmp_path / expected
    assert project.database() == tmp_path / "mine/database.db"
    (tmp_path / "store/database.db").touch()  # of which the model was made; the other may be anything's
    assert project.database() == tmp_path / "store/database.db"


@pytest.mark.skipif(sys.platform == "win32", reason="there .. is taken out of the text")
@pytest.mark.parametrize(
    ("model", "expected"),
    [
        ("link/../sparse/0", "store/dense"),
        ("link/../other/../sparse/1", "store/dense-1"),
        ("sparse/../sparse/0", "store/dense"),
        ("sparse/0/../1", "mine/dense-1"),
        ("../mine/./sparse/0", "mine/dense"),
    ],
)
def test_default_output_on_ways_back_over_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str, expected: str
) -> None:
    """The system goes back from where a link leads to: the model is there, and so is its result."""
    for folder in ("store/other", "store/sparse/0", "store/sparse/1", "mine/dense"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "mine/link").symlink_to(tmp_path / "store/other")
    (tmp_path / "mine/sparse").symlink_to(tmp_path / "store/sparse")
    monkeypatch.chdir(tmp_path / "mine")
    assert Path(model).samefile(tmp_path / "store/sparse" / Path(model).name)
    assert Project(Path(model)).root == tmp_path / expected
    assert runpy.run_path(str(SUMMARY))["default_output"](Path(model)) == tmp_path / expected


def test_output_and_workspace_are_taken_as_given(tmp_path: Path) -> None:
    assert Project(Path("sparse/0"), output=Path("x")).root == Path("x")
    assert Project(workspace=tmp_path).root == tmp_path


def test_database(tmp_path: Path) -> None:
    project = Project(make_project(tmp_path))
    assert project.database() is None
    (tmp_path / "database.db").write_bytes(b"")
    assert project.database() == tmp_path.resolve() / "database.db"
    shutil.copy(tmp_path / "database.db", tmp_path / "sparse/0/database.db")
    assert project.database() == tmp_path / "sparse/0/database.db"
    assert Project(workspace=tmp_path).database() is None


# ---- mistakes ----------------------------------------------------------------------------------------------


def sentence(project: Project) -> str:
    """What is said of a project that cannot be used."""
    with pytest.raises(ColmapSphError) as error:
        project.check()
        open_workspace(project)
    return str(error.value)


def test_what_is_right_passes(here: Path) -> None:
    Project(here / "sparse/0", here / "nowhere", here / "nowhere", here / "nowhere").check()
    project = Project(workspace=here / "dense", masks=None)
    project.check()
    assert open_workspace(project).root == here / "dense"


def test_nothing_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError, match=r"^There is nothing to work on: --model names .*; give one of them\.$"):
        Project().check()
    with pytest.raises(OptionError, match="nothing to work on"):
        Project(images=tmp_path, output=tmp_path).check()


def test_nothing_is_given_but_something_is_here(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sentence(Project()).endswith("did you mean --model sparse/0 or --workspace dense?")
    shutil.rmtree("sparse")
    assert sentence(Project()).endswith("did you mean --workspace dense?")
    monkeypatch.chdir("dense")
    assert sentence(Project()).endswith("did you mean --workspace .?")
    shutil.rmtree("stereo")
    assert sentence(Project()).endswith("did you mean --model sparse?")


def test_both_are_given() -> None:
    with pytest.raises(OptionError, match=r"--model and --workspace are both given; .*, not both"):
        Project(model=Path("sparse/0"), workspace=Path("dense")).check()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"images": Path("x")}, "leave out --images."),
        ({"output": Path("x")}, "leave out --output."),
        ({"images": Path("x"), "output": Path("x")}, "leave out --images and --output."),
    ],
)
def test_what_a_workspace_does_without(given: dict[str, Path], words: str) -> None:
    assert sentence(Project(workspace=Path("dense"), **given)).endswith(words)


def test_a_workspace_is_given_as_model(here: Path) -> None:
    with pytest.raises(OptionError, match=r"dense is a dense workspace, .*; give it as --workspace dense"):
        Project(model=Path("dense")).check()


def test_a_model_is_given_as_workspace(here: Path) -> None:
    with pytest.raises(OptionError, match=r"sparse/0 is a sparse model, .*; give it as --model sparse/0"):
        Project(workspace=Path("sparse/0")).check()


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
@pytest.mark.parametrize(("given", "lack"), [("sparse", "no images folder"), (".", "holds no model itself")])
def test_a_folder_around_a_model_is_given(given: str, lack: str, binary: bool, here: Path) -> None:
    """As the model or as the workspace: both name the model itself."""
    if not binary:
        model = pycolmap.Reconstruction("sparse/0")
        for path in Path("sparse/0").iterdir():
            path.unlink()
        model.write_text("sparse/0")
    with pytest.raises(InputError, match=r"did you mean sparse/0\?"):
        Project(model=Path(given)).check()
    words = sentence(Project(workspace=Path(given)))
    assert lack in words and words.endswith("or give the sparse model as --model sparse/0.")


@pytest.mark.parametrize("name", ["mö ved", "it's", "$HOME"])
def test_what_to_give_can_be_copied_into_a_shell(name: str, here: Path) -> None:
    here.joinpath("dense").rename(name)
    here.joinpath("sparse").rename(f"{name} model")
    given = {"model": Path(name), "workspace": Path(f"{name} model/0")}
    for option, path in given.items():
        words = sentence(Project(**{option: path})).removesuffix(".")
        other = "--workspace" if option == "model" else "--model"
        assert shlex.split(words[words.index(f"{other} ") :]) == [other, str(path)]
    words = sentence(Project(workspace=Path(f"{name} model"))).removesuffix(".")
    assert shlex.split(words[words.index("--model ") :]) == ["--model", f"{name} model/0"]


def test_a_file_is_given(here: Path) -> None:
    path = Path("sparse/0/images.bin")
    assert "images.bin is a file; give the folder" in sentence(Project(model=path))
    assert "images.bin is a file; give the folder" in sentence(Project(workspace=path))


@pytest.mark.parametrize("more", [(), ("--dry-run",)])
@pytest.mark.parametrize("output", ["file", "file/dense"])
def test_the_output_would_be_a_file(
    output: str, more: tuple[str, ...], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").write_text("mine")
    assert cli.main(["run", "--model", "sparse/0", "--output", output, *more]) == 3
    assert capsys.readouterr().err == "error: file is no folder; choose another --output.\n"
    assert Path("file").read_text() == "mine"


@pytest.mark.parametrize(
    "command",
    [
        ["run", "--model"],
        ["run", "--workspace"],
        ["export"],
        ["view"],
        ["stereo_fusion", "--output_path", "fused.ply", "--workspace_path"],
        ["patch_match_stereo", "--workspace_path"],
    ],
)
@pytest.mark.parametrize("place", ["closed/project", "closed/folder/../project", "closed/../project"])
def test_a_folder_that_may_not_be_entered(
    command: list[str],
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The system refuses whatever leads through it, also where it leads out again; root would be let in."""
    closed = f"{tmp_path}/closed/"

    def refusing(real: Callable[..., os.stat_result]) -> Callable[..., os.stat_result]:
        def look(path: Any, *arguments: Any, **options: Any) -> os.stat_result:
            if isinstance(path, str | os.PathLike) and os.fspath(path).startswith(closed):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
            return real(path, *arguments, **options)

        return look

    for name in ("stat", "lstat"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))
    folder = tmp_path / place
    assert cli.main([*command, str(folder)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said == f"error: {folder} cannot be read (Permission denied); check its permissions."
    assert Project(model=folder / "sparse" / "0").root.name == "dense"


def test_models_inside_a_folder(here: Path) -> None:
    """That of a workspace, which was made of another, comes last; what is not complete is none."""
    shutil.copytree("sparse/0", "sparse/1")
    shutil.copytree("sparse/0", "sparse/2")
    Path("sparse/1/points3D.bin").unlink()
    assert models_inside(Path()) == [Path("sparse/0"), Path("sparse/2"), Path("dense/sparse")]
    assert models_inside(Path("sparse/0")) == []


def test_mistakes_are_told_by_the_command(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(here.rglob("*"))
    for arguments in ([], ["--model", "dense"], ["--workspace", "sparse/0"], ["--workspace", "."]):
        assert cli.main(["run", *arguments]) == 2
        output = capsys.readouterr().err
        assert output.count("error: ") == 1 and "Traceback" not in output
    assert sorted(here.rglob("*")) == before


def test_a_workspace_of_our_own_is_opened(tmp_path: Path) -> None:
    root = prepare(make_project(tmp_path), tmp_path / "dense").root
    assert open_workspace(Project(workspace=root)).root == root
