"""A rendered ball and rod under a wide line: too small as measured, right when the width of the line is known."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.line_width import SHARE_UNKNOWN
from rotaline.calibration.model import SystemCalibration
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions
from rotaline.pipeline.parts import measure_request
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_frame
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import BALL, ROD
from rotaline.vision.stripe.extract import extract_stripe

ANGLES_DEG = tuple(45.0 * i for i in range(8))
PIXEL_VARIANCE = 1.0 / 12.0


@pytest.mark.parametrize(
    ("feature", "part", "pose", "sigma_mm", "too_small_mm"),
    [("sphere", BALL, mount(3.1, -1.2), 0.15, 0.008), ("cylinder", ROD, mount(-2.4, 0.8), 0.3, 0.009)],
)
def test_the_width_of_the_line_takes_nothing_off_a_diameter(feature, part, pose, sigma_mm, too_small_mm):
    rig = build_rig((640, 480))
    rig = replace(rig, laser=replace(rig.laser, sigma_mm=sigma_mm, speckle_contrast=0.0))
    stripes = []
    for k, angle_deg in enumerate(ANGLES_DEG):
        parts = [Placed(part, rig.base_from_table(angle_deg) * pose), table_disc(rig)]
        image = render_frame(rig, parts, laser_on=True, ambient_e_per_ms=0.0, exposure_ms=5.0, seed=k)
        stripes.append(extract_stripe(image))
    blur_px = float(np.sqrt(rig.optics.blur_px**2 + PIXEL_VARIANCE))
    plane, axis = rig.laser_plane_camera, rig.rotation_axis_camera
    system = SystemCalibration(
        rig.camera, plane, axis, rig.turn_sense, True, line_sigma_mm=sigma_mm, stripe_blur_px=blur_px
    )
    cloud = scan_points(stripes, np.radians(ANGLES_DEG), system)
    request = MeasurementRequest(capture="scan", feature=feature, nominal={"diameter": part.diameter})
    found = measure_request(request, cloud, MeasureOptions(), system).measurement
    added = found.line_width_correction["diameter"]
    error = found.value["diameter"] - part.diameter
    assert error - added < -too_small_mm
    assert abs(error) < 2 * np.hypot(SHARE_UNKNOWN * added, found.u_scatter["diameter"])
