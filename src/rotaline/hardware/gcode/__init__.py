"""Controllers of machines that take G-code over a serial port: GRBL, grblHAL, Marlin."""
