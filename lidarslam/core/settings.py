"""The base of all settings that a configuration file holds, and a check of two settings against each other."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Settings: values do not change, unknown keys are refused, and numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def require_range_left(min_range_m: float, max_range_m: float) -> None:
    """The minimum range must be below the maximum."""
    if min_range_m >= max_range_m:
        raise ValueError(
            f"min_range_m={min_range_m:g} must be less than max_range_m={max_range_m:g}, or no point is left"
        )
