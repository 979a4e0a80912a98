"""Depth maps → surface model, hillshade and true orthophoto."""
