"""What cameras have in common that describe themselves by GenICam: features by their standard names, frame ids, time stamps."""
