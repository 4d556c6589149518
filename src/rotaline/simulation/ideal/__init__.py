"""What ideal detectors would return, without an image or with a single stripe or target in it; for tests and error budgets."""
