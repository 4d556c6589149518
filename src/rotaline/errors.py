"""What can go wrong, by what the user can do about it.

A message says what was found, what was expected and what to do next. A whole call that failed raises; one element that
failed is a NaN row or a mask. Only the command line turns errors into text and exit codes.
"""


class RotalineError(Exception):
    """Base of all errors that a user can act on."""


class SessionError(RotalineError):
    """A session folder, or another file, is not what it should be: file, line, field, found, expected."""


class RigError(RotalineError):
    """A rig, or a part, that cannot be simulated: which quantity, what was found, what was expected."""


class DetectionError(RotalineError):
    """Nothing usable in the image."""


class CalibrationError(RotalineError):
    """The observations do not determine the parameters; the message says which, and what to add."""


class GeometryError(RotalineError):
    """The configuration is degenerate."""


class MeasurementError(RotalineError):
    """The feature was not found in the cloud."""


class WorkError(RotalineError):
    """Work was not done where it should be: worker processes or the cluster are gone, or run another program."""


class DeviceError(RotalineError):
    """A device does not do what it should: which device, what was found, unit, limit, what to do next."""


class DeviceConnectionError(DeviceError):
    """The device, or the library that drives it, is not there, is held by another program, or went away."""


class DeviceTimeoutError(DeviceError):
    """The device did not answer, or did not finish, in the time that it was given."""


class DeviceStateError(DeviceError):
    """The device cannot do this as it stands: in alarm, not homed, still moving, or not able to at all."""


class DeviceLimitError(DeviceError):
    """A value is outside of what the device allows; nothing was moved or set."""


class LostFrameError(DeviceError):
    """A frame did not arrive, or not whole. The camera works on: take it again."""


class OutputError(RotalineError):
    """Results cannot be written: no space, no permission."""
