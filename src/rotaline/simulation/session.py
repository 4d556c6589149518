"""Rendering a plan into a session folder, with the truth in a file beside it."""

import csv
import json
import os
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from rotaline.errors import OutputError
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.simulation.imaging.render import focus_distance_mm, render_frame
from rotaline.simulation.imaging.speckle import contrast, grain_px
from rotaline.simulation.parts.material import Material
from rotaline.simulation.plan import CapturePlan, SessionPlan, Shot
from rotaline.simulation.rig import Rig
from rotaline.simulation.truth import fingerprint, image_name, true_poses, truth, truth_path
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

JPEG_QUALITY = 97

_FINGERPRINT_FILE = "fingerprint"
_UNFINISHED = ".part"


def _artifact_fields(artifact: Artifact) -> dict[str, Any]:
    tolerance = {"tolerance": artifact.tolerance} if artifact.tolerance else {}
    if isinstance(artifact, SteppedCylinder):
        return {
            "kind": "stepped-cylinder",
            "diameters": [artifact.diameter_small, artifact.diameter_large],
            "heights": [artifact.height_small, artifact.height_large],
            **tolerance,
        }
    if isinstance(artifact, KnownCylinder):
        height = {} if artifact.height is None else {"height": artifact.height}
        return {"kind": "cylinder", "diameter": artifact.diameter, **height, **tolerance}
    return {"kind": "sphere", "diameter": artifact.diameter, **tolerance}


def _target_fields(target: Target | Artifact) -> dict[str, Any]:
    if isinstance(target, SteppedCylinder | KnownCylinder | KnownSphere):
        return _artifact_fields(target)
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


def _optics_fields(rig: Rig) -> dict[str, float]:
    """What the session states of lens, sensor and laser; the contrast is that of a rough surface."""
    grain = grain_px(rig.laser, rig.optics, rig.camera.fx, focus_distance_mm(rig))
    return {
        "f_number": rig.optics.f_number,
        "pixel_pitch_um": rig.optics.pixel_pitch_um,
        "wavelength_nm": rig.laser.wavelength_nm,
        "speckle_contrast": round(contrast(rig.laser, grain, Material().roughness_um), 4),
    }


def session_toml(plan: SessionPlan, rig: Rig) -> str:
    """The text of ``session.toml``."""
    lines = ["# lengths in mm, angles in deg", "version = 1", "", "[optics]", *_lines(_optics_fields(rig)), ""]
    for name, target in plan.targets.items():
        if any(capture.target == name for capture in plan.captures):
            lines += [f"[targets.{name}]", *_lines(_target_fields(target)), ""]
    for capture in plan.captures:
        fields = {"folder": capture.folder, "role": capture.role}
        fields |= {} if capture.target is None else {"target": capture.target}
        lines += ["[[captures]]", *_lines(fields), ""]
    for measurement in plan.measurements:
        fields = {"capture": measurement.capture, "feature": measurement.feature}
        lines += ["[[measurements]]", *_lines(fields | ({"check": True} if measurement.check else {}))]
        if measurement.reference:
            lines += ["[measurements.reference]", *_lines(measurement.reference)]
        lines.append("")
    return "\n".join(lines)


def _write_image(path: Path, image: np.ndarray) -> None:
    """Write an image whole or not at all."""
    if path.suffix == ".jpg" and image.dtype != np.uint8:
        raise ValueError("JPEG holds 8 bit only; take another image format for a 16 bit sensor.")
    stored = image if image.ndim == 2 else image[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, stored, options)
    temporary = path.with_name(path.name + _UNFINISHED)
    temporary.write_bytes(data.tobytes())
    temporary.replace(path)


def _write_frames_csv(path: Path, capture: CapturePlan, names: list[str]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["image", "angle_deg", "laser", "pose"])
        for name, shot in zip(names, capture.shots, strict=True):
            angle = "" if shot.angle_deg is None else f"{shot.angle_deg:.6f}"
            writer.writerow([name, angle, "on" if shot.laser else "off", shot.pose])


@dataclass(frozen=True)
class Unfinished:
    """A session whose rendering was interrupted: how many frames are there, and whether they are of the same rig and plan."""

    n_frames: int
    same: bool


def partial_path(session: Path) -> Path:
    """Where a session grows until it is complete: beside its place."""
    return session.with_name(session.name + ".partial")


def unfinished(path: Path, rig: Rig, plan: SessionPlan) -> Unfinished | None:
    """What an interrupted :func:`write_session` has left; None: nothing.

    Raises
    ------
    OutputError
        If the session exists already, or something else stands in the place of the partial one.
    """
    if path.exists():
        raise OutputError(f"{path}: exists already. Remove it or choose another folder for the rendered session.")
    partial = partial_path(path)
    if not partial.exists():
        return None
    try:
        same = (partial / _FINGERPRINT_FILE).read_text(encoding="utf-8") == fingerprint(rig, plan)
    except OSError as error:
        raise OutputError(f"{partial}: this is no unfinished session. Remove it, or choose another folder.") from error
    return Unfinished(sum(1 for _ in (partial / "session").rglob(f"*.{plan.image_format}")), same)


def write_session(
    path: Path,
    rig: Rig,
    plan: SessionPlan,
    progress: Callable[[], None] | None = None,
    *,
    notes: Mapping[str, Any] | None = None,
    threads: int | None = None,
) -> None:
    """Render a plan into a session folder; the truth goes into :func:`rotaline.simulation.truth.truth_path` beside it.

    Until it is complete, the session stands in :func:`partial_path`. After an interruption the same call goes on with the first
    frame that is missing; with another rig or plan it starts anew.

    Parameters
    ----------
    path : Path   the session folder; must not exist yet
    rig : Rig
    plan : SessionPlan
    progress : called after each of the plan's ``n_frames`` frames, and at once for those that are there already
    notes : further entries of the truth, such as the text of the rig file
    threads : frames that are rendered side by side; None: one for each processor. The images do not depend on it.

    Raises
    ------
    OutputError
        If the folder exists already, or it cannot be written.
    """
    partial = partial_path(path)
    try:
        left = unfinished(path, rig, plan)
        if left is not None and not left.same:
            shutil.rmtree(partial)
        session = partial / "session"
        session.mkdir(parents=True, exist_ok=True)
        (partial / _FINGERPRINT_FILE).write_text(fingerprint(rig, plan), encoding="utf-8")
        _write_into(session, rig, plan, progress, threads or os.cpu_count() or 1)
        truth_file = partial / "truth.json"
        truth_file.write_text(json.dumps(truth(rig, plan) | dict(notes or {}), indent=1) + "\n", encoding="utf-8")
        truth_file.replace(truth_path(path))
        session.rename(path)
        shutil.rmtree(partial)
    except OSError as error:
        raise OutputError(
            f"{path}: the session cannot be written ({error.strerror or error}). What was finished is kept; free some space, "
            "or change the permissions, and start the same command again, or choose another place."
        ) from error


def _write_into(
    folder: Path,
    rig: Rig,
    plan: SessionPlan,
    progress: Callable[[], None] | None,
    threads: int,
) -> None:
    (folder / "session.toml").write_text(session_toml(plan, rig), encoding="utf-8")
    jobs, poses = [], true_poses(rig, plan)
    for c, capture in enumerate(plan.captures):
        (folder / capture.folder).mkdir(exist_ok=True)
        for left_over in (folder / capture.folder).glob(f"*{_UNFINISHED}"):
            left_over.unlink()
        names = [image_name(i, plan.image_format) for i in range(len(capture.shots))]
        _write_frames_csv(folder / capture.folder / "frames.csv", capture, names)
        for i, (name, shot, pose) in enumerate(zip(names, capture.shots, poses[capture.folder], strict=True)):
            jobs.append((folder / capture.folder / name, shot, pose, (plan.seed, c, i)))

    def work(path: Path, shot: Shot, pose: RigidTransform, seed: tuple[int, ...]) -> None:
        if not path.exists():
            _write_image(path, _render_shot(rig, shot, pose, seed))

    with ThreadPoolExecutor(threads) as pool:
        try:
            futures = [pool.submit(work, *job) for job in jobs]
            for future in as_completed(futures):
                future.result()
                if progress is not None:
                    progress()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _render_shot(rig: Rig, shot: Shot, base_from_table: RigidTransform, seed: tuple[int, ...]) -> np.ndarray:
    return render_frame(
        rig,
        [*shot.held, *(part.moved(base_from_table) for part in shot.on_table)],
        laser_on=shot.laser,
        ambient_e_per_ms=shot.ambient_e_per_ms,
        exposure_ms=shot.exposure_ms,
        seed=seed,
    )
