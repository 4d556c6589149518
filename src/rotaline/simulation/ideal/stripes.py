"""Images of a single laser stripe whose centre is known exactly."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from scipy.special import erf


@dataclass(frozen=True)
class StripeScene:
    """A stripe with a Gaussian profile, as pixels see it, on a flat background.

    The stripe passes the image's centre, ``offset_px`` beside it. ``angle_deg`` is the direction in which it runs, from
    the u axis towards the v axis; the normal is 90 deg further on. Pixels integrate the light over their area; then come
    speckle, noise, rounding and clipping, in this order.

    Attributes
    ----------
    image_size : (width, height), px
    curve : ``line``; ``step``: the far half is moved by ``step_px`` along the normal, abruptly; ``arc``: a circle of
        ``radius_px`` that touches the line at the image's centre
    sigma_px : standard deviation of the profile
    peak, background : grey values; the peak counts from the background
    one_sided : further background beyond ``edge_px`` along the normal from the stripe's centre, grey values
    edge_blur_px : standard deviation of the blur of that edge
    noise : standard deviation, grey values
    speckle_contrast : standard deviation of the stripe's light over its mean
    speckle_grain_px : full width at half maximum of the speckle's autocorrelation
    ceiling : grey value at which the sensor clips
    bits : 8 or 16
    """

    image_size: tuple[int, int] = (160, 160)
    curve: Literal["line", "step", "arc"] = "line"
    angle_deg: float = 0.0
    offset_px: float = 0.0
    sigma_px: float = 2.0
    peak: float = 200.0
    background: float = 10.0
    noise: float = 2.0
    step_px: float = 6.0
    radius_px: float = 100.0
    one_sided: float = 0.0
    edge_px: float = 0.0
    edge_blur_px: float = 1.0
    speckle_contrast: float = 0.0
    speckle_grain_px: float = 1.5
    ceiling: float = 255.0
    bits: Literal[8, 16] = 8

    @property
    def direction(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the stripe at the image's centre."""
        angle = np.deg2rad(self.angle_deg)
        return np.array([np.cos(angle), np.sin(angle)])

    @property
    def normal(self) -> Float[np.ndarray, "2"]:
        """Unit normal of the stripe at the image's centre."""
        return np.array([-self.direction[1], self.direction[0]])

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """The point of the stripe nearest to the image's centre."""
        centre = (np.array(self.image_size) - 1.0) / 2.0
        return centre + self.offset_px * self.normal

    def distance(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Signed distance of points from the true centre of the stripe, along its true normal, px."""
        relative = uv - self.middle
        along, across = relative @ self.direction, relative @ self.normal
        if self.curve == "arc":
            return self.radius_px - np.hypot(along, across - self.radius_px)
        if self.curve == "step":
            return across - np.where(along < 0, 0.0, self.step_px)
        return across

    def error(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Signed distance of found centres from the true one along its true normal, px.

        Within 1 px of a step the pixels see both of its sides; there the nearer side counts.
        """
        distance = self.distance(uv)
        if self.curve != "step":
            return distance
        other = distance + np.where(self.along(uv) < 0, -self.step_px, self.step_px)
        near = (np.abs(self.along(uv)) < 1.0) & (np.abs(other) < np.abs(distance))
        return np.where(near, other, distance)

    def curve_points(self, spacing_px: float) -> Float[np.ndarray, "n 2"]:
        """Points on the true centre, in order; they reach beyond the image."""
        reach = float(np.hypot(*self.image_size))
        t = np.arange(-reach, reach, spacing_px)
        if self.curve == "arc":
            angle = t[np.abs(t) < 0.5 * np.pi * self.radius_px] / self.radius_px
            t, across = self.radius_px * np.sin(angle), self.radius_px * (1.0 - np.cos(angle))
        else:
            across = np.where(t < 0, 0.0, self.step_px if self.curve == "step" else 0.0)
        return np.asarray(self.middle + t[:, None] * self.direction + across[:, None] * self.normal)

    def along(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Position of points along the line (the tangent of an arc) from the image's centre, px."""
        return (uv - self.middle) @ self.direction


def render_stripe(scene: StripeScene, rng: np.random.Generator) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """One image of the scene."""
    width, height = scene.image_size
    v, u = np.mgrid[0:height, 0:width].astype(float)
    light, ground = np.zeros((height, width)), np.zeros((height, width))
    node = 0.5 * np.sqrt(0.6)
    for dv, weight_v in ((-node, 5 / 18), (0.0, 8 / 18), (node, 5 / 18)):  # Gauss-Legendre over the pixel's area
        for du, weight_u in ((-node, 5 / 18), (0.0, 8 / 18), (node, 5 / 18)):
            distance = scene.distance(np.stack([u + du, v + dv], axis=-1))
            light += weight_u * weight_v * np.exp(-0.5 * (distance / scene.sigma_px) ** 2)
            if scene.one_sided:
                edge = (distance - scene.edge_px) / (np.sqrt(2.0) * scene.edge_blur_px)
                ground += weight_u * weight_v * 0.5 * (1.0 + erf(edge))
    if scene.speckle_contrast:
        light *= np.maximum(1.0 + scene.speckle_contrast * _speckle(light.shape, scene.speckle_grain_px, rng), 0.0)
    image = scene.background + scene.peak * light + scene.one_sided * ground
    image += rng.normal(0.0, scene.noise, image.shape)
    image = np.clip(image, 0.0, scene.ceiling)
    if scene.bits == 16:
        return np.rint(image * 257.0).astype(np.uint16)
    return np.rint(image).astype(np.uint8)


def _speckle(shape: tuple[int, ...], grain_px: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth noise of mean 0 and variance 1, with a Gaussian autocorrelation of full width ``grain_px`` at half maximum."""
    v, u = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    correlation = 0.5 ** (4.0 * (v[:, None] ** 2 + u**2) / grain_px**2)
    spectrum = np.maximum(np.fft.rfft2(correlation).real, 0.0)
    return np.fft.irfft2(np.fft.rfft2(rng.normal(0.0, 1.0, shape)) * np.sqrt(spectrum), shape)
