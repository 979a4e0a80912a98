"""What `cross_compile.py` is made of: the targets, and Python's headers for them."""
