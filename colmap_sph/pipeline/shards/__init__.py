"""Parts of a stage, made by jobs that know nothing of each other: for job arrays without an engine."""
