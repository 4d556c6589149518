"""Taking a session with a live rig: what is to be taken, by whom it is placed, and that nothing of it is lost."""
