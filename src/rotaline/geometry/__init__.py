"""Geometry: primitives, transforms, intersections, fitting with covariance, robust estimation. Knows no camera."""
