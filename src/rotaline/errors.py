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


class OutputError(RotalineError):
    """Results cannot be written: no space, no permission."""
