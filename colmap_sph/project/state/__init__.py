"""What of a workspace is ours: results in files of our own, and records of those in COLMAP's formats."""
