"""A mesh and the images that see it → a textured mesh."""
