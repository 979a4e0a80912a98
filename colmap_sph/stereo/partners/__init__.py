"""Which images are matched with which: who sees the same, and who together see all of an image."""
