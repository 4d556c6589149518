"""Files: the session folder, the calibration file, stage records, clouds and meshes, the report."""
