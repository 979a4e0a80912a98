"""Depth maps → surfaces seen from one side: heights, and who sees them."""
