"""The base of all settings that a configuration file holds."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Settings: values do not change, unknown keys are refused, and numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
