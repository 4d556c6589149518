"""From light to grey values: photons, electrons, conversion, and the colour filter of the sensor.

Grey values (DN) are counted as those of an 8 bit image: full scale is 255, at ``full_well_e / gain`` electrons over black.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from rotaline.simulation.rig import Sensor

_POISSON_BELOW_E = 100.0
"""Above this a Gaussian is taken: the skewness is below 0.1, and the noise of reading and rounding covers it."""

_CHUNK_PX = 1 << 17

_CHANNEL = np.array([[0, 1], [1, 2]])
"""Which of red, green and blue the pixels of a 2 x 2 cell see: RGGB."""


def _electrons(mean_e: Float[np.ndarray, " n"], rng: np.random.Generator) -> Float[np.ndarray, " n"]:
    """A draw of the number of photo-electrons."""
    mean = np.maximum(mean_e, 0.0)
    few = mean < _POISSON_BELOW_E
    drawn = mean + np.sqrt(mean) * rng.standard_normal(len(mean), dtype=np.float32)
    drawn[few] = rng.poisson(mean[few])
    return drawn


def _digital(signal_e: Float[np.ndarray, "h w"], sensor: Sensor, rng: np.random.Generator) -> UInt16[np.ndarray, "h w"]:
    """Whole numbers of 0 to ``2^bit_depth - 1``; in chunks, which bounds the memory."""
    levels = 2**sensor.bit_depth - 1
    flat = signal_e.ravel()
    digital = np.empty(len(flat), np.uint16)
    for i in range(0, len(flat), _CHUNK_PX):
        electrons = _electrons(flat[i : i + _CHUNK_PX].astype(float), rng)
        if sensor.gain < 1.0:  # else the converter is at its end before the well is full
            electrons = np.minimum(electrons, sensor.full_well_e)
        electrons += sensor.read_noise_e * rng.standard_normal(len(electrons), dtype=np.float32)
        dn = electrons / sensor.electrons_per_dn + sensor.black_level_dn
        digital[i : i + _CHUNK_PX] = np.clip(np.rint(dn * (levels / 255.0)), 0, levels)
    return digital.reshape(signal_e.shape)


def expose(
    signal_e: Float[np.ndarray, "h w"] | Float[np.ndarray, "h w 3"], sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """The image that a sensor makes of so much light.

    Shot noise (Poisson's distribution), the full well, read noise, gain, black level, rounding to the levels of the bit depth
    and clipping, in this order. A colour sensor has a Bayer pattern (RGGB): each pixel sees one channel, and the other two are
    interpolated from its neighbours after rounding.

    Parameters
    ----------
    signal_e : (h, w), or (h, w, 3) red, green, blue for a colour sensor   expected photo-electrons
    sensor : Sensor
    rng : each draw from it makes another image

    Returns
    -------
    (h, w) or (h, w, 3); uint8, or uint16 with full scale 65535 for 12 bit (4096 levels) and 16 bit
    """
    if sensor.colour != (signal_e.ndim == 3):
        raise ValueError(
            f"A {'colour' if sensor.colour else 'grey'} sensor does not fit light of shape {signal_e.shape}."
        )
    if sensor.colour:
        mosaic = np.empty(signal_e.shape[:2], signal_e.dtype)
        for (row, column), channel in np.ndenumerate(_CHANNEL):
            mosaic[row::2, column::2] = signal_e[row::2, column::2, channel]
        signal_e = mosaic
    digital = _digital(signal_e, sensor, rng)
    stored = digital.astype(np.uint8) if sensor.bit_depth == 8 else digital
    image = np.asarray(cv2.cvtColor(stored, cv2.COLOR_BayerRGGB2RGB)) if sensor.colour else stored
    if sensor.bit_depth == 12:
        return np.asarray(np.rint(image * (65535.0 / 4095.0)).astype(np.uint16))
    return image
