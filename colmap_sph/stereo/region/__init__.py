"""What of a scene is asked for: which points lie inside, and what of the scene and of its images shows them."""
