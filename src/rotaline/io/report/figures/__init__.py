"""The pictures of the report. Each function takes results and returns a matplotlib ``Figure``.

They can also be used alone: ``style.save_png(camera.coverage(calibration), Path("coverage.png"))``.
"""
