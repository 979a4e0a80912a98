"""A fused cloud, read piece by piece → LAS, LAZ and COPC files, and a thinned cloud with its tracks."""
