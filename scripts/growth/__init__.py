"""What `bench_growth.py` is made of: blocks of many small images, finished workspaces of them, reads of maps."""
