"""`lidarslam live`, which publishes /lidarslam/odometry and `odom` to the sensor; `map` to `odom`; RViz."""

import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "program": ("lidarslam", "Path of the program, for example of a virtual environment"),
    "topic": ("/points", "Topic of the clouds"),
    "odom_frame": ("odom", "Fixed frame of the poses"),
    "options": ("", "More options of `lidarslam live`, in one string"),
    "map_to_odom": ("true", "Publish the identity from map to odom_frame"),
    "rviz": ("true", "Start RViz"),
}


def start_program(context: LaunchContext) -> list[ExecuteProcess]:
    program, topic, odom_frame, options = (
        LaunchConfiguration(name).perform(context) for name in ("program", "topic", "odom_frame", "options")
    )
    command = [program, "live", "--topic", topic, "--odom-frame", odom_frame, *shlex.split(options)]
    # At the end the results are written; launch would terminate and kill the program after 5 s each.
    return [ExecuteProcess(cmd=command, output="screen", sigterm_timeout="600", sigkill_timeout="600")]


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    map_to_odom = Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        arguments=["--frame-id", "map", "--child-frame-id", LaunchConfiguration("odom_frame")],
        condition=IfCondition(LaunchConfiguration("map_to_odom")),
    )
    configuration = PathJoinSubstitution([FindPackageShare("lidarslam_ros"), "rviz", "lidarslam.rviz"])
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", configuration],
        remappings=[("/points", LaunchConfiguration("topic"))],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*declared, OpaqueFunction(function=start_program), map_to_odom, rviz])
