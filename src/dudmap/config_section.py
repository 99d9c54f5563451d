"""Base class of the sections of the configuration."""

from pydantic import BaseModel, ConfigDict


class ConfigSection(BaseModel):
    """Immutable section that rejects unknown keys; docstrings of its fields describe them."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)
