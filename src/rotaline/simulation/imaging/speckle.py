"""Speckle: the grain of laser light that a rough surface sends into a lens.

Contrast, grain and distribution follow Goodman [1]_:

- Fully developed, polarised speckle of one wavelength has the contrast 1 and a negative exponential distribution. A surface
  that depolarises gives two independent patterns, their sum has the contrast ``1 / sqrt(2)``.
- Wavelengths apart see different patterns on a rough surface. With a Gaussian spectrum (standard deviation ``s_k`` in wave
  number) and Gaussian heights (standard deviation ``s_h``), lit and seen about the normal, the correlation of the patterns of
  two wave numbers is ``exp(-4 s_h^2 dk^2)`` and its mean over the spectrum gives ``C^2 = 1 / sqrt(1 + 16 s_h^2 s_k^2)``.
- A grain on the sensor has the area ``A = 4 / pi * (wavelength * f_number * (1 + magnification))^2``, that of the diffraction disc,
  whatever the lens blurs beyond. A pixel that holds several grains averages them.
- The sum of independent patterns has, closely, a gamma distribution with the shape ``1 / C^2``.

References
----------
.. [1] Goodman, Speckle Phenomena in Optics, 2nd ed., SPIE 2020, chapters 3 (sums of patterns), 4 (grain; integration), 6 (wavelength)
"""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv, ndtr

from rotaline.simulation.rig import Laser, Optics

_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
_REACH_PX = 16
_TABLE_REACH = 6.0


def grain_px(laser: Laser, optics: Optics, focal_px: float, distance_mm: float) -> float:
    """Side of the square that has the area of a grain on the sensor, px.

    Parameters
    ----------
    laser : Laser
    optics : Optics
    focal_px : focal length
    distance_mm : from the lens to the surface that is in focus
    """
    focal_mm = focal_px * optics.pixel_pitch_um * 1e-3
    magnification = focal_mm / max(distance_mm - focal_mm, focal_mm)
    disc_um = laser.wavelength_nm * 1e-3 * optics.f_number * (1.0 + magnification)
    return float(disc_um * np.sqrt(4.0 / np.pi) / optics.pixel_pitch_um)


def _correlation(grain: float) -> Float[np.ndarray, " k"]:
    """Covariance of the light of pixels 0, 1, 2 .. apart along a row, of a pattern with variance 1 before the pixels.

    The grain's correlation, taken for a Gaussian of the same area, seen through two pixels, whose overlap is a triangle.
    """
    if grain < 1e-3:
        return np.concatenate([[grain], np.zeros(_REACH_PX)])
    step = min(grain, 1.0) / 40.0
    triangle_x = (np.arange(round(2.0 / step)) + 0.5) * step - 1.0
    triangle = (1.0 - np.abs(triangle_x)) * step
    apart = np.arange(_REACH_PX + 1)[:, None] + triangle_x
    return np.asarray(np.exp(-np.pi * (apart / grain) ** 2) @ triangle)


def contrast(laser: Laser, grain: float, roughness_um: float) -> float:
    """Standard deviation of the light of a pixel over its mean, from physics or as the laser states it.

    Parameters
    ----------
    laser : Laser
    grain : side of a grain, px; see :func:`grain_px`
    roughness_um : standard deviation of the heights of the surface
    """
    if laser.speckle_contrast is not None:
        return laser.speckle_contrast
    spectrum_per_um = 2.0 * np.pi * laser.linewidth_nm * 1e3 / laser.wavelength_nm**2 / _FWHM
    colours = 1.0 / np.sqrt(1.0 + 16.0 * (roughness_um * spectrum_per_um) ** 2)
    grains = _correlation(grain)[0] ** 2
    return float(np.sqrt(0.5 * colours * grains))


@lru_cache(maxsize=16)
def _kernel(grain: float) -> Float[np.ndarray, " k"]:
    """Filter along a row, and along a column, that gives white noise the correlation of the pixels' light."""
    covariance = _correlation(grain)
    around = np.concatenate([covariance, covariance[:0:-1]]) / covariance[0]
    spectrum = np.maximum(np.fft.fft(around).real, 0.0)
    kernel = np.fft.fftshift(np.fft.ifft(np.sqrt(spectrum)).real)
    return np.asarray(kernel / np.sqrt(np.sum(kernel**2)))


@lru_cache(maxsize=16)
def _quantiles(contrast_of_light: float) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Standard normal values, and the light (mean 1) of a gamma distribution that is exceeded as often."""
    normal = np.linspace(-_TABLE_REACH, _TABLE_REACH, 2401)
    shape = 1.0 / contrast_of_light**2
    return normal, gammaincinv(shape, ndtr(normal)) / shape


def speckle_pattern(shape: tuple[int, int], grain: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Normal noise of mean 0 and variance 1 with the correlation of speckle that pixels have integrated.

    Parameters
    ----------
    shape : h, w
    grain : side of a grain, px
    rng : numpy.random.Generator
    """
    margin = _REACH_PX
    noise = rng.standard_normal((shape[0] + 2 * margin, shape[1] + 2 * margin), dtype=np.float32)
    kernel = _kernel(grain)
    smooth = cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel)[margin:-margin, margin:-margin]
    return np.asarray(smooth, dtype=float)


def speckle_factor(pattern: Float[np.ndarray, " n"], contrast_of_light: float) -> Float[np.ndarray, " n"]:
    """Factor of the laser's light: a gamma distribution with mean 1 and this contrast, never negative.

    Parameters
    ----------
    pattern : (n,)   values of :func:`speckle_pattern`
    contrast_of_light : 0 (no speckle) to 1
    """
    if contrast_of_light < 1e-6:
        return np.ones(len(pattern))
    return np.interp(pattern, *_quantiles(contrast_of_light))
