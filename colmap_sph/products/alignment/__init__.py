"""What a user knows of places on the map → the similarity that takes the model there."""
