"""The benchmarks: their arithmetic on made-up numbers, what they refuse, and small whole runs."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import SCRIPTS

from colmap_sph import _native
from colmap_sph.app import cli
from colmap_sph.synthetic import DemoBlock

pytestmark = pytest.mark.usefixtures("scripts_on_path")


@pytest.fixture
def kernels():
    return importlib.import_module("bench_kernels")


@pytest.fixture
def pipeline():
    return importlib.import_module("bench_pipeline")


# ---- kernels -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("same_range", [True, False])
def test_the_pair_has_its_disparities(kernels, same_range):
    """At the true disparity the images differ by their noise, and the search range holds it."""
    scene = kernels.make_scene(200, 60, 64, same_range=same_range)
    rows, columns = np.indices(scene.shape)
    target = columns - np.round(scene.disparity).astype(int)
    inside = target >= 0
    there = scene.right[rows[inside], target[inside]].astype(float)
    elsewhere = scene.right[rows[inside], (target[inside] + 7) % 200].astype(float)
    left = scene.left[inside].astype(float)
    assert np.abs(left - there).mean() < 0.5 * np.abs(left - elsewhere).mean()
    slot = -scene.disparity - scene.base
    assert (slot > 1).all() and (slot < scene.depth - 2).all()


def test_partners_agree_with_the_scene(kernels):
    scene = kernels.make_scene(200, 60, 64, same_range=True)
    check, refine = kernels.partner_kernels(scene)
    check.call("scalar")
    refine.call("scalar")
    observing, agreeing, contradicting = check.outputs[0]
    assert agreeing.mean() > 0.5 and agreeing.sum() > 0.9 * observing.sum() and contradicting.mean() < 0.01
    assert (refine.outputs[0][0] > 0).mean() > 0.3


def test_the_whole_benchmark_of_kernels(kernels, monkeypatch, capsys):
    monkeypatch.setattr(kernels, "copy_bandwidth", lambda: 6e9)
    monkeypatch.setattr(kernels, "vector_throughput", lambda register: "there is no compiler")
    arguments = ["bench_kernels.py", "--width", "200", "--height", "60", "--disparities", "96", "--runs", "1"]
    monkeypatch.setattr(sys, "argv", arguments)
    kernels.main()
    printed = capsys.readouterr().out
    of_images = ("census", "fit_offsets", "depth_candidates", "fit_planes")
    for name in (*of_images, "compare_depths", "add_patch_equations"):
        assert re.search(rf"^\| {name} \| - \| Mpixel/s \|", printed, re.MULTILINE)
    for depth in (96, 32, 64):
        for name in ("matching_cost", "aggregation", "selection", "match"):
            assert re.search(rf"^\| {name} \| {depth} \| MDE/s \|", printed, re.MULTILINE)
        right = re.search(rf"^\| colmap_sph match \| {depth} \| ([\d.]+) \|", printed, re.MULTILINE)
        assert right and float(right[1]) > 60
        assert re.search(rf"^\| OpenCV MODE_HH \| {depth} \|.*\| 1\.00 \|$", printed, re.MULTILINE)
    if _native.backends()[0] != "scalar":
        assert "6.0 GB/s; `match` moves 4 bytes per slot: at most 1500 MDE/s." in printed
        assert "No arithmetic bound: there is no compiler." in printed


def test_a_version_that_differs_in_one_bit_ends_the_benchmark(kernels):
    def call(backend):
        output[:] = 5
        output[3] += backend == "fast"

    output = np.zeros(9, dtype=np.uint16)
    kernel = kernels.Kernel("census", call, [output], 9, 32)
    kernels.check_equality(kernel, ["slow", "slow"])
    with pytest.raises(SystemExit, match="error: census with 32 disparities: fast and slow differ"):
        kernels.check_equality(kernel, ["fast", "slow"])


def test_a_version_that_writes_nothing_ends_the_benchmark(kernels):
    """The other version's result must not be taken for its own."""
    output = np.zeros(9, dtype=np.uint16)
    kernel = kernels.Kernel("census", lambda backend: output.fill(5) if backend == "slow" else None, [output], 9)
    with pytest.raises(SystemExit, match="differ"):
        kernels.check_equality(kernel, ["fast", "slow"])


def test_the_nearer_limit_bounds(kernels):
    throughput = {32: 10e9, 64: 5e9}
    assert kernels.limit_mde({32: 200}, 6, throughput, 24e9) == pytest.approx(1600)  # 10e9 * 32 / 200 per second
    assert kernels.limit_mde({32: 100, 64: 50}, 6, throughput, 24e9) == pytest.approx(1600)
    assert kernels.limit_mde({32: 200}, 6, throughput, 6e9) == pytest.approx(1000)


@pytest.mark.parametrize("version", ["avx2", "avx512"])
@pytest.mark.parametrize("depth", [32, 64, 96, 128])
def test_the_matcher_has_its_steps_instructions(kernels, version, depth):
    steps = [kernels.instructions(version, name, depth) for name in ("matching_cost", "aggregation", "selection")]
    match = kernels.instructions(version, "match", depth)
    assert sum(match.values()) == pytest.approx(sum(sum(step.values()) for step in steps))
    # 32 slots fill half a register of 64 bytes: sweeps of such depths have AVX2's.
    assert (32 in match) == (version == "avx2" or depth % 64 == 32)
    assert (64 in match) == (version == "avx512")


@pytest.mark.parametrize(("register", "version"), [(32, "avx2"), (64, "avx512")])
def test_limits_are_measured(register, version):
    limits = importlib.import_module("machine_limits")
    assert 1e8 < limits.copy_bandwidth(runs=1) < 1e13
    instructions = limits.vector_throughput(register, runs=1)
    # Text where there is no compiler, or no such register.
    assert isinstance(instructions, str) or 1e8 < instructions < 1e11
    if version not in _native.backends() and register == 32:
        assert isinstance(instructions, str)


# ---- pipeline ----------------------------------------------------------------------------------------------


def test_growth_and_speedup_of_made_up_runs(pipeline):
    def run(wall, pixels):
        return pipeline.Measured(wall, 2 * wall, 1 << 30, {"fuse": wall / 2}, 3, 4, pixels)

    # Seconds = (pixels / 1e6) ** 1.5, halved by four threads.
    results = {
        pipeline.Setting(size, threads, 10): run(pixels**1.5 / (2 if threads == 4 else 1), pixels * 1_000_000)
        for size, pixels in ((100, 1), (200, 4), (400, 16))
        for threads in (4, 1)
    }
    assert pipeline.exponent([1, 4, 16], [3, 24, 192]) == pytest.approx(1.5)
    growth = "pairs: wall time grows with pixels ** 1.50, processor time with pixels ** 1.50"
    assert pipeline.growth_lines(results) == [f"1 threads, 10 {growth}", f"4 threads, 10 {growth}"]
    gain = "10 pairs: 2.00 with 4 threads, against 1"
    assert pipeline.speedup_lines(results) == [f"size {size}, {gain}" for size in (100, 200, 400)]
    rows = pipeline.results_table(results).splitlines()
    assert rows[3].startswith("| 100 | 1 | 10 | 3 | 4 | 1.00 | 0.50 | 1.00 | 2.00 | 2.00 | 2.00 | 1.00 | 1.00 |")
    assert pipeline.median_run([run(w, 1) for w in (5, 1, 3)]).wall == 3


def test_memory_and_processor_time_are_the_childs_own(tmp_path):
    """A large process before a small one must not be counted for the small one, nor sleep as work."""
    program = """
import json, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from benchmarking import run_process
large = [sys.executable, "-c", "b'x' * (300 << 20); import time; time.sleep(1)"]
small = [sys.executable, "-c", "import time\\nwhile time.process_time() < 0.6: pass"]
failing = [sys.executable, "-c", "raise SystemExit(7)"]
print(json.dumps([run_process(c, Path(sys.argv[2])) for c in (large, small, failing)]))
"""
    arguments = [sys.executable, "-c", program, str(SCRIPTS), str(tmp_path / "log")]
    printed = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    large, small, failing = json.loads(printed)
    assert (large[0], small[0], failing[0]) == (0, 0, 7)
    assert large[3] > 300 << 20 > 100 << 20 > small[3]
    assert large[1] >= 1 > large[2]
    assert 0.6 <= small[2] < 1 and small[1] > 0.59


def bench_pipeline(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPTS / "bench_pipeline.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_whole_benchmark_of_the_pipeline(block: DemoBlock):
    done = bench_pipeline(
        "--model", str(block.sparse_dir), "--sizes", "128", "160", "--threads", "2", "--num-pairs", "2"
    )
    assert done.returncode == 0, done.stderr
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
    header, _, *runs = rows
    assert [run[0] for run in runs] == ["128", "160"]
    for run, shape in zip(runs, ((128, 96), (160, 120)), strict=True):
        assert float(run[header.index("megapixels")]) == pytest.approx(10 * shape[0] * shape[1] / 1e6, abs=0.01)
        stages = [float(cell) for name, cell in zip(header, run, strict=True) if name.endswith(", s")]
        *stages, wall, _ = stages
        assert 0 < sum(stages) < wall
    assert runs[0][header.index("wall, s") + 1] == "1.00"
    assert "2 threads, 2 pairs: wall time grows with pixels **" in done.stdout


def test_a_run_that_fails_ends_the_benchmark_in_one_sentence(tmp_path: Path):
    done = bench_pipeline("--model", str(tmp_path / "nothing"), "--threads", "1")
    assert done.returncode == 1
    assert done.stderr.startswith("error: `") and "ended with exit code 2: " in done.stderr
    assert "Traceback" not in done.stderr and str(tmp_path / "nothing") in done.stderr.partition("code 2")[2]


# ---- ablation ----------------------------------------------------------------------------------------------


def test_variants_of_the_ablation_are_options_of_the_program(capsys, tmp_path):
    """Each gets as far as looking for the model."""
    for options in importlib.import_module("ablation")._VARIANTS.values():
        assert cli.main(["run", "--model", str(tmp_path / "none"), *options]) == 2
        assert "none does not exist" in capsys.readouterr().err


# ---- robustness --------------------------------------------------------------------------------------------


def test_one_case_of_the_robustness_benchmark():
    """Ours, a variant, and a peer that makes nothing."""
    command = [sys.executable, str(SCRIPTS / "bench_robustness.py"), "--only", "clouds", "--strengths", "2"]
    command += ["--size", "0.3", "--variant", "few pairs=--num-pairs 2", "--peer"]
    command += [
        f"idle={sys.executable} -c 'import pathlib; assert pathlib.Path(\"{{workspace}}/sparse\").is_dir()'"
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    header, _, *runs = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if line.startswith("|")]
    ours, variant, idle = (dict(zip(header, run, strict=True)) for run in runs)
    assert [run["method"] for run in (ours, variant, idle)] == ["default", "few pairs", "idle"]
    for run in (ours, variant):
        assert run["case"] == "clouds" and run["strength"] == "0.5 of the blue"
        assert 10 < float(run["coverage %"]) < 100
        assert 0 <= float(run["< 1 GSD %"]) <= float(run["< 2 GSD %"]) <= 100
        accuracy = [float(share) for share in run["accuracy 1 / 2 / 4 GSD"].split(" / ")]
        assert 0 < accuracy[0] <= accuracy[1] <= accuracy[2] <= 100
        assert float(run["processor, s"]) > 0
    assert ours["coverage %"] != variant["coverage %"]
    assert (idle["coverage %"], idle["of sky %"], idle["F"]) == ("0.0", "0.00", "-")


def test_a_peer_that_fails_has_a_row_that_says_so(capsys):
    robustness = importlib.import_module("bench_robustness")
    failing = robustness.Method("broken", (sys.executable, "-c", "raise SystemExit('out of fuel')"), is_peer=True)
    (row,) = robustness.rows_of("none, street", 0, 0.2, [failing], 1)
    assert row[:4] == ["none, street", "0", "broken", "failed"]
    assert "ended with exit code 1: out of fuel" in capsys.readouterr().err
