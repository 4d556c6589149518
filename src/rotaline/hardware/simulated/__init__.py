"""The simulated rig: one world that the simulated camera, turntable and laser share."""
