"""A run of the method: its stages over all pairs and images, what is done already, memory and workers."""
