"""Calibration: from detections and stripes to the system's parameters, with the figures that judge them."""
