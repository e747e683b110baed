"""The bases of all settings that a configuration file holds."""

from typing import Any, Self, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator, model_validator


class Settings(BaseModel):
    """Settings: values do not change, unknown keys are refused, and numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _a_switch_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, bool):  # which Pydantic takes for 1 or 0
            kind = cls.model_fields[info.field_name or ""].annotation
            kinds = {getattr(one, "__origin__", one) for one in (kind, *get_args(kind))}  # of Annotated
            if kinds & {int, float} and bool not in kinds:
                raise ValueError("expected a number, not true or false")
        return value


class RangeSettings(Settings):
    """Settings of which `min_range_m` and `max_range_m` are two."""

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        least, most = self.min_range_m, self.max_range_m  # type: ignore[attr-defined]
        if least >= most:
            raise ValueError(f"min_range_m={least:g} must be less than max_range_m={most:g}, or no point is left")
        return self
