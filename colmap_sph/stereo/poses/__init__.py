"""Matched pairs → how good the poses are, and what better ones need."""
