"""The article's experiments, rendered, processed, and set beside its figures."""
