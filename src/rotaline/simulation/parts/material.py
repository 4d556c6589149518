"""How a surface sends light back."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """A diffuse surface with an optional specular lobe.

    Attributes
    ----------
    albedo : fraction of the light that comes back diffusely, 0 to 1
    gloss : weight of the specular lobe, 0 (matt) to 1
    gloss_width_deg : standard deviation of the angle about the mirror direction in which the lobe goes, 0 to 90, not 0
    roughness_um : standard deviation of the heights within a grain of speckle; only lasers of a broad line notice it
    """

    albedo: float = 0.8
    gloss: float = 0.0
    gloss_width_deg: float = 8.0
    roughness_um: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what no surface does.

        Raises
        ------
        ValueError
            If a value is outside its range.
        """
        for name in ("albedo", "gloss"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} of a material must be 0 to 1, not {value}.")
        if not 0.0 < self.gloss_width_deg <= 90.0:
            raise ValueError(f"gloss_width_deg must be above 0 and at most 90, not {self.gloss_width_deg}.")
        if not 0.0 <= self.roughness_um < 1e4:
            raise ValueError(f"roughness_um must be 0 to 10000, not {self.roughness_um}.")


MATT = Material()
BRIGHT = Material(0.9)
