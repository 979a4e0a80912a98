"""COLMAP's own commands, spelled as COLMAP spells them."""
