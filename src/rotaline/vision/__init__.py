"""Vision: images, the camera model, target detection, stripe extraction. Everything here is in pixels."""
