"""What speckle allows at best: the smallest scatter of a single laser point, from the optics and the geometry of the rig.

On a rough surface coherent light returns in grains, and the centre of the line moves with them. Dorsch, Häusler and Herrmann [1] give
the standard deviation of a centre whose line is as narrow as the lens resolves::

    delta_x = C lambda / (2 pi sin u_obs)         across the line, on the object
    delta_z = delta_x / sin theta                 in the sheet of light, in depth

``C`` is the contrast of the speckle, ``u_obs`` half the angle under which the object sees the aperture of the lens and ``theta`` the angle of
triangulation. Wider lines scatter more. Only less coherent light, a wider aperture or a larger angle lower the limit: not a better algorithm.

References
----------
.. [1] Dorsch, Häusler, Herrmann, Laser triangulation: fundamental uncertainty in distance measurement, Applied Optics 33 (1994) 1306-1314
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.vision.camera import CameraModel


@dataclass(frozen=True)
class LaserOptics:
    """What is known of lens, sensor and laser beyond the calibration.

    Attributes
    ----------
    f_number : focal length over the diameter of the aperture
    pixel_pitch_um : side of a pixel on the sensor
    wavelength_nm : of the laser
    speckle_contrast : standard deviation of the speckle over its mean, 0 to 1; 1 is fully developed speckle of polarised light
    """

    f_number: float
    pixel_pitch_um: float
    wavelength_nm: float
    speckle_contrast: float = 1.0


@dataclass(frozen=True)
class SpeckleLimit:
    """The smallest standard deviation of a single point: ``lateral_mm`` across the line, ``depth_mm`` in the sheet of light.

    For ``contrast``, the aperture ``sin_aperture`` and the angle of triangulation ``triangulation_rad`` at the point.
    """

    contrast: float
    sin_aperture: float
    triangulation_rad: float
    lateral_mm: float
    depth_mm: float


def speckle_limit(
    optics: LaserOptics, camera: CameraModel, laser_plane_camera: Plane, point_camera: Float[np.ndarray, "3"]
) -> SpeckleLimit:
    """The limit at a point, [1] above; the lens is a thin one that is focused there.

    Parameters
    ----------
    optics : LaserOptics
    camera : CameraModel
    laser_plane_camera : Plane   mm
    point_camera : (3,)   mm

    Raises
    ------
    GeometryError
        If the point is the projection centre.
    """
    distance = float(np.linalg.norm(point_camera))
    ray = unit(point_camera)
    image_distance = camera.fx * optics.pixel_pitch_um * 1e-3
    focal_length = image_distance * distance / (image_distance + distance)
    aperture_radius = focal_length / optics.f_number / 2.0
    sin_aperture = aperture_radius / float(np.hypot(aperture_radius, distance))
    sin_theta = abs(float(laser_plane_camera.normal @ ray))
    lateral = optics.speckle_contrast * optics.wavelength_nm * 1e-6 / (2.0 * np.pi * sin_aperture)
    depth = lateral / sin_theta if sin_theta > 0.0 else float("inf")
    return SpeckleLimit(optics.speckle_contrast, sin_aperture, float(np.arcsin(sin_theta)), lateral, depth)


def speckle_limit_at_axis(optics: LaserOptics, system: SystemCalibration) -> SpeckleLimit:
    """The limit where the laser plane passes the rotation axis, nearest to the optical axis."""
    return speckle_limit(
        optics, system.camera, system.laser_plane_camera, _nearest_to_view(system.rotation_axis_camera)
    )


def _nearest_to_view(axis: Line) -> Float[np.ndarray, "3"]:
    """The point of a line that is nearest to the optical axis, mm."""
    across = axis.direction[:2]
    along = float(across @ across)
    return axis.point if along < 1e-12 else axis.point - (axis.point[:2] @ across) / along * axis.direction
