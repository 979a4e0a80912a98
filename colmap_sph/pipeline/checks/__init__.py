"""Does what is asked for make sense, and what was found? Where not, the run is refused."""
