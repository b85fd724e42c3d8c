"""From radiance to the image of a camera."""
