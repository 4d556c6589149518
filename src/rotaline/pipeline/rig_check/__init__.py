"""Testing a rig before it is used: camera, laser, turntable, and what lies between them."""
