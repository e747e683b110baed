"""The bases of all settings that a configuration file holds."""

from typing import Self

from pydantic import BaseModel, ConfigDict, model_validator


class Settings(BaseModel):
    """Settings: values do not change, unknown keys are refused, and numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RangeSettings(Settings):
    """Settings of which `min_range_m` and `max_range_m` are two."""

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        least, most = self.min_range_m, self.max_range_m  # type: ignore[attr-defined]
        if least >= most:
            raise ValueError(f"min_range_m={least:g} must be less than max_range_m={most:g}, or no point is left")
        return self
