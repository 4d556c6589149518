"""What stands before the camera: shapes that a ray can hit, exact or of triangles, and plates with a printed target."""
