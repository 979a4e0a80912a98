"""What a level of matching searches: where its pixels are expected to match, and how far from there."""
