"""Fisheyes and panoramas: their rays beyond 90 degrees, and the pinhole views that are cut from their images."""
