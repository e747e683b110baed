"""Published data sets: where each is found, its sensors, and its reader."""

from dataclasses import dataclass
from typing import Literal

Tried = Literal["real files", "written sample", "not yet"]


@dataclass(frozen=True)
class DataSet:
    """One data set."""

    name: str  # as the command line has it; evalio's own name where evalio reads it
    title: str
    sensor: str  # the LiDAR whose scans are read
    reader: str  # in the table of readers
    truth: str  # source of the true poses
    imu: bool  # whether samples of an IMU are read
    url: str
    layout: str  # the path of a source, and the files that are read
    tried: Tried  # the data its reader was run on
    choose: str = ""  # option that chooses a sequence, where the source does not


_SURVEY = "scans registered to a survey map"
_GNSS = "GNSS and INS"
_KITTI = "https://www.cvlibs.net/datasets/kitti"
_PYBOREAS = "https://github.com/utiasASRL/pyboreas/blob/master"
_OXFORD = "https://ori-drs.github.io/newer-college-dataset"


def _of_evalio(
    name: str, title: str, sensor: str, truth: str, url: str, imu: bool = True, tried: Tried = "not yet"
) -> DataSet:
    layout = "DATASET/SEQUENCE in evalio's data folder, with the files that its publisher offers"
    return DataSet(name, title, sensor, "evalio", truth, imu, url, layout, tried)


CATALOGUE: tuple[DataSet, ...] = (
    DataSet(
        "kitti_odometry",
        "KITTI odometry",
        "Velodyne HDL-64E",
        "kitti-odometry",
        _GNSS,
        False,
        f"{_KITTI}/eval_odometry.php",
        "sequences/NN/velodyne/*.bin, times.txt and calib.txt; poses/NN.txt. The root, or one sequences/NN",
        "real files",
        "--sequence 04",
    ),
    DataSet(
        "kitti_raw",
        "KITTI raw",
        "Velodyne HDL-64E",
        "kitti-raw",
        _GNSS,
        True,
        f"{_KITTI}/raw_data.php",
        "..._drive_NNNN_sync or _extract: velodyne_points/data, timestamps*.txt, oxts; calib_*.txt in the folder above",
        "real files",
    ),
    DataSet(
        "kitti_360",
        "KITTI-360",
        "Velodyne HDL-64E",
        "kitti-360",
        "GNSS and scans registered to each other",
        False,
        "https://www.cvlibs.net/datasets/kitti-360/",
        "the root, or one data_3d_raw/..._sync: velodyne_points; data_poses and calibration in the root",
        "written sample",
        "--sequence 0003",
    ),
    DataSet(
        "mulran",
        "MulRan",
        "Ouster OS1-64",
        "mulran",
        _GNSS,
        True,
        "https://sites.google.com/view/mulran-pr",
        "one sequence: Ouster/*.bin, data_stamp.csv, global_pose.csv, xsens_imu.csv",
        "written sample",
    ),
    DataSet(
        "nclt",
        "NCLT",
        "Velodyne HDL-32E",
        "nclt",
        "GNSS and scans registered to each other",
        True,
        "https://robots.engin.umich.edu/nclt/",
        "one session: velodyne_sync/*.bin, groundtruth_DATE.csv, ms25.csv",
        "written sample",
    ),
    DataSet(
        "nuscenes",
        "nuScenes",
        "Velodyne HDL-32E",
        "nuscenes",
        "localisation in a map",
        False,
        "https://www.nuscenes.org/nuscenes",
        "the root: v1.0-*/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor}.json, samples and sweeps",
        "written sample",
        "--sequence scene-0061",
    ),
    DataSet(
        "argoverse_2",
        "Argoverse 2 sensor and LiDAR",
        "two Velodyne VLP-32C",
        "argoverse-2",
        "localisation in a map",
        False,
        "https://www.argoverse.org/av2.html",
        "one log: sensors/lidar/*.feather, city_SE3_egovehicle.feather, calibration/egovehicle_SE3_sensor.feather",
        "written sample",
    ),
    DataSet(
        "apollo",
        "Apollo-SouthBay",
        "Velodyne HDL-64E",
        "apollo",
        _GNSS,
        False,
        "https://developer.apollo.auto/southbay.html",
        "a folder with pcds/*.pcd and poses/gt_poses.txt, or one above several such",
        "written sample",
        "--sequence NAME",
    ),
    # The IMU of Boreas is published without gravity.
    _of_evalio(
        "boreas", "Boreas", "Velodyne VLS-128", _GNSS, f"{_PYBOREAS}/DATA_REFERENCE.md", False, "written sample"
    ),
    _of_evalio("boreas_rt", "Boreas Road Trip", "Velodyne VLS-128", _GNSS, f"{_PYBOREAS}/DATA_RT_REFERENCE.md"),
    _of_evalio(
        "botanic_garden", "BotanicGarden", "Velodyne VLP-16", _SURVEY, "https://github.com/robot-pesg/BotanicGarden"
    ),
    _of_evalio("cumulti", "CU-Multi", "Ouster OS1-64", "GNSS and INS", "https://arpg.github.io/cumulti/"),
    _of_evalio(
        "enwide",
        "ENWIDE",
        "Ouster OS0-128",
        "total station, positions alone",
        "https://projects.asl.ethz.ch/datasets/enwide",
        tried="written sample",
    ),
    _of_evalio("fomo", "FoMo", "RoboSense Ruby Plus", "GNSS, positions alone", "https://fomo.norlab.ulaval.ca/"),
    _of_evalio(
        "helipr",
        "HeLiPR",
        "Ouster OS2-128",
        _GNSS,
        "https://sites.google.com/view/heliprdataset/",
        tried="written sample",
    ),
    _of_evalio(
        "hilti_2022",
        "Hilti SLAM Challenge 2022",
        "Hesai PandarXT-32",
        "survey",
        "https://hilti-challenge.com/dataset-2022.html",
        tried="written sample",
    ),
    _of_evalio(
        "multi_campus",
        "MCD",
        "Ouster OS1-128, OS1-64",
        _SURVEY,
        "https://mcdviral.github.io/",
        tried="written sample",
    ),
    _of_evalio("newer_college_2020", "Newer College 2020", "Ouster OS1-64", _SURVEY, f"{_OXFORD}/stereo-cam/"),
    _of_evalio(
        "newer_college_2021",
        "Newer College 2021",
        "Ouster OS0-128",
        _SURVEY,
        f"{_OXFORD}/multi-cam/",
        tried="written sample",
    ),
    _of_evalio(
        "oxford_spires",
        "Oxford Spires",
        "Hesai QT64",
        _SURVEY,
        "https://dynamic.robots.ox.ac.uk/datasets/oxford-spires/",
        tried="written sample",
    ),
)
