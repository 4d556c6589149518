"""Draw the pictures of the README from the results of a run: ``python docs/make_pictures.py demo-session-results``."""

import sys
from pathlib import Path

from rotaline.io.records import read_record
from rotaline.io.report.figures import features, frames, joint, scan
from rotaline.io.report.style import save_png
from rotaline.pipeline.run import REPORT_RECORD

OUT = Path(__file__).parent / "pictures"


def main(results: Path) -> None:
    """Write the pictures into docs/pictures/."""
    OUT.mkdir(exist_ok=True)
    contents = read_record(results / "stages" / REPORT_RECORD)
    save_png(joint.unrolled(contents.joint.mounts[-1]), OUT / "artefact-unrolled.png", dpi=90)
    bust = next(s for s in contents.surfaces if s.folder == "bust")
    save_png(scan.mesh_views(bust.vertices_table, bust.triangles), OUT / "bust-surface.png", dpi=90)
    stripe = next(o for o in contents.overlays if o.stage == "artifact")
    save_png(frames.overlay(stripe), OUT / "stripe.png", dpi=90)
    fitted = next(f for f in contents.fitted_points if f.capture == "rod")
    entry = next(e for e in contents.measurements if e.capture == "rod")
    save_png(features.fit(entry.measurement, fitted), OUT / "rod-residuals.png", dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
