"""Damaged files end in one sentence or a right result, never in a crash, a hang or a traceback."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from corruption import damage_bytes, make_cases
from test_undistortion import make_project

from colmap_sph.errors import ColmapSphError, InputError
from colmap_sph.project.map_files import (
    check_map,
    read_depth_map,
    read_normal_map,
    write_depth_map,
    write_normal_map,
)

NUM_COMMANDS = 248
NUM_MAPS = 90


def run_cases(project: Path, first: int, last: int) -> tuple[dict[int, str], list[str]]:
    """Result of each case, and those at which the process ended; these are left out and the rest goes on."""
    results: dict[int, str] = {}
    deaths: list[str] = []
    while first < last:
        done = subprocess.run(
            [sys.executable, Path(__file__).with_name("corruption.py"), project, str(first), str(last)],
            capture_output=True,
            text=True,
            timeout=3600,  # against commands that never end; no measure of speed
        )
        begun = ""
        for line in done.stdout.splitlines():
            word, seed, *rest = line.split(" ", 2)
            if word == "BEGIN":
                begun = line
                first = int(seed) + 1
            elif word == "END":
                begun = ""
                results[int(seed)] = "".join(rest)
        if begun:
            deaths.append(f"{begun}: exit code {done.returncode}, {done.stderr[-500:]}")
        else:
            assert done.returncode == 0, done.stderr
    return results, deaths


def test_damaged_models_images_masks_and_workspaces(tmp_path: Path) -> None:
    """Through the command, in a process that may use 8 GiB and 30 seconds for each."""
    make_project(tmp_path, "OPENCV", (0.05, 0.01, 1e-3, -1e-3))
    make_cases(tmp_path)
    results, deaths = run_cases(tmp_path, 0, NUM_COMMANDS)
    assert deaths == []
    assert len(results) == NUM_COMMANDS
    assert [f"{seed}: {result}" for seed, result in results.items() if result.startswith("BROKEN")] == []
    codes = [int(result.split()[0]) for result in results.values()]
    assert set(codes) <= {0, 2, 4, 5}
    # The damage is real, and not the end of everything.
    assert codes.count(2) > NUM_COMMANDS / 4
    assert codes.count(0) > NUM_COMMANDS / 10


@pytest.mark.parametrize("seed", range(NUM_MAPS))
def test_damaged_maps(seed: int, tmp_path: Path) -> None:
    """What is read has the shape that the check before fusion saw; else both refuse the file."""
    rng = np.random.default_rng(seed)
    path = tmp_path / "map.bin"
    shape: tuple[int, ...] = (5, 7) if seed % 2 else (5, 7, 3)
    write, read = (write_depth_map, read_depth_map) if seed % 2 else (write_normal_map, read_normal_map)
    write(path, rng.random(shape, dtype=np.float32))
    data = path.read_bytes()
    # Half of the damage to the header, which is short.
    damaged = damage_bytes(data[:12], rng) + data[12:] if seed % 4 < 2 else damage_bytes(data, rng)
    path.write_bytes(damaged)
    try:
        found = read(path)
    except ColmapSphError as error:
        assert str(path) in str(error)
        with pytest.raises(InputError):
            check_map(path, shape)
    else:
        assert found.dtype == np.float32
        check_map(path, found.shape)
        assert len(damaged) == len(data)
