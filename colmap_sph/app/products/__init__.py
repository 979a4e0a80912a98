"""The commands that make products of a finished workspace."""
