"""Options of the measurement stage."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class MeasureOptions:
    """How features are searched and fitted."""

    seed: int = field(default=0, metadata={"help": "Seed of the random search; the same seed gives the same result."})
    n_search: int = field(
        default=8000,
        metadata={"help": "Points to which a cloud is thinned for the search; the final fit uses all points."},
    )
    edge_margin_mm: float | None = field(
        default=None,
        metadata={
            "help": "Points nearer than this (mm) to an adjacent surface are left out; none: from the feature's size."
        },
    )
    trim: float = field(
        default=3.0,
        metadata={"help": "Points farther from the surface than this many standard deviations are left out."},
    )
    min_points: int = field(default=50, metadata={"help": "Fewest points that count as a surface."})
