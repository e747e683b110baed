"""Settings of the alignment of range images; light, so that reading a configuration imports no torch."""

from pydantic import BaseModel, ConfigDict, Field


class AlignmentConfig(BaseModel):
    """How images are laid on one another; see `odometry.alignment.alignment`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    iterations: int = Field(8, ge=0, description="Gauss-Newton steps at most; 0: the guess is the answer")
    anneal_share: float = Field(0.5, gt=0.0, le=1.0, description="part of them in which the scale shrinks")
    column_step: int = Field(2, ge=1, description="every so-manieth column's points take part")
    fill_columns: int = Field(4, ge=0, description="how far a pixel without a normal looks for one beside it")
    coarse_m: float = Field(0.5, gt=0.0, description="scale of the robust weights in the first step")
    fine_m: float = Field(0.05, gt=0.0, description="and in the last ones")
    gate_m: float = Field(0.2, gt=0.0, description="distance of a point from its pixel's, at the sensor")
    gate_share: float = Field(0.04, ge=0.0, description="what each metre of range adds, facing the beam")
    least_cosine: float = Field(0.8, ge=0.0, le=1.0, description="between the normals of a pair")
    residual_m: float = Field(0.03, gt=0.0, description="standard deviation of points about their planes")
    independent_share: float = Field(0.05, gt=0.0, le=1.0, description="of the points whose errors are independent")
    surprise_rad_s: float = Field(
        0.3, gt=0.0, description="standard deviation of changes of velocity within a pair of sweeps that are unexpected"
    )
    surprise_m_s: float = Field(0.5, gt=0.0, description="and of those of the translation")
    doubtful: float = Field(
        0.45, ge=0.0, le=1.0, description="of what a scan says that the two agree on; below, other guesses are tried"
    )
    clearly_better: float = Field(0.05, ge=0.0, description="by which more must be agreed on for another guess")
    search_m: tuple[float, ...] = Field(
        (0.8, 1.6, 2.4, 3.2), description="distances, to either side, that are tried along the direction in doubt"
    )
    largest_step: float = Field(0.3, gt=0.0, description="of one Gauss-Newton step, radians and metres")

    @property
    def information_per_m2(self) -> float:
        """What one point says. Neighbouring pixels share their errors, so that it is less than its scatter tells."""
        return self.independent_share / self.residual_m**2
