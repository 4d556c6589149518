"""Scans at the level of observations: the stripes that an ideal extractor would return for parts on the table, without images.

Geometry and noise are apart: :func:`trace_scan` finds the true centres once, :meth:`IdealScan.observed` adds another
realisation of the noise in milliseconds. For error budgets, and for tests of what comes after the extraction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import lfilter
from scipy.spatial.transform import RigidTransform

from rotaline.simulation.ideal.stripe_trace import trace_stripe
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.mechanics import base_from_table
from rotaline.simulation.rig import Rig
from rotaline.vision.stripe.model import StripePoints


@dataclass(frozen=True, eq=False)
class IdealScan:
    """The true stripe centres of all frames of a scan, one frame after another.

    Attributes
    ----------
    angles_deg : (f,)   what the turntable's read-out said
    frame : (n,)   index of the frame of each point
    points_table : (n, 3)   where the point truly is on the parts, in the frame of the table that carries them, mm
    uv : (n, 2)   centre, px
    normal : (n, 2)   unit normal of the stripe
    width_px : (n,)   standard deviation of the stripe's profile
    intensity_dn : (n,)   height of the profile, grey values of an 8 bit image
    saturated : (n,)   the profile's core is clipped
    segment : (n,)   piece of smooth surface, numbered from 0 in each frame
    spacing_px : distance of neighbours of a segment
    image_size : width, height, px
    """

    angles_deg: Float[np.ndarray, " f"]
    frame: Int[np.ndarray, " n"]
    points_table: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    intensity_dn: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]
    segment: Int[np.ndarray, " n"]
    spacing_px: float
    image_size: tuple[int, int]

    @property
    def angles_rad(self) -> Float[np.ndarray, " f"]:
        """``angles_deg`` in rad."""
        return np.radians(self.angles_deg)

    def observed(
        self,
        sigma_px: float,
        seed: int | Sequence[int],
        *,
        correlated_px: float = 0.0,
        correlation_px: float = 10.0,
        outlier_fraction: float = 0.0,
        outlier_px: float = 10.0,
        stated_px: float | None = None,
    ) -> tuple[StripePoints, ...]:
        """What an extractor would return: the stripe of each frame with noise along its normal.

        Parameters
        ----------
        sigma_px : standard deviation of independent noise
        seed : int or several   the same seed gives the same noise; each error has its own random numbers, so one can be
            varied while the others stay
        correlated_px : standard deviation of noise that neighbours share
        correlation_px : length along a segment over which it falls to 1/e
        outlier_fraction : probability that a point is elsewhere
        outlier_px : outliers are displaced evenly between minus and plus this
        stated_px : the uncertainty that the extractor states; None: the standard deviation of the noise

        Returns
        -------
        StripePoints of each frame, empty where nothing is seen; points that the noise moves out of the image are left out
        """
        for name, value in (("sigma_px", sigma_px), ("correlated_px", correlated_px), ("outlier_px", outlier_px)):
            if value < 0:
                raise ValueError(f"{name} must not be negative, it is {value}.")
        if correlation_px <= 0:
            raise ValueError(f"correlation_px must be above 0, not {correlation_px}.")
        if not 0 <= outlier_fraction <= 1:
            raise ValueError(f"outlier_fraction must be 0 to 1, not {outlier_fraction}.")
        noise, slow, stray = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
        n = len(self.uv)
        shift_px = sigma_px * noise.standard_normal(n)
        if correlated_px > 0:
            shift_px += correlated_px * self._correlated_noise(correlation_px, slow)
        if outlier_fraction > 0:
            out = stray.random(n) < outlier_fraction
            shift_px[out] += stray.uniform(-outlier_px, outlier_px, int(out.sum()))
        uv = self.uv + shift_px[:, None] * self.normal
        inside = np.all((uv >= 0) & (uv <= np.array(self.image_size) - 1), axis=1)
        stated = float(np.hypot(sigma_px, correlated_px)) if stated_px is None else stated_px
        starts = np.searchsorted(self.frame, np.arange(len(self.angles_deg) + 1))
        return tuple(
            StripePoints(
                uv[a:b],
                self.normal[a:b],
                self.width_px[a:b],
                self.intensity_dn[a:b],
                np.full(b - a, stated),
                self.saturated[a:b],
                self.segment[a:b],
            ).select(inside[a:b])
            for a, b in pairwise(starts)
        )

    def _correlated_noise(self, correlation_px: float, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Noise of variance 1 that falls off exponentially along each segment: a first-order recursion."""
        fresh = rng.standard_normal(len(self.uv))
        memory = np.exp(-self.spacing_px / correlation_px)
        new = np.flatnonzero((np.diff(self.segment) != 0) | (np.diff(self.frame) != 0)) + 1
        pieces = np.split(fresh, new)
        gain = np.sqrt(1.0 - memory**2)
        return np.concatenate(
            [
                lfilter([gain], [1.0, -memory], piece, zi=(1.0 - gain) * piece[:1])[0] if len(piece) else piece
                for piece in pieces
            ]
        )


def trace_scan(
    rig: Rig,
    parts_table: Sequence[Placed],
    angles_deg: Sequence[float],
    *,
    seed: int = 0,
    spacing_px: float = 1.0,
    edge_px: float = 3.0,
    min_intensity_dn: float = 2.0,
) -> IdealScan:
    """The true stripe centres of a scan, with the errors of the rig's turntable.

    Parameters
    ----------
    rig : Rig   its ``mechanics`` decide where the table truly stands in each frame
    parts_table : what the table carries, the table's own top with it if it is to be seen
    angles_deg : what the read-out says in each frame
    seed : of the noise of the turntable
    spacing_px, edge_px, min_intensity_dn : see :func:`rotaline.simulation.ideal.stripe_trace.trace_stripe`
    """
    poses = [
        base_from_table(rig.turn_sense, rig.mechanics, float(angle_deg), np.random.default_rng([seed, index]))
        for index, angle_deg in enumerate(angles_deg)
    ]
    return trace_frames(
        rig,
        [[part.moved(pose) for part in parts_table] for pose in poses],
        poses,
        angles_deg,
        spacing_px=spacing_px,
        edge_px=edge_px,
        min_intensity_dn=min_intensity_dn,
    )


def trace_frames(
    rig: Rig,
    parts_base: Sequence[Sequence[Placed]],
    table_poses: Sequence[RigidTransform],
    angles_deg: Sequence[float],
    *,
    spacing_px: float = 1.0,
    edge_px: float = 3.0,
    min_intensity_dn: float = 2.0,
) -> IdealScan:
    """The true stripe centres of frames that need not be a scan.

    Parameters
    ----------
    rig : Rig   the errors of its turntable play no part
    parts_base : what stands where in each frame, in the base frame
    table_poses : ``base_from_table`` in each frame, as it truly is
    angles_deg : what the read-out says in each frame; NaN where the table plays no part
    spacing_px, edge_px, min_intensity_dn : see :func:`rotaline.simulation.ideal.stripe_trace.trace_stripe`
    """
    if not len(angles_deg):
        raise ValueError("A scan needs one angle or more; there is none.")
    traces, points_table = [], []
    for parts, pose in zip(parts_base, table_poses, strict=True):
        trace = trace_stripe(rig, parts, spacing_px=spacing_px, edge_px=edge_px, min_intensity_dn=min_intensity_dn)
        traces.append(trace)
        points_table.append(pose.inv().apply(trace.points_base))
    uv, normal, width_px, intensity_dn, saturated, segment = (
        np.concatenate([getattr(trace, name) for trace in traces])
        for name in ("uv", "normal", "width_px", "intensity_dn", "saturated", "segment")
    )
    return IdealScan(
        np.array(angles_deg, dtype=float),
        np.repeat(np.arange(len(traces)), [len(trace.uv) for trace in traces]),
        np.concatenate(points_table),
        uv,
        normal,
        width_px,
        intensity_dn,
        saturated,
        segment,
        spacing_px,
        rig.camera.image_size,
    )
