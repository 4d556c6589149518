"""Settings against the limits of a camera, before anything is set."""

from rotaline.errors import DeviceLimitError
from rotaline.hardware.camera import CameraInfo, CameraSettings


def check_settings(info: CameraInfo, settings: CameraSettings, smallest: tuple[int, int] = (1, 1)) -> None:
    """Raise if the camera cannot do this.

    Parameters
    ----------
    smallest : width and height of the smallest region, px

    Raises
    ------
    DeviceLimitError
        The device, the value, its unit and the limits.
    """
    low, high = info.exposure_limits_us
    if not low <= settings.exposure_us <= high:
        raise DeviceLimitError(
            f"{info.device}: an exposure of {settings.exposure_us:g} us is outside {low:g} to {high:g} us. State one between them."
        )
    if settings.gain is not None:
        _check_gain(info, settings.gain)
    region = settings.region
    if region is not None:
        width, height = info.sensor_size
        if (
            region.x < 0
            or region.y < 0
            or region.width < smallest[0]
            or region.height < smallest[1]
            or region.x + region.width > width
            or region.y + region.height > height
        ):
            raise DeviceLimitError(
                f"{info.device}: the region of {region.width} x {region.height} px at ({region.x}, {region.y}) px is not inside "
                f"the sensor of {width} x {height} px, or smaller than {smallest[0]} x {smallest[1]} px. State one that fits."
            )
    if settings.trigger not in info.triggers:
        raise DeviceLimitError(
            f"{info.device}: trigger '{settings.trigger}' is not one of {', '.join(info.triggers)}, which this camera has."
        )


def _check_gain(info: CameraInfo, gain: float) -> None:
    if info.gain_limits is None:
        raise DeviceLimitError(
            f"{info.device}: gain {gain:g} {info.gain_unit}: the gain of this camera cannot be set. Leave it out."
        )
    low, high = info.gain_limits
    if not low <= gain <= high:
        unit = info.gain_unit
        raise DeviceLimitError(
            f"{info.device}: gain {gain:g} {unit} is outside {low:g} to {high:g} {unit}. State one between them."
        )
