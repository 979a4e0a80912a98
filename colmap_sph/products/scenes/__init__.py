"""A workspace → folders as programs for radiance fields, splats and learned stereo expect them."""
