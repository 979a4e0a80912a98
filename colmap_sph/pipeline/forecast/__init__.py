"""What a run will take: estimates of its stages, and the time left while they go on."""
