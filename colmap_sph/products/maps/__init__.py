"""Depth maps of a workspace at the centres of pixels → files that other programs read."""
