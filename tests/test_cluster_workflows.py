"""The recipes for clusters: scheduler, workers and run are started as they should, and all of them end."""

import os
import shlex
import subprocess
import time
from pathlib import Path

import psutil
import pytest

RECIPES = Path(__file__).parents[1] / "workflows/cluster"
LOG = 'echo "$(basename "$0") $(printf "%q " "$@")" >> "$CALLS"'

STAND_INS = {
    # The scheduler tells where it is, and goes on until it is ended; workers leave by themselves.
    "dask": f"""#!/bin/bash
{LOG}
if [ "$1" = scheduler ]; then echo $$ > "$CALLS.pid"; touch "$3"; exec sleep 60; fi
""",
    "colmap_sph": f"""#!/bin/bash
for file; do :; done
while [ ! -e "$file" ] || [ "$(grep -c "^dask worker" "$CALLS")" -lt 2 ]; do sleep 0.02; done
{LOG}
exit 5
""",
    "srun": """#!/bin/bash
while [[ $1 == --* ]]; do shift; done
"$@"; "$@"
""",
    "pbsdsh": """#!/bin/bash
shift
env -i CALLS="$CALLS" PATH=/usr/bin:/bin "$@"; env -i CALLS="$CALLS" PATH=/usr/bin:/bin "$@"
""",
    "ssh": """#!/bin/bash
echo "ssh ${*: -2:1}" >> "$CALLS.ssh"
env -i CALLS="$CALLS" PATH=/usr/bin:/bin /bin/sh -c "${*: -1}"
""",
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a blank in its name, which is the current one; the programs are stand-ins."""
    folder = tmp_path / "the project"
    programs = tmp_path / "some bin"
    for each in (folder, programs):
        each.mkdir()
    for name, text in STAND_INS.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    return folder


def calls_of(*command: object, code: int = 5) -> list[list[str]]:
    """What was called when a recipe came to its end, with the exit code of the run."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == code, done.stderr
    calls = Path(os.environ["CALLS"])
    scheduler = int(Path(f"{calls}.pid").read_text())
    limit = time.monotonic() + 20
    while psutil.pid_exists(scheduler):
        assert time.monotonic() < limit
        time.sleep(0.02)
    return [shlex.split(line) for line in calls.read_text().splitlines()]


def check(calls: list[list[str]], file: Path, threads: tuple[str, str] | None) -> None:
    (scheduler,) = (call for call in calls if call[:2] == ["dask", "scheduler"])
    workers = [call for call in calls if call[:2] == ["dask", "worker"]]
    (run,) = (call for call in calls if call[0] == "colmap_sph")
    assert scheduler[2:] == ["--scheduler-file", str(file)]
    assert len(workers) == 2
    for worker in workers:
        options = dict(zip(worker[2::2], worker[3::2], strict=True))
        assert options["--scheduler-file"] == str(file)
        assert (options.get("--nworkers"), options.get("--nthreads")) == (threads or (None, None))
    assert run[1:] == ["run", "--model", "sparse/0", "--num-pairs", "4", "--scheduler", str(file)]
    assert not file.exists()


OPTIONS = ["--model", "sparse/0", "--num-pairs", "4"]


@pytest.mark.parametrize(("cores", "threads"), [("32", ("4", "8")), ("6", ("1", "6")), ("20", ("3", "7"))])
def test_slurm(place: Path, cores: str, threads: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SUBMIT_DIR", place), ("JOB_ID", 7), ("CPUS_PER_TASK", cores)):
        monkeypatch.setenv(f"SLURM_{name}", str(value))
    check(calls_of(RECIPES / "slurm.sh", *OPTIONS), place / ".scheduler-7.json", threads)


def test_pbs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"PBS_O_WORKDIR": str(place), "PBS_JOBID": "7.head", "NCPUS": "16", "OPTIONS": " ".join(OPTIONS)}
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    check(calls_of(RECIPES / "pbs.sh"), place / ".scheduler-7.head.json", ("2", "8"))


def test_ssh(place: Path) -> None:
    calls = calls_of(RECIPES / "ssh.sh", "alpha beta", *OPTIONS)
    file = next(Path(call[3]) for call in calls if call[:2] == ["dask", "scheduler"])
    check(calls, file, None)
    assert file.parent == place
    assert sorted(Path(f"{os.environ['CALLS']}.ssh").read_text().split()) == ["alpha", "beta", "ssh", "ssh"]


@pytest.mark.parametrize("recipe", ["slurm.sh", "pbs.sh", "ssh.sh"])
def test_without_its_surroundings(recipe: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith(("SLURM_", "PBS_")):
            monkeypatch.delenv(name)
    done = subprocess.run([RECIPES / recipe], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode != 0
    assert "submit with" in done.stderr or "usage: ssh.sh" in done.stderr


# ---- shards ------------------------------------------------------------------------------------------------

SHARD_STAND_INS = {
    # Fails where a file says so.
    "colmap_sph": f"""#!/bin/bash
{LOG}
case "$*" in
    *"--stage prepare") exit $(cat "$CALLS.prepare" 2>/dev/null || echo 0) ;;
    *"--shard 2/3") [ ! -e "$CALLS.second" ] || exit $(cat "$CALLS.second") ;;
esac
""",
    # Does at once what it is given, but for jobs that wait for one that failed.
    "sbatch": """#!/bin/bash
job=$(($(cat "$CALLS.job" 2>/dev/null || echo 40) + 1))
echo $job > "$CALLS.job"
tasks=("")
while [[ $1 == --* ]]; do
    case $1 in
        --array=*-*) tasks=($(seq "${1#--array=1-}")) ;;
        --array=*) tasks=("${1#--array=}") ;;
        --dependency=afterok:*) if [ -e "$CALLS.failed-${1##*:}" ]; then touch "$CALLS.failed-$job"; fi ;;
    esac
    shift
done
for task in "${tasks[@]}"; do
    [ -e "$CALLS.failed-$job" ] && break
    SLURM_ARRAY_TASK_ID=$task bash "$@" >> "$CALLS.said" 2>&1 || touch "$CALLS.failed-$job"
done
echo "$job;some cluster"
""",
    "parallel": """#!/bin/bash
while [[ $1 == --* ]]; do [ "$1" = --halt ] && shift; shift; done
while read -r item; do "${@//\\{\\}/$item}" || exit 1; done
""",
}
SHARD_OPTIONS = ["--model", "sparse/0", "--masks", "black & white"]


@pytest.fixture
def shard_place(place: Path) -> Path:
    for name, text in SHARD_STAND_INS.items():
        program = place.parent / "some bin" / name
        program.write_text(text)
        program.chmod(0o755)
    return place


def shard_calls(*command: object, code: int = 0) -> list[list[str]]:
    """What followed the options in each call of the program."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code, done.stderr
    calls = [shlex.split(line) for line in Path(os.environ["CALLS"]).read_text().splitlines()]
    begin = ["colmap_sph", "run", *SHARD_OPTIONS]
    assert all(call[: len(begin)] == begin for call in calls)
    return [call[len(begin) :] for call in calls]


STAGES = ["match", "vote", "confirm"]
ALL_SHARDS = [
    ["--stage", "prepare"],
    *(["--stage", stage, "--shard", f"{number}/3"] for stage in STAGES for number in (1, 2, 3)),
    [],
]


@pytest.mark.parametrize("recipe", ["slurm_shards.sh", "parallel_shards.sh"])
def test_shards(recipe: str, shard_place: Path) -> None:
    assert shard_calls(RECIPES / recipe, 3, *SHARD_OPTIONS) == ALL_SHARDS


@pytest.mark.parametrize("recipe", ["slurm_shards.sh", "parallel_shards.sh"])
def test_images_that_cannot_be_used_end_no_shards(recipe: str, shard_place: Path) -> None:
    Path(f"{os.environ['CALLS']}.prepare").write_text("5")
    assert shard_calls(RECIPES / recipe, 3, *SHARD_OPTIONS) == ALL_SHARDS


@pytest.mark.parametrize("recipe", ["slurm_shards.sh", "parallel_shards.sh"])
@pytest.mark.parametrize("code", ["5", "6"])
def test_nothing_follows_a_shard_that_failed(code: str, recipe: str, shard_place: Path) -> None:
    Path(f"{os.environ['CALLS']}.second").write_text(code)
    calls = shard_calls(RECIPES / recipe, 3, *SHARD_OPTIONS, code=recipe.startswith("parallel"))
    assert calls == ALL_SHARDS[:3]


def test_nothing_follows_a_preparation_that_failed(shard_place: Path) -> None:
    Path(f"{os.environ['CALLS']}.prepare").write_text("2")
    assert shard_calls(RECIPES / "slurm_shards.sh", 3, *SHARD_OPTIONS) == ALL_SHARDS[:1]


def test_one_shard_again(shard_place: Path) -> None:
    again = ["sbatch", "--array=2", RECIPES / "slurm_shards.sh", "vote", 3, *SHARD_OPTIONS]
    assert shard_calls(*again) == [["--stage", "vote", "--shard", "2/3"]]


@pytest.mark.parametrize("recipe", ["slurm_shards.sh", "parallel_shards.sh"])
def test_shards_without_a_number(recipe: str, shard_place: Path) -> None:
    done = subprocess.run([RECIPES / recipe], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode != 0
    assert f"usage: {recipe} SHARDS" in done.stderr
