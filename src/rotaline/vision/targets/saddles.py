"""Candidates for checkerboard corners: saddle points of the grey values that look the same after half a turn."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from rotaline.vision.targets.lattice import Candidates

_RING = 24  # samples on the ring around a candidate


def find_saddles(
    grey: Float32[np.ndarray, "h w"], sigma_px: float = 1.2, ring_radius_px: float = 4.0, max_candidates: int = 6000
) -> Candidates:
    """Find corners where two bright and two dark sectors meet.

    Saddles are maxima of minus the determinant of the Hessian of the smoothed image. On a ring around each, the grey values
    must be nearly even (the same after half a turn) and change sign four times.

    Parameters
    ----------
    grey : (h, w)   in 0 ... 255
    sigma_px : float   smoothing
    ring_radius_px : float   radius of the ring; the squares must be larger

    Returns
    -------
    Candidates   the strongest first; phase = direction of the bright sectors
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    ixx = cv2.sepFilter2D(smooth, cv2.CV_32F, np.array([1.0, -2.0, 1.0]), np.array([1.0]))
    iyy = cv2.sepFilter2D(smooth, cv2.CV_32F, np.array([1.0]), np.array([1.0, -2.0, 1.0]))
    ixy = cv2.sepFilter2D(smooth, cv2.CV_32F, np.array([-0.5, 0.0, 0.5]), np.array([-0.5, 0.0, 0.5]))
    strength = ixy * ixy - ixx * iyy
    peak = cv2.dilate(strength, np.ones((5, 5), np.uint8)) <= strength
    peak &= strength > 0.05
    rim = int(np.ceil(ring_radius_px)) + 2
    peak[:rim] = peak[-rim:] = False
    peak[:, :rim] = peak[:, -rim:] = False
    v, u = np.nonzero(peak)
    order = np.argsort(-strength[v, u], kind="stable")[:max_candidates]
    v, u = v[order], u[order]
    if not len(u):
        return Candidates(np.zeros((0, 2)), np.zeros(0), np.zeros(0))

    xx, yy, xy = ixx[v, u], iyy[v, u], ixy[v, u]
    gx = (smooth[v, u + 1] - smooth[v, u - 1]) / 2
    gy = (smooth[v + 1, u] - smooth[v - 1, u]) / 2
    determinant = xx * yy - xy * xy
    shift = np.stack([(xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant], axis=1)
    uv = np.stack([u, v], axis=1) + np.clip(shift, -1.0, 1.0)

    angles = np.arange(_RING) * (2 * np.pi / _RING)
    ring_u = (uv[:, :1] + ring_radius_px * np.cos(angles)).astype(np.float32)
    ring_v = (uv[:, 1:] + ring_radius_px * np.sin(angles)).astype(np.float32)
    ring = cv2.remap(smooth, ring_u, ring_v, cv2.INTER_LINEAR)
    spectrum = np.fft.rfft(ring, axis=1)[:, 1:] / _RING
    power = np.abs(spectrum) ** 2
    total = power.sum(axis=1) + 1e-12
    even = power[:, 1::2].sum(axis=1) / total
    second = power[:, 1] / total
    middle = (ring.max(axis=1) + ring.min(axis=1))[:, None] / 2
    above = ring > middle
    changes = np.count_nonzero(above != np.roll(above, 1, axis=1), axis=1)
    good = (even > 0.75) & (second > 0.35) & (changes == 4) & (np.abs(spectrum[:, 1]) > 0.7)
    phase: Float[np.ndarray, " n"] = np.mod(-np.angle(spectrum[:, 1]) / 2, np.pi)
    return Candidates(
        np.ascontiguousarray(uv[good], dtype=float), phase[good].astype(float), np.full(int(good.sum()), np.nan)
    )
