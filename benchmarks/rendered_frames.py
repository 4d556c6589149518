"""Rendered frames of a laser stripe with its true centres, and how far points are from these. The frames are kept in a folder for temporary files, since rendering takes long."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import rotaline.simulation
from rotaline.simulation.ideal.stripe_trace import trace_stripe
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_frame
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import Rig, build_rig
from rotaline.simulation.small_session import BALL, GROOVE, STEPPED_CYLINDER

PARTS = (SteppedRod(STEPPED_CYLINDER), BALL, GROOVE)
SPACING_PX = 0.25
NEAR_PX, BESIDE_PX = 3.0, 0.5


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """An image, and points of the true stripe with its unit normals there; both are empty for frames without truth."""

    image: np.ndarray
    uv: np.ndarray
    normal: np.ndarray


def rendered_frames(n: int, image_size: tuple[int, int] = (1280, 960)) -> list[RenderedFrame]:
    """Frames of three parts, each at another angle, with noise and speckle, grey, 8 bit."""
    folder = Path(tempfile.gettempdir()) / f"rotaline-benchmarks-{_digest()}"
    folder.mkdir(exist_ok=True)
    rig = build_rig(image_size)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda i: _stored(folder, rig, i), range(n)))


def _digest() -> str:
    """Of the renderer's sources: what an older one made is not used."""
    digest = hashlib.sha256()
    for path in sorted(Path(rotaline.simulation.__path__[0]).rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _stored(folder: Path, rig: Rig, number: int) -> RenderedFrame:
    width, height = rig.camera.image_size
    path = folder / f"{width}x{height}-{number}.npz"
    if not path.is_file():
        frame = _render(rig, number)
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as stream:
            np.savez(stream, image=frame.image, uv=frame.uv, normal=frame.normal)
        part.replace(path)
    with np.load(path) as stored:
        return RenderedFrame(stored["image"], stored["uv"], stored["normal"])


def _render(rig: Rig, number: int) -> RenderedFrame:
    part, angle_deg = PARTS[number % len(PARTS)], 7.5 * number
    scene = [table_disc(rig), Placed(part, rig.base_from_table(angle_deg) * mount(3.0, 2.0))]
    ambient = rig.light.ambient_e_per_ms * rig.light.ambient_on_fraction
    image = render_frame(
        rig, scene, laser_on=True, ambient_e_per_ms=ambient, exposure_ms=rig.light.exposure_on_ms, seed=number
    )
    trace = trace_stripe(rig, scene, spacing_px=SPACING_PX)
    return RenderedFrame(image, trace.uv, trace.normal)


def judge(way: Callable[[np.ndarray], np.ndarray], frames: list[RenderedFrame]) -> tuple[float, float, float, float]:
    """RMS distance from the true stripe along its normal (px), points a frame, part of the stripe that was found, part of the points that are far away.

    Points within 3 px of the true centres are judged; those of edges, which have no true centre, are not. A true centre is found if a point is
    within 1 px; a point more than 10 px from the stripe is a stray.
    """
    errors, n_points, found, strays = [np.empty(0)], [], [], []
    for frame in frames:
        uv = way(frame.image)
        n_points.append(len(uv))
        if not len(frame.uv) or not len(uv):
            continue
        distance, nearest = cKDTree(frame.uv).query(uv)
        away = uv - frame.uv[nearest]
        across = (away * frame.normal[nearest]).sum(axis=1)
        along = np.sqrt(np.maximum((away**2).sum(axis=1) - across**2, 0.0))
        errors.append(across[(np.abs(across) < NEAR_PX) & (along < BESIDE_PX)])
        strays.append(np.mean(distance > 10.0))
        found.append(np.mean(cKDTree(uv).query(frame.uv)[0] < 1.0))
    every = np.concatenate(errors)
    if not len(every):
        return float("nan"), float(np.mean(n_points)), float("nan"), float("nan")
    return float(np.sqrt(np.mean(every**2))), float(np.mean(n_points)), float(np.mean(found)), float(np.mean(strays))
