"""Parts of `study_rectification.py`: runs, pairs, clouds, plots, tables."""
