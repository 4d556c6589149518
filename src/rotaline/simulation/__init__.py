"""Simulation: renders sessions and synthetic observations whose truth is known. Shares no estimator with the rest."""
