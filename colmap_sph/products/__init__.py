"""What is handed over: a workspace's cloud, maps and cameras in the formats and coordinates of other programs."""
