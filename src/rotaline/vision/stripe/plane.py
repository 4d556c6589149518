"""The image in which the centres are measured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8, UInt16


def clip_limit(top: int) -> int:
    """Least value that counts as clipped, of a sensor with this greatest value."""
    return top - 2 if top == 255 else int(0.98 * top)


@dataclass(frozen=True, eq=False)
class Plane:
    """One channel of a frame.

    Attributes
    ----------
    value : (h, w)   grey values, background subtracted
    source : (h, w)   the same as the camera gave them; the same array where nothing was subtracted
    lit : bool   a background was subtracted that shows a scene in the light of lamps
    """

    value: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]
    source: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
    lit: bool = False

    @property
    def top(self) -> int:
        """Greatest value of the sensor's range."""
        return int(256**self.source.itemsize - 1)

    @property
    def limit(self) -> int:
        """Least value that counts as clipped."""
        return clip_limit(self.top)

    @property
    def unit(self) -> float:
        """One grey value of an 8 bit image, in the image's grey values (1 or 257)."""
        return self.top / 255.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.value.shape[1], self.value.shape[0]

    def around(self, uv: Float[np.ndarray, "n 2"], margin_px: float) -> tuple["Plane", Int[np.ndarray, "2"]]:
        """The part that holds all points and a margin about them, and its first pixel (u, v)."""
        width, height = self.size
        u0, v0 = np.maximum(np.floor(uv.min(axis=0) - margin_px).astype(int), 0)
        u1, v1 = np.minimum(np.ceil(uv.max(axis=0) + margin_px).astype(int) + 1, [width, height])
        return Plane(self.value[v0:v1, u0:u1], self.source[v0:v1, u0:u1], self.lit), np.array([u0, v0])
