"""Base class of the sections of the configuration."""

from pydantic import BaseModel, ConfigDict


class ConfigSection(BaseModel):
    """Base class of all sections: immutable, rejects unknown keys, documented by the docstrings of its fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)
