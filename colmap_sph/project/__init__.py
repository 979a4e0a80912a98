"""What the user brought and what lies on disk: the only room that knows COLMAP's library and its files."""
