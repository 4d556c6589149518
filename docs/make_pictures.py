"""Draw the pictures of the documentation.

``python docs/make_pictures.py demo-session-results`` draws those of the README from the results of a run;
``python docs/make_pictures.py acquire`` those of the screens of `rotaline acquire`, by taking a short session with the simulated rig of the
preset "demo". Where a person would stand, a script holds the plates; the screens are those that a person sees.
"""

import io
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.console import Console, RenderableType

OUT = Path(__file__).parent / "pictures"


def main(results: Path) -> None:
    """Write the pictures of the README into docs/pictures/."""
    from rotaline.io.records import read_record
    from rotaline.io.report.figures import features, frames, joint, scan
    from rotaline.io.report.style import save_png
    from rotaline.pipeline.run import REPORT_RECORD

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


def save_screen(screen: RenderableType, name: str) -> None:
    """Write a screen as it stands in a terminal of 100 columns into docs/pictures/."""
    console = Console(
        file=io.StringIO(), record=True, width=100, height=33, force_terminal=True, color_system="truecolor"
    )
    console.print(screen)
    console.save_svg(str(OUT / f"{name}.svg"), title="rotaline acquire")


def screens() -> None:
    """Take a short session with the simulated rig, and keep what is shown."""
    from rotaline.cli.acquisition_screen import AcquisitionScreen, placing, summary
    from rotaline.cli.person import TerminalPerson
    from rotaline.hardware.clock import VirtualClock
    from rotaline.hardware.connections import Connections
    from rotaline.hardware.rig import open_rig
    from rotaline.hardware.simulated.world import SimulatedWorld
    from rotaline.io.device_file import SIMULATED_RIG, parse_device_file
    from rotaline.io.plan_file import parse_plan, plan_text
    from rotaline.io.rig_file import read_preset
    from rotaline.pipeline.acquire.acquire import acquire
    from rotaline.pipeline.acquire.guidance import lit_preview
    from rotaline.pipeline.acquire.taking import FrameTaken
    from rotaline.pipeline.acquire.tasks import n_frames

    class Kept(AcquisitionScreen):
        """A screen whose pictures are kept."""

        poses: list[RenderableType] = []  # noqa: RUF012
        bars: list[RenderableType] = []  # noqa: RUF012

        def watch(self, taken: FrameTaken) -> None:
            super().watch(taken)
            self.bars.append(self.picture())

        @contextmanager
        def showing(self) -> Iterator[Callable[[RenderableType], None]]:
            yield self.poses.append

    class NoKeys:
        def enter_pressed(self) -> bool:
            return False

    class Hands(TerminalPerson):
        """Holds the plates of the simulated rig."""

        def place(self, capture, n_done):
            world.set_up(capture.folder)

        def pose(self, capture, index, preview):
            looks = iter(range(100))

            def look():
                n = next(looks)
                clock.wait(0.7)
                world.hold(None if n == 0 else index)
                return preview()

            super().pose(capture, index, look)

        def aside(self, name):
            return world.aside(name)

    text = plan_text("article").replace("poses = 20", "poses = 8").replace("poses = 10", "poses = 5")
    wanted = parse_plan(text, "plan article")
    tables = wanted.tables
    kept = {"camera": 8, "laser": 5, "ball": 0}
    captures = [c for c in tables.captures if c.folder in kept]
    wanted = replace(wanted, tables=tables.model_copy(update={"captures": captures, "measurements": []}))
    file = parse_device_file(SIMULATED_RIG, "rig.toml", Path())
    demo = read_preset("demo")
    clock = VirtualClock()
    world = SimulatedWorld(demo.rig(), demo.plan(), clock)
    connections = Connections()
    connections.provide("world", world)
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    screen = Kept(console=console, clock_s=clock.now_s)
    with tempfile.TemporaryDirectory() as folder, open_rig(file.devices, clock, connections) as rig:
        out = Path(folder) / "my-session"
        person = Hands(wanted.tables, out, screen, lit_preview(rig), keys=lambda: _entered(NoKeys()))
        result = acquire(wanted, file.text, rig, out, person, screen, screen.watch)
        save_screen(summary(result, wanted.tables, clock.now_s()), "acquire-summary")
    for i, pose in enumerate(screen.poses):
        print(i, pose.index, pose.guide.role, pose.advice.level, pose.advice.text)
    for name, pose in (("acquire-pose", 13), ("acquire-not-found", 12), ("acquire-laser", -3)):
        save_screen(screen.poses[pose], name)
    save_screen(screen.bars[-30], "acquire-progress")
    stepped = next(c for c in tables.captures if c.folder == "stepped-1")
    save_screen(placing(stepped, 83, n_frames(stepped)), "acquire-place")


@contextmanager
def _entered(keys):
    yield keys


if __name__ == "__main__":
    if sys.argv[1:] == ["acquire"]:
        screens()
    else:
        main(Path(sys.argv[1]))
