"""How fast frames are rendered, with noise and as PNG, on one thread and on two: ``.venv/bin/python benchmarks/renderer.py [WIDTHxHEIGHT]``."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does: frames are what is done side by side

import resource
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2

from rotaline.pipeline.summary import machine, versions
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_frame
from rotaline.simulation.parts.shapes import Shape, SteppedRod
from rotaline.simulation.plan import camera_capture, mount, table_disc
from rotaline.simulation.rig import Optics, Rig, Sensor, build_rig
from rotaline.simulation.small_session import BALL, CHECKERBOARD, GROOVE, STEPPED_CYLINDER

FRAMES = 4


def _scan(rig: Rig, shape: Shape) -> list[Placed]:
    return [table_disc(rig), Placed(shape, mount(3.0, 2.0))]


def _target(rig: Rig) -> list[Placed]:
    shot = camera_capture(rig, CHECKERBOARD, "checkerboard", 1, 1).shots[0]
    return [*shot.held, *shot.on_table]


def _png(rig: Rig, parts: list[Placed], laser_on: bool, seed: int) -> int:
    light = rig.light
    ambient = light.ambient_e_per_ms * (light.ambient_on_fraction if laser_on else 1.0)
    image = render_frame(rig, parts, laser_on=laser_on, ambient_e_per_ms=ambient, exposure_ms=10.0, seed=seed)
    return len(cv2.imencode(".png", image)[1])


def measure(size: tuple[int, int] = (1280, 960), frames: int = FRAMES) -> dict[str, tuple[float, ...]]:
    """Print one line a scene; seconds of CPU of each frame, on one thread."""
    rig, seconds = build_rig(size), {}
    deep = replace(rig, optics=Optics(focus_mm=290.0, f_number=2.8))
    cases = {
        "stripe, stepped cylinder": (rig, _scan(rig, SteppedRod(STEPPED_CYLINDER)), True),
        "stripe, ball": (rig, _scan(rig, BALL), True),
        "stripe, groove": (rig, _scan(rig, GROOVE), True),
        "stripe, defocus": (deep, _scan(deep, SteppedRod(STEPPED_CYLINDER)), True),
        "stripe, colour 12 bit": (
            replace(rig, sensor=Sensor(colour=True, bit_depth=12)),
            _scan(rig, SteppedRod(STEPPED_CYLINDER)),
            True,
        ),
        "checkerboard": (rig, _target(rig), False),
    }
    print(f"{size[0]} x {size[1]}, with noise and PNG")
    print(f"{'scene':26} {'s CPU a frame':>13} {'frames/s':>9} {'on two threads':>14}")
    for name, (some_rig, parts, laser_on) in cases.items():
        _png(some_rig, parts, laser_on, 0)  # the viewing rays are worked out once
        wall, each = time.perf_counter(), []
        for seed in range(frames):
            began = time.process_time()
            _png(some_rig, parts, laser_on, seed)
            each.append(time.process_time() - began)
        seconds[name] = tuple(each)
        cpu, wall = sum(each) / frames, (time.perf_counter() - wall) / frames
        start = time.perf_counter()
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda seed, case=(some_rig, parts, laser_on): _png(*case, seed), range(2 * frames)))
        both = (time.perf_counter() - start) / (2 * frames)
        print(f"{name:26} {cpu:13.3f} {1 / wall:9.2f} {1 / both:14.2f}")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    load = os.getloadavg()[0]
    print(f"largest memory {peak_mb:.0f} MB; load of the machine meanwhile {load:.1f}")
    return seconds


def main() -> None:
    """The table for the size on the command line, and the machine."""
    width, height = (int(n) for n in (sys.argv[1] if len(sys.argv) > 1 else "1280x960").split("x"))
    measure((width, height))
    print(", ".join([machine(), *(f"{name} {version}" for name, version in versions().items())]))


if __name__ == "__main__":
    main()
