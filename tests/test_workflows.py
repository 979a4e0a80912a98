"""Batches of projects: each is run, and what became of it is said."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import keep_images
from projects import write_picture

from colmap_sph.synthetic import DemoBlock

WORKFLOWS = Path(__file__).parents[1] / "workflows"
HOSTILE = "a <script>alert(1)</script>&\"'"

# Does as it is told by the file `do` in the model: an exit code, and a message.
STUB = """#!/bin/bash
echo "$@" >> "$CALLS"
while [ $# -gt 0 ]; do
    case $1 in --model) model=$2 ;; --output) dense=$2 ;; esac
    shift
done
read -r code message < "$model/do"
if [ "$code" = 0 ] || [ "$code" = 5 ]; then
    mkdir -p "$dense/colmap_sph"
    cp "$model/report.json" "$dense/colmap_sph/"
else
    echo "warning: something else" >&2
    echo "error: $message" >&2
fi
exit "$code"
"""


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program in place of ours; the file it lists its calls in."""
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "colmap_sph").write_text(STUB)
    (folder / "colmap_sph").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    return tmp_path / "calls"


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """This program on the PATH."""
    path = tmp_path / "bin/colmap_sph"
    path.parent.mkdir()
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -P -m colmap_sph "$@"\n')
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}:{os.environ['PATH']}")
    return path


def add_model(root: Path, name: str, code: int, message: str = "") -> Path:
    model = root / name
    model.mkdir(parents=True)
    (model / "images.txt").touch()
    (model / "do").write_text(f"{code} {message}\n")
    report = {
        "images": 2,
        "points": 1234,
        "coverage": {"a": 0.5, "b": 1.0},
        "seconds": {"match": 10.0, "fuse": 2.0},
        "skipped_images": {"c.jpg": "it is missing"} if code == 5 else {},
    }
    (model / "report.json").write_text(json.dumps(report))
    return model


def called(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        list(map(str, arguments)),
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",
        timeout=120,
        cwd=cwd,
    )


def test_a_batch_of_all_kinds(tmp_path: Path, stub: Path) -> None:
    root = tmp_path / "survey"
    add_model(root, "one/sparse/0", 0)
    add_model(root, "one/sparse/1", 5)
    add_model(root, "two/deep/sparse/0", 2, "The model is damaged; mend it.")
    add_model(root, f"{HOSTILE}/sparse/0", 4, f"No pair of {HOSTILE} overlaps.")
    (root / "empty/sparse/0").mkdir(parents=True)
    (root / "one/sparse/10/images").mkdir(parents=True)
    done = called(WORKFLOWS / "batch.sh", root, "--num-pairs", "3")
    assert done.returncode == 1, done.stderr
    calls = [
        f"run --model {root}/{name} --output {root}/{dense} --num-pairs 3"
        for name, dense in (
            (f"{HOSTILE}/sparse/0", f"{HOSTILE}/dense"),
            ("one/sparse/0", "one/dense"),
            ("one/sparse/1", "one/dense-1"),
            ("two/deep/sparse/0", "two/deep/dense"),
        )
    ]
    assert sorted(stub.read_text().splitlines()) == sorted(calls)
    assert "error: The model is damaged" in done.stderr
    assert "==== 4 projects, 2 failed" in done.stdout
    rows = [line.split("\t") for line in (root / "colmap_sph_batch.tsv").read_text().splitlines()]
    found = {row[0].removeprefix(f"{root}/"): row[1:] for row in rows[1:]}
    numbers = ["2", "1234", "75.0 %", "12", ""]
    assert found == {
        "one/sparse/0": ["done", *numbers, ""],
        "one/sparse/1": ["incomplete", *numbers, "c.jpg: it is missing"],
        "two/deep/sparse/0": ["FAILED (2)", "", "", "", "", "", "The model is damaged; mend it."],
        f"{HOSTILE}/sparse/0": ["FAILED (4)", "", "", "", "", "", f"No pair of {HOSTILE} overlaps."],
    }
    page = (root / "colmap_sph_batch.html").read_text()
    assert "<script" not in page and page.count("<tr") == 5
    assert '<a href="./one/dense-1/colmap_sph/report.json">' in page


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")
@pytest.mark.parametrize("root", ["-root", "link"])
def test_a_batch_of_odd_names(root: str, tmp_path: Path, stub: Path) -> None:
    """None is left out for its name, which was written on another system, and none is taken for an option."""
    names = {b"-q", "Straße".encode("latin-1"), b"two\nlines", "Übung".encode()}
    (tmp_path / "link").symlink_to("-root")
    for name in names:
        add_model(tmp_path / "-root", f"{os.fsdecode(name)}/sparse/0", 0)
    done = called(WORKFLOWS / "batch.sh", root, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "==== 4 projects, 0 failed" in done.stdout
    assert {name for name in names if (tmp_path / root / os.fsdecode(name) / "dense/colmap_sph").is_dir()} == names


def link_projects(tmp_path: Path) -> Path:
    """A folder of a project, one linked from elsewhere, one with the first one's model, and links in a circle."""
    root = tmp_path / "survey"
    add_model(root, "one/sparse/0", 0)
    add_model(tmp_path / "away", "two/sparse/0", 0)
    (root / "two").symlink_to("../away/two")
    (root / "three").mkdir()
    (root / "three/sparse").symlink_to("../one/sparse")
    (root / "one/up").symlink_to("..")
    (root / "zero").symlink_to("one")
    return root


def test_a_batch_of_links(tmp_path: Path, stub: Path) -> None:
    """Users collect projects from several disks so."""
    root = link_projects(tmp_path)
    assert called(WORKFLOWS / "batch.sh", root).returncode == 0
    assert stub.read_text().splitlines() == [
        f"run --model {root}/{name}/sparse/0 --output {root}/{name}/dense" for name in ("one", "three", "two")
    ]


def test_a_batch_lists_products(tmp_path: Path, stub: Path) -> None:
    root = tmp_path / "survey"
    add_model(root, "one/sparse/0", 0)
    for name in ("one/dense/surface/dsm.tif", "one/dense/export/cloud.laz"):
        (root / name).parent.mkdir(parents=True)
        (root / name).touch()
    (root / "one/dense/mesh").mkdir()
    assert called(WORKFLOWS / "batch.sh", root).returncode == 0
    row = (root / "colmap_sph_batch.tsv").read_text().splitlines()[1].split("\t")
    assert row[6] == "surface export"
    page = (root / "colmap_sph_batch.html").read_text()
    assert '<a href="./one/dense/surface">surface</a> <a href="./one/dense/export">export</a>' in page


def test_a_batch_of_nothing(tmp_path: Path, stub: Path) -> None:
    done = called(WORKFLOWS / "batch.sh", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no folder with sparse/0" in done.stderr


def test_an_interrupted_batch_ends(tmp_path: Path, stub: Path) -> None:
    for name in ("a/sparse/0", "b/sparse/0"):
        add_model(tmp_path, name, 130)
    done = called(WORKFLOWS / "batch.sh", tmp_path)
    assert done.returncode == 130
    assert len(stub.read_text().splitlines()) == 1


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_array_of_slurm(end: str, tmp_path: Path, stub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    models = [add_model(tmp_path, f"p\x85{number}/sparse/0", number) for number in (0, 5, 2)]
    (tmp_path / "models.txt").write_text("".join(f"{model}{end}" for model in models), newline="")
    codes = []
    for task in (1, 2, 3, 4):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
        codes.append(
            called(WORKFLOWS / "slurm_array.sh", tmp_path / "models.txt", "--output", tmp_path).returncode
        )
    assert codes == [0, 0, 2, 2]
    assert stub.read_text().split("\n")[:-1] == [f"run --model {model} --output {tmp_path}" for model in models]
    called(WORKFLOWS / "batch_summary.py", tmp_path / "models.txt", "--output", tmp_path / "models")
    rows = (tmp_path / "models.tsv").read_text().splitlines()[1:]
    assert [row.partition("\t")[0] for row in rows] == [str(model).replace("\x85", "\\x85") for model in models]


def test_batch_and_summary_of_real_projects(
    project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, program: Path
) -> None:
    """Two models of one project, of which one is damaged; the summary of a list finds the same afterwards."""
    root = tmp_path_factory.mktemp("survey")
    keep_images(project, ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg"])
    shutil.copytree(project / "sparse", root / "p/sparse")
    shutil.copytree(project / "images", root / "p/images")
    shutil.copytree(root / "p/sparse/0", root / "p/sparse/1")
    (root / "p/sparse/1/points3D.bin").write_bytes(b"")
    done = called(WORKFLOWS / "batch.sh", root, "--num-pairs", "2", "--threads", "2")
    assert done.returncode == 1, done.stderr
    header, good, bad = (line.split("\t") for line in (root / "colmap_sph_batch.tsv").read_text().splitlines())
    report = json.loads((root / "p/dense/colmap_sph/report.json").read_text())
    assert good[1:4] == ["done", "3", str(report["points"])]
    assert bad[1] == "FAILED (2)" and "points3D.bin" in bad[-1]
    (root / "models.txt").write_text(f"{root}/p/sparse/0\n{root}/p/sparse/1\n")
    done = called(sys.executable, WORKFLOWS / "batch_summary.py", "models.txt", "--output", "list", cwd=root)
    assert done.returncode == 1, done.stderr
    again = [line.split("\t") for line in (root / "list.tsv").read_text().splitlines()]
    assert again[:2] == [header, good]
    assert again[2][1] == "not run"
    assert '<a href="./p/dense/colmap_sph/report' in (root / "list.html").read_text()
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    done = called(WORKFLOWS / "slurm_array.sh", "models.txt", "--num-pairs", "2", cwd=root)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, f"{root}/p/sparse/0: complete"), done.stderr


# ---- Snakemake ------------------------------------------------------------------------------------------------


SNAKEMAKE = shutil.which("snakemake", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
needs_snakemake = pytest.mark.skipif(SNAKEMAKE is None, reason="snakemake is not installed")


def snakemake(root: Path, *settings: str) -> subprocess.CompletedProcess[str]:
    command = [SNAKEMAKE, "--snakefile", WORKFLOWS / "Snakefile", "--directory", root, "--cores", "2"]
    return called(*command, "--keep-going", "--config", *settings)


def table_of(root: Path) -> dict[str, list[str]]:
    rows = [line.split("\t") for line in (root / "colmap_sph_batch.tsv").read_text().splitlines()]
    return {row[0]: row[1:] for row in rows[1:]}


@needs_snakemake
def test_snakemake_with_models_of_all_kinds(tmp_path: Path, stub: Path) -> None:
    """All are tried; afterwards only those that failed are."""
    root = tmp_path / "survey"
    add_model(root, "one/sparse/0", 0)
    add_model(root, "one/sparse/1", 5)
    add_model(root, f"{HOSTILE} {{x}}/sparse/0", 4, f"No pair of {HOSTILE} overlaps.")
    deep = "/".join(["ein sehr langer Name für eine Befliegung"] * 5)
    bad = add_model(root, f"{deep}/sparse/0", 2, "The model is damaged; mend it.")
    settings = ("dense_options=--num-pairs 3", "dense_memory_mb=900", "dense_threads=1")
    done = snakemake(root, *settings)
    assert done.returncode == 1, done.stderr
    calls = {
        f"run --model {root}/{name} --output {root}/{dense} --threads 1 --memory 900MB --num-pairs 3"
        for name, dense in (
            (f"{HOSTILE} {{x}}/sparse/0", f"{HOSTILE} {{x}}/dense"),
            ("one/sparse/0", "one/dense"),
            ("one/sparse/1", "one/dense-1"),
            (f"{deep}/sparse/0", f"{deep}/dense"),
        )
    }
    assert sorted(stub.read_text().splitlines()) == sorted(calls)
    numbers = ["2", "1234", "75.0 %", "12", ""]
    expected = {
        "one/sparse/0": ["done", *numbers, ""],
        "one/sparse/1": ["incomplete", *numbers, "c.jpg: it is missing"],
        f"{deep}/sparse/0": ["FAILED (2)", "", "", "", "", "", "The model is damaged; mend it."],
        f"{HOSTILE} {{x}}/sparse/0": ["FAILED (4)", "", "", "", "", "", f"No pair of {HOSTILE} overlaps."],
    }
    assert table_of(root) == expected
    assert '<a href="./one/dense-1/colmap_sph/report.json">' in (root / "colmap_sph_batch.html").read_text()
    stub.unlink()
    (bad / "do").write_text("0\n")
    done = snakemake(root, *settings)
    assert done.returncode == 1, done.stderr
    assert set(stub.read_text().splitlines()) == {call for call in calls if "/one/" not in call}
    assert table_of(root) == {**expected, f"{deep}/sparse/0": ["done", *numbers, ""]}


@needs_snakemake
def test_snakemake_with_links(tmp_path: Path, stub: Path) -> None:
    root = link_projects(tmp_path)
    assert snakemake(root).returncode == 0
    assert table_of(root).keys() == {"one/sparse/0", "three/sparse/0", "two/sparse/0"}


@needs_snakemake
@pytest.mark.skipif(shutil.which("colmap") is None, reason="colmap is not installed")
def test_snakemake_from_images_to_clouds(
    block: DemoBlock, tmp_path_factory: pytest.TempPathFactory, program: Path
) -> None:
    """COLMAP's structure from motion first; what it cannot do costs its project alone."""
    root = tmp_path_factory.mktemp("survey")
    for name in ("N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"):
        (root / "good/images").mkdir(parents=True, exist_ok=True)
        shutil.copy(block.images_dir / name, root / "good/images")
    (root / "blank/images").mkdir(parents=True)
    for name in ("a.png", "b.png"):
        write_picture(root / "blank/images" / name, np.zeros((60, 80, 3), np.uint8))
    settings = ("feature_options=--ImageReader.single_camera 1", "dense_options=--num-pairs 2")
    done = snakemake(root, *settings)
    assert done.returncode == 1, done.stderr
    table = table_of(root)
    assert table["blank/images"][0] == "FAILED (models)"
    assert table["good/sparse/0"][0] == "done"
    report = json.loads((root / "good/dense/colmap_sph/report.json").read_text())
    assert table["good/sparse/0"][1:3] == [str(report["images"]), str(report["points"])]
    assert report["images"] == 4 and report["overall_agreement"] > 0.7
    # One image less: models and cloud are made again.
    shutil.rmtree(root / "blank")
    (root / "good/images/N_1_1.jpg").unlink()
    done = snakemake(root, *settings)
    assert done.returncode == 0, done.stderr
    assert table_of(root)["good/sparse/0"][:2] == ["done", "3"]


@needs_snakemake
@pytest.mark.parametrize(
    ("setting", "reason"),
    [("matcher=x", "matcher must be"), ("matcher=spatial", "No folder below")],
)
def test_snakemake_refuses_in_a_sentence(tmp_path: Path, stub: Path, setting: str, reason: str) -> None:
    done = snakemake(tmp_path, setting)
    assert done.returncode == 1
    assert reason in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "damaged", ["[1]", '{"coverage": ["x"]}', '{"seconds": {"fuse": "x"}}', '{"incomplete": 3}']
)
def test_one_damaged_report_does_not_cost_the_summary(tmp_path: Path, damaged: str) -> None:
    sound = '{"images": 7, "points": 70, "seconds": {"fuse": 30}, "total_seconds": 41.6}'
    for name, text in (("a", damaged), ("b", sound)):
        state = tmp_path / name / "dense/colmap_sph"
        state.mkdir(parents=True)
        (state / "report.json").write_text(text)
        (state / "log.txt").write_text("Done\n")
    (tmp_path / "models.txt").write_text("a/sparse/0\nb/sparse/0\n")
    done = called(sys.executable, WORKFLOWS / "batch_summary.py", "models.txt", "--output", "list", cwd=tmp_path)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    rows = [line.split("\t") for line in (tmp_path / "list.tsv").read_text().splitlines()]
    assert rows[1][:2] == ["a/sparse/0", "FAILED (?)"]
    assert rows[2][:6] == ["b/sparse/0", "done", "7", "70", "0.0 %", "42"]
