"""Metrology: features of known shape found in a cloud, their size, form error and residuals."""
