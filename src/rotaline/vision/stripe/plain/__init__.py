"""The stripe stage as arrays of whole profiles (NumPy, OpenCV): what the compiled one is held against."""
