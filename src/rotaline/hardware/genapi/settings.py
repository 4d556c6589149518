"""What rig.toml may state about every camera that speaks GenICam, whichever library drives it."""

from typing import Literal

from rotaline.hardware.genapi.camera import Options
from rotaline.tables import Positive, Table, key


class GenapiSettings(Table):
    """Keys that all of them have."""

    pixel_format: str | None = key(None, "such as 'Mono8' or 'Mono12p'; none: as the camera has it")
    trigger_line: str = key("Line1", "input whose edge begins an exposure where the plan asks for it")
    exposure_us: Positive | None = key(None, "exposure of a camera that cannot be told one, us")
    stamp: Literal["exposure-start", "exposure-end"] = key("exposure-start", "what the camera's time stamps mark")
    features: dict[str, bool | int | float | str] = key(
        {}, "further features by their GenICam names, set in this order, such as {AcquisitionFrameRate = 20.0}"
    )

    def options(self) -> Options:
        """The same for :class:`rotaline.hardware.genapi.camera.GenicamCamera`."""
        return Options(
            exposure_us=self.exposure_us,
            trigger_line=self.trigger_line,
            pixel_format=self.pixel_format,
            stamp_at_end=self.stamp == "exposure-end",
            features=dict(self.features),
        )
