"""Rotaline: measure parts with a camera, a laser line and a turntable."""

__version__ = "0.1.0"
