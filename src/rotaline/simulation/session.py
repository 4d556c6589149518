"""Rendering a plan into a session folder, with the truth in a file beside it."""

import csv
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rotaline.errors import OutputError
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.plan import CapturePlan, SessionPlan, Shot, demo_plan, demo_rig, small_plan
from rotaline.simulation.render import render_frame
from rotaline.simulation.rig import Rig, build_rig
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

__all__ = ["build_rig", "demo_plan", "demo_rig", "session_toml", "small_plan", "truth", "truth_path", "write_session"]

JPEG_QUALITY = 97


def truth_path(session: Path) -> Path:
    """Where the truth of a rendered session stands: beside it, never inside."""
    return session.with_name(session.name + ".truth.json")


def _target_fields(target: Target | SteppedCylinder) -> dict[str, Any]:
    if isinstance(target, SteppedCylinder):
        return {
            "kind": "stepped-cylinder",
            "diameters": [target.diameter_small, target.diameter_large],
            "heights": [target.height_small, target.height_large],
        }
    if isinstance(target, Checkerboard):
        return {"kind": "checkerboard", "inner_corners": list(target.inner_corners), "pitch": target.pitch}
    if isinstance(target, DotGrid):
        fields = {"kind": "dots", "dots": list(target.dots), "pitch": target.pitch}
        return fields if target.diameter is None else fields | {"diameter": target.diameter}
    return {
        "kind": "charuco",
        "squares": list(target.squares),
        "pitch": target.pitch,
        "marker": target.marker,
        "dictionary": target.dictionary,
    }


def _lines(fields: Mapping[str, Any]) -> list[str]:
    # strings, numbers and lists of numbers are written alike in JSON and TOML
    return [f"{key} = {json.dumps(value)}" for key, value in fields.items()]


def session_toml(plan: SessionPlan) -> str:
    """The text of ``session.toml``."""
    lines = ["# lengths in mm, angles in deg", "version = 1", ""]
    for name, target in plan.targets.items():
        if any(capture.target == name for capture in plan.captures):
            lines += [f"[targets.{name}]", *_lines(_target_fields(target)), ""]
    for capture in plan.captures:
        fields = {"folder": capture.folder, "role": capture.role}
        fields |= {} if capture.target is None else {"target": capture.target}
        lines += ["[[captures]]", *_lines(fields), ""]
    for measurement in plan.measurements:
        lines += ["[[measurements]]", *_lines({"capture": measurement.capture, "feature": measurement.feature})]
        if measurement.reference:
            lines += ["[measurements.reference]", *_lines(measurement.reference)]
        lines.append("")
    return "\n".join(lines)


def truth(rig: Rig, plan: SessionPlan) -> dict[str, Any]:
    """True values, with the names and frames of ``calibration.json``; what stood on the table in each capture."""
    camera, axis, plane = rig.camera, rig.rotation_axis_camera, rig.laser_plane_camera
    parts = {
        capture.folder: [
            {
                "shape": type(placed.shape).__name__,
                "sizes": placed.shape.sizes(),
                "table_from_part": placed.frame_from_part.as_matrix().tolist(),
            }
            for placed in capture.shots[0].on_table
        ]
        for capture in plan.captures
        if capture.shots and capture.shots[0].on_table
    }
    return {
        "camera": {
            "image_size": list(camera.image_size),
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
            "distortion": {name: getattr(camera, name) for name in ("k1", "k2", "p1", "p2")},
        },
        "laser_plane_camera": {"normal": plane.normal.tolist(), "offset": plane.offset},
        "rotation_axis_camera": {"point": axis.point.tolist(), "direction": axis.direction.tolist()},
        "turn_sense": rig.turn_sense,
        "camera_from_base": rig.camera_from_base.as_matrix().tolist(),
        "parts": parts,
        "seed": plan.seed,
    }


def _render_shot(rig: Rig, shot: Shot, seed: tuple[int, ...]) -> np.ndarray:
    base_from_table = rig.base_from_table(0.0 if shot.angle_deg is None else shot.angle_deg)
    parts = [*shot.held, *(part.moved(base_from_table) for part in shot.on_table)]
    return render_frame(
        rig,
        parts,
        laser_on=shot.laser,
        ambient_e_per_ms=shot.ambient_e_per_ms,
        exposure_ms=shot.exposure_ms,
        seed=seed,
    )


def _write_image(path: Path, image: np.ndarray) -> None:
    if path.suffix == ".jpg" and image.dtype != np.uint8:
        raise ValueError("JPEG holds 8 bit only; take another image format for a 16 bit sensor.")
    stored = image if image.ndim == 2 else image[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, stored, options)
    path.write_bytes(data.tobytes())


def _write_frames_csv(path: Path, capture: CapturePlan, names: list[str]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["image", "angle_deg", "laser", "pose"])
        for name, shot in zip(names, capture.shots, strict=True):
            angle = "" if shot.angle_deg is None else f"{shot.angle_deg:.6f}"
            writer.writerow([name, angle, "on" if shot.laser else "off", shot.pose])


def _write_into(folder: Path, rig: Rig, plan: SessionPlan, progress: Callable[[], None] | None) -> None:
    (folder / "session.toml").write_text(session_toml(plan), encoding="utf-8")
    jobs = []
    for c, capture in enumerate(plan.captures):
        (folder / capture.folder).mkdir()
        names = [f"{i:04d}.{plan.image_format}" for i in range(len(capture.shots))]
        _write_frames_csv(folder / capture.folder / "frames.csv", capture, names)
        jobs += [
            (folder / capture.folder / name, shot, (plan.seed, c, i))
            for i, (name, shot) in enumerate(zip(names, capture.shots, strict=True))
        ]

    def work(path: Path, shot: Shot, seed: tuple[int, ...]) -> None:
        _write_image(path, _render_shot(rig, shot, seed))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            futures = [pool.submit(work, *job) for job in jobs]
            for future in as_completed(futures):
                future.result()
                if progress is not None:
                    progress()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def write_session(path: Path, rig: Rig, plan: SessionPlan, progress: Callable[[], None] | None = None) -> None:
    """Render a plan into a session folder; the truth goes into :func:`truth_path` beside it.

    Everything is written under a temporary name first: an interrupted call leaves nothing behind.

    Parameters
    ----------
    path : Path   the session folder; must not exist yet
    rig : Rig
    plan : SessionPlan
    progress : called after each of the plan's ``n_frames`` frames

    Raises
    ------
    OutputError
        If the folder exists already, or it cannot be written.
    """
    if path.exists():
        raise OutputError(f"{path}: exists already. Remove it or choose another folder for the rendered session.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent, ignore_cleanup_errors=True) as name:
            session, truth_file = Path(name) / "session", Path(name) / "truth.json"
            session.mkdir()
            _write_into(session, rig, plan, progress)
            truth_file.write_text(json.dumps(truth(rig, plan), indent=1) + "\n", encoding="utf-8")
            shutil.move(truth_file, truth_path(path))
            session.rename(path)
    except OSError as error:
        raise OutputError(
            f"{path}: the session cannot be written ({error.strerror or error}). "
            "Free some space, change the permissions, or choose another place."
        ) from error
