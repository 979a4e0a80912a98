"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real data; the test is skipped where it is absent."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    folder = Path(os.environ.get("COLMAP_SPH_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set COLMAP_SPH_DATA to their folder")
    return folder
