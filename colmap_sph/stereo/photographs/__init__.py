"""Photographs that were cut into several views: together these see the whole sphere around one centre."""
