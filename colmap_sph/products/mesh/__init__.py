"""Depth maps or a cloud → a mesh, as PLY and GLB."""
