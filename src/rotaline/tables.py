"""Tables of the TOML files that people write: each field is a key of the file, with a description for messages and documentation."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class Table(BaseModel):
    """A table of the file: unknown keys are mistakes, text is no number."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def key(default: Any, description: str) -> Any:
    """A key of the file; ``...`` as default: it must be given."""
    return Field(default, description=description)
