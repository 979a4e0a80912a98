"""What is given, looked at before COLMAP's library sees it: files of models, names, where images are."""
