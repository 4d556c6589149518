"""What was seen in a session: target points and stripes, by the part that they play. Images are no longer needed from here on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import TargetView
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import Artifact
from rotaline.vision.stripe.model import StripePoints


@dataclass(frozen=True, eq=False)
class MountObservation:
    """The stripes on one mount of an artefact.

    Attributes
    ----------
    name : folder of the capture
    artifact : SteppedCylinder, KnownCylinder or KnownSphere   as stated
    frame_names : (f,)
    angles_rad : (f,)   of the turntable, as read
    stripes : (f,)   empty where nothing was seen
    u_angles_rad : (f,)   standard uncertainties of the angles, 0 where none is stated; None: of none
    """

    name: str
    artifact: Artifact
    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    stripes: tuple[StripePoints, ...]
    u_angles_rad: Float[np.ndarray, " f"] | None = None


@dataclass(frozen=True, eq=False)
class SessionObservations:
    """All observations that calibrate a rig. Names are ``folder/image``; a frame may play several parts.

    Attributes
    ----------
    image_size : width, height, px
    camera_views : targets in role camera
    preferred_folders : folders whose views count where captures disagree about the camera: those that see the stripes
    plate_views : targets with the stripe on them, role laser-plane
    table_views : the target on the turntable, with angles, role axis, in the order of the session
    mounts : artefacts on the turntable
    """

    image_size: tuple[int, int]
    camera_views: tuple[TargetView, ...]
    preferred_folders: frozenset[str]
    plate_views: tuple[StripeView, ...]
    table_views: tuple[TargetView, ...]
    mounts: tuple[MountObservation, ...]

    @property
    def roles(self) -> frozenset[str]:
        """The roles of captures of which something was seen."""
        parts = {
            "camera": self.camera_views,
            "laser-plane": self.plate_views,
            "axis": self.table_views,
            "artifact": self.mounts,
        }
        return frozenset(role for role, part in parts.items() if part)
