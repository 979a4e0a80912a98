"""What a lens does to images beyond its camera model: a free field of displacements, on disk and applied."""
