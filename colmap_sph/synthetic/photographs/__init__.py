"""What a camera and the world do to pictures: from the rays through a bent, moving camera to JPEG."""
