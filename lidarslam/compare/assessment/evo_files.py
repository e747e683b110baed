"""Errors of a trajectory as files of evo, for `evo_res` and its plots."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np

from lidarslam.core.errors import OutputError
from lidarslam.core.files import replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics, absolute_errors, relative_errors

APE, RPE = "ape.zip", "rpe.zip"


def write_evo_files(folder: Path, name: str, metrics: TrajectoryMetrics) -> list[Path]:
    """Write NAME_ape.zip, the positions' errors after alignment, and NAME_rpe.zip, those from scan to scan.

    Both hold `info.json`, `stats.json` and the arrays of a result of evo's.

    Raises:
        OutputError: they cannot be written.
    """
    association = metrics.association
    rows = np.arange(len(association.estimate))
    ends = rows[1:][np.diff(association.rows) == 1]
    absolute, _ = absolute_errors(association, metrics.T_reference_estimate)
    relative, _ = relative_errors(association)
    aligned = {"se3": "with SE(3) Umeyama alignment", "first_pose": "with origin alignment", "none": "not aligned"}
    titles = (
        f"APE w.r.t. translation part (m)\n({aligned[metrics.alignment]})",
        "RPE w.r.t. translation part (m)\nfor delta = 1 (frames) using consecutive pairs\n(not aligned)",
    )
    paths = [folder / f"{name}_{ending}" for ending in (APE, RPE)]
    parts = zip(paths, titles, ("APE (m)", "RPE (m)"), (absolute, relative), (rows, ends), strict=True)
    for path, title, label, errors, chosen in parts:
        info = {"title": title, "ref_name": "reference", "est_name": name, "label": label}
        estimate, reference = association.estimate, association.reference
        arrays = {
            "error_array": errors,
            "seconds_from_start": estimate.stamps[chosen] - estimate.stamps[0],
            "timestamps": estimate.stamps[chosen],
            "distances_from_start": reference.distances[chosen],
            "distances": estimate.distances[chosen],
        }
        if len(errors):
            _write(path, info, arrays)
    return [path for path, errors in zip(paths, (absolute, relative), strict=True) if len(errors)]


def _write(path: Path, info: dict[str, str], arrays: dict[str, FloatArray]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial, zipfile.ZipFile(partial, "w") as archive:
            archive.writestr("info.json", json.dumps(info))
            archive.writestr("stats.json", json.dumps(_statistics(arrays["error_array"])))
            for name, values in arrays.items():
                content = io.BytesIO()
                np.save(content, values, allow_pickle=False)
                archive.writestr(f"{name}.npy", content.getvalue())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def _statistics(errors: FloatArray) -> dict[str, float]:
    return {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(np.mean(errors)),
        "median": float(np.median(errors)),
        "std": float(np.std(errors)),
        "min": float(np.min(errors)),
        "max": float(np.max(errors)),
        "sse": float(np.sum(errors**2)),
    }
