"""Settings of the normals of range images; light, so that reading a configuration imports no torch."""

from pydantic import BaseModel, ConfigDict, Field


class NormalConfig(BaseModel):
    """Which neighbours of a pixel its plane is fitted to, and when the fit counts; see `odometry.images.normals`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    gate_m: float = Field(0.5, gt=0.0, description="neighbours whose range differs by more are left out")
    rows: int = Field(1, ge=0, description="how far the neighbourhood reaches up and down")
    columns: int = Field(4, ge=0, description="how far it reaches to the left and to the right")
    min_neighbours: int = Field(6, ge=3, description="points that a neighbourhood must have, itself included")
    max_flatness: float = Field(0.1, gt=0.0, le=1.0, description="smallest eigenvalue over the middle one, at most")
    min_spread: float = Field(0.02, ge=0.0, le=1.0, description="middle eigenvalue over the largest one, at least")
    wide_gate_m: float | None = Field(
        2.0, gt=0.0, description="the gate of a second try where the first finds no plane; null: none is made"
    )
    wide_columns: int = Field(8, ge=0, description="how far the second neighbourhood reaches to the left and right")
