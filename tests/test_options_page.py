"""docs/options.md says what the code says."""

import importlib

import pytest


@pytest.mark.usefixtures("scripts_on_path")
def test_the_page_of_options_is_current() -> None:
    docs = importlib.import_module("make_option_docs")
    assert docs.PAGE.read_text(encoding="utf-8") == docs.page(), "run python scripts/make_option_docs.py"
