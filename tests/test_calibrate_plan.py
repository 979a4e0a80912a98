"""What the calibration of plans prints: ratios of known numbers."""

import importlib
from typing import Any

import pytest


@pytest.mark.usefixtures("scripts_on_path")
def test_ratios_of_plans_and_runs() -> None:
    script = importlib.import_module("calibrate_plan")

    def comparison(name: str, threads: int, measured: float) -> Any:
        plan = {"seconds": 6.0, "memory": 3e8, "disk": 5e8, "stages": [{"name": "fuse", "seconds": 2.0}]}
        return script.Comparison(name, threads, plan, {"fuse": measured}, 12.0, 2e8, 5e8)

    comparisons = [comparison("block", 1, 1.0), comparison("wall", 1, 4.0), comparison("wall", 0, 9.0)]
    assert "| block, 1 threads | 6.0 / 12.0 = 0.50 | 300.0 / 200.0 = 1.50 | 500.0 / 500.0 = 1.00 |" in (
        script.totals(comparisons).splitlines()
    )
    # Measured by planned, of runs with one thread: a half and two, whose geometric mean is one.
    assert script.factors(comparisons).splitlines()[-1] == "| fuse | 0.50 | 2.00 | 1.00 |"
