"""Stages that only wide images have."""
