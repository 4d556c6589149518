"""One estimate of camera, target poses, laser plane, rotation axis and mounts from all observations of a session."""
