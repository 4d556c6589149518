"""How the stripe is found and measured."""

from dataclasses import dataclass, field
from typing import Literal

Method = Literal["gray-gravity", "improved-gray-gravity", "steger", "profile-fit"]
Channel = Literal["auto", "red", "green", "blue"]
Colour = Literal["auto", "red", "green", "blue", "none"]


@dataclass(frozen=True)
class StripeOptions:
    """How the stripe is found and measured."""

    method: Method = field(default="improved-gray-gravity", metadata={"help": "how the centre is found in a profile"})
    channel: Channel = field(
        default="auto",
        metadata={"help": "channel of a colour image to measure in; auto takes the one that shows the stripe best"},
    )
    laser_colour: Colour = field(
        default="auto", metadata={"help": "colour by which the stripe is found in a colour image; none: by brightness"}
    )
    threshold: float = field(
        default=6.0, metadata={"help": "least height of the stripe, as a multiple of the image's noise"}
    )
    min_contrast: float = field(
        default=2.0, metadata={"help": "least height of the stripe, grey values of an 8 bit image"}
    )
    average_px: int = field(
        default=0,
        metadata={
            "help": "average each centre with its neighbours within so many px along the stripe (parabola); 0: none, "
            "which leaves the centres nearly independent"
        },
    )
    keep: Literal["all", "brightest"] = field(
        default="all",
        metadata={
            "help": "all: every line; brightest: of several lines in a row (column) of the image only the strongest"
        },
    )
    min_length_px: float = field(
        default=10.0,
        metadata={"help": "shorter pieces of stripe are dropped, px; pieces close together and alike count as one"},
    )
