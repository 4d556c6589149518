"""Where the table truly stands: the errors of an encoder and of a spindle.

The read-out says ``a``; the table has turned by ``t = a + noise + E sin(a + phase)``, times the sense of rotation. Its axis is
moved by the run-out and tilted by the wobble:

``base_from_table = shift(x = R cos(a + phase) + noise, y = noise) * tilt_y(W cos(a + phase)) * turn_z(sense * t)``

What of this a part on the table can tell
-----------------------------------------
Points are put together as if the table were ideal. A displacement that turns with the table is the same as another place of the
part on it, a displacement that is always the same is the same as another place of the axis: neither changes the measured
shape. A run-out along a fixed direction is half of each kind of circle,

``R cos(a) x = R/2 (turning with the table) + R/2 (turning against it)``,

so half of ``run_out_um`` is taken for an offset of the part, and only the other half spoils its shape: it comes out as a
displacement that turns twice against the table in a turn. The same holds for the wobble: half of it is taken for a tilt of the part.
A constant error of the angle is taken for another orientation of the part; that is why the encoder has none here. Noise and
the once-per-turn error of the angle are seen in full.
"""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.rig import Mechanics


def true_angle_deg(mechanics: Mechanics, angle_read_deg: float, rng: np.random.Generator) -> float:
    """How far the table has turned when the read-out says ``angle_read_deg``, in the sense of the read-out."""
    phase = np.radians(angle_read_deg + mechanics.angle_eccentricity_phase_deg)
    noise_deg = mechanics.angle_noise_deg * rng.standard_normal()
    return float(angle_read_deg + noise_deg + mechanics.angle_eccentricity_deg * np.sin(phase))


def base_from_table(
    turn_sense: int, mechanics: Mechanics, angle_read_deg: float, rng: np.random.Generator
) -> RigidTransform:
    """The table's true pose when the read-out says ``angle_read_deg``.

    Parameters
    ----------
    turn_sense : +1 if the read-out is right-handed about base z, else -1
    mechanics : Mechanics   all zero: the pose is ``Rig.base_from_table``
    angle_read_deg : float
    rng : one generator a frame; always three numbers are drawn, so switching one error off leaves the others as they were

    Returns
    -------
    RigidTransform   ``base_from_table``, mm
    """
    angle_rad = np.radians(true_angle_deg(mechanics, angle_read_deg, rng))
    shift_um = mechanics.run_out_noise_um * rng.standard_normal(2)
    shift_um[0] += mechanics.run_out_um * np.cos(np.radians(angle_read_deg + mechanics.run_out_phase_deg))
    wobble_urad = mechanics.wobble_urad * np.cos(np.radians(angle_read_deg + mechanics.wobble_phase_deg))
    turn = Rotation.from_rotvec([0.0, 0.0, turn_sense * angle_rad])
    tilt = Rotation.from_rotvec([0.0, wobble_urad * 1e-6, 0.0])
    return RigidTransform.from_components([*(shift_um * 1e-3), 0.0], tilt * turn)
