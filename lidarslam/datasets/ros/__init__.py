"""Rosbags and ROS messages."""
