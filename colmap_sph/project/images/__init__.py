"""Image files as COLMAP sees them: checked, read at full depth, undistorted, without a tag that turns them."""
