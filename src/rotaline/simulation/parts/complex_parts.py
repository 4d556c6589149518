"""Parts with small details, of the kinds that figure 16 of the article shows, generated: nothing is downloaded.

A pipe connector with a thread, a casting with flash at its parting line, a bust with a small ball on its nose and a rubber duck
with small bumps. Each knows where its details are, so that a measured surface can be judged there.

References
----------
Li et al., Sensors 2026, 26(13), 4275, section 6.3 and figure 16.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from rotaline.simulation.parts.detailed_body import ComplexPart, Detail
from rotaline.simulation.parts.sculptures import bust, rubber_model
from rotaline.simulation.parts.technical_parts import casting_with_flash, thread_connector

__all__ = [
    "GENERATORS",
    "ComplexPart",
    "Detail",
    "bust",
    "casting_with_flash",
    "complex_parts",
    "rubber_model",
    "thread_connector",
]

GENERATORS: Mapping[str, Callable[[], ComplexPart]] = MappingProxyType(
    {
        "bust": bust,
        "casting_with_flash": casting_with_flash,
        "rubber_model": rubber_model,
        "thread_connector": thread_connector,
    }
)
"""What makes each part, by name; a part takes a second to make."""


def complex_parts() -> dict[str, ComplexPart]:
    """All four parts, by name, in the order of figure 16; made anew in each call."""
    return {name: generate() for name, generate in GENERATORS.items()}
