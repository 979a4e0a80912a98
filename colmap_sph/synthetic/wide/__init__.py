"""Cameras that see more than a pinhole can, and a courtyard taken with them."""
