"""What ties a model to the map: positions of its cameras, and control points in its images."""
