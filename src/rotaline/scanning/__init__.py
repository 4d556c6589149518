"""Scanning: stripe centres to points in the table frame, points to a surface."""
