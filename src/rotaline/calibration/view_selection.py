"""Which views and points carry a camera calibration: homographies to start from, and what does not fit the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.homography import fit_homography, map_homography
from rotaline.calibration.model import TargetView
from rotaline.calibration.reprojection import BoardObservation, reprojection_residuals
from rotaline.errors import GeometryError
from rotaline.vision.camera import CameraModel

MIN_VIEWS = 3
RAYLEIGH_MEDIAN = 1.17741
"""Median length of a residual in units of the standard deviation of its coordinates."""


@dataclass(frozen=True, eq=False)
class ViewState:
    """A view on its way through the estimate; ``reason`` is not empty once it is out."""

    observation: BoardObservation
    homography: Float[np.ndarray, "3 3"] | None
    pose: RigidTransform | None = None
    reason: str = ""


def start_views(views: Sequence[TargetView]) -> list[ViewState]:
    """Homography of every view; views without one are out."""
    state = []
    for view in views:
        detection = view.detection
        n = len(detection.uv)
        observation = BoardObservation(detection.points_board, detection.uv, np.ones(n))
        if n < 4:
            state.append(ViewState(observation, None, None, f"only {n} points found, at least 4 are needed"))
            continue
        try:
            homography = fit_homography(detection.points_board[:, :2], detection.uv)
            for _ in range(3):
                errors = np.linalg.norm(
                    detection.uv - map_homography(homography, detection.points_board[:, :2]), axis=1
                )
                keep = errors <= 4 * np.median(errors) + 1e-9
                if keep.sum() < 4:
                    break
                homography = fit_homography(detection.points_board[keep, :2], detection.uv[keep])
            state.append(ViewState(observation, homography))
        except GeometryError as error:
            state.append(ViewState(observation, None, None, str(error)))
    return state


def judge_views(
    state: Sequence[ViewState], camera: CameraModel, outlier_sigma: float, view_outlier_ratio: float
) -> list[ViewState]:
    """Mark points and views that do not fit the others, by robust scales; never more than half of the views."""
    lengths = {
        k: np.linalg.norm(reprojection_residuals(camera, s.pose, s.observation), axis=1)
        for k, s in enumerate(state)
        if not s.reason and s.pose is not None
    }
    scales = {k: float(np.median(r)) / RAYLEIGH_MEDIAN for k, r in lengths.items()}
    typical = max(float(np.median(list(scales.values()))), 1e-9)
    judged = list(state)
    candidates: list[tuple[float, int, str]] = []
    for k, r in lengths.items():
        keep = r < outlier_sigma * max(typical, scales[k])
        rms = float(np.sqrt(np.mean(r[keep] ** 2))) / np.sqrt(2) if keep.any() else np.inf
        if scales[k] > view_outlier_ratio * typical or rms > view_outlier_ratio * typical:
            candidates.append(
                (
                    scales[k],
                    k,
                    f"its error is {scales[k] / typical:.1f} times that of the other views (median {np.median(r):.3g} px)",
                )
            )
        elif keep.sum() < max(4, 0.7 * len(keep)):
            candidates.append((scales[k], k, f"{int((~keep).sum())} of {len(keep)} points do not fit"))
        else:
            judged[k] = replace(state[k], observation=state[k].observation.with_weights(keep.astype(float)))
    # never more than the worse half, and never below the number that is needed
    room = min(len(lengths) // 2, len(lengths) - MIN_VIEWS)
    for _, k, reason in sorted(candidates, reverse=True)[: max(room, 0)]:
        judged[k] = replace(state[k], reason=reason)
    return judged


def same_selection(a: Sequence[ViewState], b: Sequence[ViewState]) -> bool:
    """True if the same views and points are used in both."""
    return all(
        x.reason == y.reason and np.array_equal(x.observation.weights, y.observation.weights)
        for x, y in zip(a, b, strict=True)
    )
