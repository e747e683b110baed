"""Settings of what a run keeps for `--resume`; light, so that reading a configuration imports nothing heavy."""

from pydantic import BaseModel, ConfigDict, Field


class CheckpointConfig(BaseModel):
    """How often a run saves its state; none of it changes the results."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    interval_s: float = Field(10.0, ge=0.0, description="the state is saved no more often than this")
    most_percent: float = Field(
        2.0, gt=0.0, le=100.0, description="and so seldom that saving takes no more of the time than this"
    )
    every_scans: int | None = Field(None, ge=1, description="instead, after every so many scans; for tests")
