"""Errors as files of evo: evo reads them, and its own run on the same trajectories has the same numbers."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.assessment.evaluate import EvaluateRequest, evaluate
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory, chain, write_tum

pytest.importorskip("evo")


@pytest.fixture
def files(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """An estimate and a reference, of 40 poses each."""
    stamps = 100.0 + 0.1 * np.arange(40)
    motions = exp(np.tile([0.0, 0.01, 0.05, 0.4, 0.02, 0.0], (39, 1)))
    noisy = motions @ exp(rng.normal(0.0, 0.01, (39, 6)))
    paths = tmp_path / "run_a.tum", tmp_path / "truth.tum"
    for path, steps in zip(paths, (noisy, motions), strict=True):
        write_tum(path, Trajectory(stamps, chain(np.eye(4), steps)))
    return paths


def test_they_hold_what_evo_itself_computes(files: tuple[Path, Path], tmp_path: Path) -> None:
    from evo.core.metrics import PoseRelation, Unit
    from evo.main_ape import ape
    from evo.main_rpe import rpe
    from evo.tools.file_interface import load_res_file, read_tum_trajectory_file

    evaluate(EvaluateRequest(files[0], files[1], evo=tmp_path / "evo"))
    relation = PoseRelation.translation_part
    estimate, reference = (read_tum_trajectory_file(str(path)) for path in files)
    whole = ape(reference, estimate, relation, align=True)
    estimate, reference = (read_tum_trajectory_file(str(path)) for path in files)
    steps = rpe(reference, estimate, relation, delta=1, delta_unit=Unit.frames)
    for ending, expected in (("ape", whole), ("rpe", steps)):
        written = load_res_file(tmp_path / "evo" / f"run_a_{ending}.zip")
        assert written.stats.keys() == expected.stats.keys()
        for name, value in expected.stats.items():
            assert written.stats[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name
        for name in ("error_array", "timestamps", "seconds_from_start", "distances_from_start", "distances"):
            np.testing.assert_allclose(written.np_arrays[name], expected.np_arrays[name], atol=1e-7, err_msg=name)
        assert written.info["label"] == expected.info["label"]
        assert written.info["title"] == expected.info["title"]
        assert written.info["est_name"] == "run_a"


def test_without_a_reference_there_is_nothing_to_save(files: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--evo"):
        evaluate(EvaluateRequest(files[0], needs_reference=False, evo=tmp_path / "evo"))
